"""Seeds from names: the same on every machine, and unrelated for different names."""

import hashlib


def seed_of(*names: str) -> int:
    """Returns the seed of some names: `seed_of("cube_smcvx_ball", "train")`.

    The seed is the first eight bytes, as a big-endian number, of the SHA-256 of the names in UTF-8,
    each followed by a zero byte, so that `("a", "bc")` and `("ab", "c")` differ.
    """
    digest = hashlib.sha256("".join(f"{name}\0" for name in names).encode())
    return int.from_bytes(digest.digest()[:8], "big")
