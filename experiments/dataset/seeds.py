"""Seeds from names: the same on every machine, and unrelated for different names."""

import hashlib


def seed_of(*names: str) -> int:
    """Returns the seed of some names: `seed_of("cube_smcvx_ball", "train")`.

    It is the first eight bytes, read as a big-endian number, of the SHA-256 of the names, UTF-8,
    each closed by a zero byte, so that `("a", "bc")` and `("ab", "c")` differ.
    """
    digest = hashlib.sha256("".join(f"{name}\0" for name in names).encode())
    return int.from_bytes(digest.digest()[:8], "big")
