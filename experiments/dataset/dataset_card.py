"""The list of all scenes of a folder, and the Hugging Face card of parquet files."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from refref_jax import atomic_files
from refref_jax.data import scene_names
from refref_jax.data.scene_names import CONFIGS, SceneName

LIST = "scene_list.txt"
CARD = "README.md"

# Cards with this line are ours, and may be replaced.
_MARK = "<!-- Written by experiments.dataset.convert; remove this line to keep your changes. -->"

_TEXT = """
# Scenes of glass and liquids

Each scene is a split, and each row a view of it: colour, object mask, 8-bit inverted planar depth
(`z = 1 + 10.5 (1 - v / 255)`) and 4 x 4 camera-to-world matrix (OpenGL axes). In the order of the
rows there are training, validation and test views, a third each unless the schema's metadata says
otherwise. `scene_files/` holds meshes, indices of refraction and textures,
`mesh_files/` the meshes by material.

```python
datasets.load_dataset({folder!r}, {config!r}, split={scene!r})
```

Say here who made the images, how, and under which licence they are.
"""


def add_to_list(out: Path, names: Iterable[str]) -> Path:
    """Adds scenes to the list of a folder, one name per line, and returns its path."""
    path = out / LIST
    known = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    _write(path, "".join(f"{name}\n" for name in sorted({*filter(None, known), *names})))
    return path


def write(out: Path, scenes: Sequence[SceneName]) -> Path | None:
    """Writes the card of a folder of parquet files, with its configurations.

    Returns:
      Path of the card, or `None` if a card exists that was not written here, or was edited.
    """
    path = out / CARD
    if path.is_file() and _MARK not in path.read_text(encoding="utf-8"):
        return None
    lines = ["---", "configs:"]
    for config in CONFIGS:
        of_config = [scene for scene in scenes if scene.config == config]
        if of_config:
            lines += [f"- config_name: {config}", "  data_files:"]
        for scene in of_config:
            lines += [f"  - split: {scene}", f"    path: data/{scene}-*"]
    first = scenes[0]
    text = _TEXT.format(folder=out.resolve().name, config=first.config, scene=str(first))
    _write(path, "\n".join([*lines, "---", "", _MARK, text.lstrip("\n")]))
    return path


def names_in(out: Path) -> list[SceneName]:
    """Returns the scenes in the list of a folder."""
    lines = (out / LIST).read_text(encoding="utf-8").splitlines()
    return [scene_names.parse(line) for line in lines if scene_names.is_name(line)]


def _write(path: Path, text: str) -> None:
    with atomic_files.written_file(path) as draft:
        draft.write_text(text, encoding="utf-8")
