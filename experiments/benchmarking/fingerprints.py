"""A hash of what decides results on a scene, so that results of another scene are not mixed in.

It covers the transforms files, scene.json and the meshes by their content, and all images that the
transforms files name (colours, masks, depth maps) by their names and sizes in bytes: to read a
data set's images whole whenever a benchmark begins would take minutes. Where the folder lies does
not matter, nor does what else is in it.
"""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from refref_jax import configuration
from refref_jax.data import meshes

_LETTERS = 16

# Endings of what a key of a frame names: a float depth map may lie beside an 8-bit one.
_ENDINGS = {"file_path": (".png",), "mask_file_path": ("",), "depth_file_path": ("", ".exr")}


def fingerprint(scene: Path) -> str:
    """Returns the hash of a scene, which may be broken or lack files."""
    found = hashlib.sha256()
    described = scene / "scene.json"
    transforms = sorted(scene.glob("transforms_*.json"))
    for path in (*transforms, *([described] if described.is_file() else [])):
        _add(found, path.name, path.read_bytes())
    for path in meshes.mesh_files(scene):
        _add(found, f"meshes/{path.name}", path.read_bytes())
    for name in sorted({name for path in transforms for name in _images(path)}):
        path = scene / name
        size = path.stat().st_size if path.is_file() else "missing"
        _add(found, Path(name).as_posix(), str(size).encode())
    return found.hexdigest()[:_LETTERS]


def _add(found: Any, name: str, content: bytes) -> None:
    """Adds to a hash what a name stands for; no two lists of such come to the same bytes."""
    for part in (name.encode(), content):
        found.update(len(part).to_bytes(8, "big"))
        found.update(part)


def _images(transforms: Path) -> Iterator[str]:
    """Yields the files that a transforms file names, as far as it is one."""
    try:
        frames = configuration.parse_json(transforms.read_text(encoding="utf-8"))["frames"]
    except (ValueError, KeyError, TypeError):
        return
    for frame in frames if isinstance(frames, list) else ():
        for key, endings in _ENDINGS.items():
            name = frame.get(key) if isinstance(frame, dict) else None
            if isinstance(name, str):
                yield from (_ending(name, ending) for ending in endings)


def _ending(name: str, ending: str) -> str:
    """Returns the file of a name: image names lack their ending, depth maps may have another."""
    if ending == ".exr":
        return str(Path(name).with_suffix(ending)) if Path(name).name else name
    return f"{name}{ending}"
