"""Creates the folder of a scene, ready to be rendered, and recognises one (NumPy only).

    {scene}/meshes/{object}_{part}_{material}.ply    binary, single precision; `opaque` and
                                                     `conductor` in place of a material
    {scene}/background/                              files of the record
    {scene}/transforms_{train,val,test}.json         poses and file names, of splits with views
    {scene}/scene.json                               see `scene_record`

A folder is created atomically, so an existing one is complete.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import trimesh

from experiments.dataset import backgrounds, cameras, frame_files, scene_record
from experiments.dataset.parts import ObjectPart
from experiments.dataset.render_settings import RenderSettings
from experiments.dataset.seeds import seed_of
from refref_jax import atomic_files, configuration
from refref_jax.data.scene_names import SceneName

_RECORD = "scene.json"


def make(
    folder: Path,
    scene: SceneName,
    settings: RenderSettings,
    *,
    parts: Callable[[], Sequence[ObjectPart]],
    scratch: Path,
) -> None:
    """Creates the folder of a scene, unless it exists.

    Args:
      folder: folder to create.
      scene: scene to make.
      settings: settings of the rendering.
      parts: function that makes the parts of the object.
      scratch: existing folder on the same file system, for temporary files.
    """
    if folder.exists():
        return
    draft = scratch / str(scene)
    (draft / "meshes").mkdir(parents=True)
    made = parts()
    write_meshes(draft, scene, made)
    seed = seed_of(str(scene), "background")
    background = backgrounds.write_background(
        draft, scene.background, seed=seed, size=settings.texture_size
    )
    for split in cameras.SPLITS:
        if settings.numbers(split):
            _write_json(draft / f"transforms_{split}.json", _transforms(scene, settings, split))
    record = scene_record.describe(scene, made, background, settings)
    _write_json(draft / _RECORD, record)
    atomic_files.move(draft, folder)


def write_meshes(folder: Path, scene: SceneName, parts: Sequence[ObjectPart]) -> None:
    """Writes the parts of a scene into its folder, which must have a subfolder for meshes."""
    for part in parts:
        mesh = trimesh.Trimesh(part.vertices, part.faces, vertex_colors=part.colours, process=False)
        content = trimesh.exchange.ply.export_ply(mesh, vertex_normal=False)
        (folder / "meshes" / scene_record.mesh_name(scene, part)).write_bytes(content)


def check(folder: Path, scene: SceneName, settings: RenderSettings) -> None:
    """Checks that an existing folder belongs to a scene with these settings.

    Raises:
      ValueError: if it does not.
    """
    if not folder.exists():
        return
    path = folder / _RECORD
    try:
        found = configuration.parse_json(path.read_text(encoding="utf-8"))
        different = _difference(found, scene_record.identify(scene, settings), "")
    except (OSError, ValueError, AttributeError) as error:
        raise ValueError(
            f"{folder} exists, but is not a scene of this command ({error}). Give another --out, "
            "or remove it."
        ) from error
    if different:
        raise ValueError(
            f"{path} has other settings: {different}. Give the same ones to resume, or another "
            "--out."
        )


def _difference(found: Any, wanted: Any, name: str) -> str:
    """Returns the first difference, in words, or an empty string."""
    if isinstance(wanted, dict):
        for key, value in wanted.items():
            if different := _difference(found.get(key), value, f"{name} {key}"):
                return different
        return ""
    return "" if found == wanted else f"the{name} is {found}, not {wanted}"


def _transforms(scene: SceneName, settings: RenderSettings, split: cameras.Split) -> dict[str, Any]:
    poses = cameras.split_poses(str(scene), split, getattr(settings.views, split))
    frames = []
    for number in settings.numbers(split):
        named = frame_files.relative(split, number)
        frames.append(
            {
                "file_path": f"./{named.image.with_suffix('')}",
                "mask_file_path": f"./{named.mask}",
                "depth_file_path": f"./{named.depth_8_bit}",
                "transform_matrix": poses[number].tolist(),
            }
        )
    return {"camera_angle_x": cameras.ANGLE_X, "frames": frames}


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
