"""Radiance fields of scenes with glass and liquids, sampled along refracted light paths.

The public API consists of this module, for objects, rays and light paths, and of
`refref_jax.render`, for colours. `docs/library.md` lists all names. They are imported on first use,
so that importing the package is fast and does not initialise a device.

>>> import trimesh
>>> import refref_jax
>>> ball = refref_jax.single_object(trimesh.creation.icosphere(), index=1.5)
>>> cameras = refref_jax.orbit(8, distance=4.0, elevation=0.3, size=16, angle_x=1.2)
>>> refref_jax.image_rays(cameras, 0).origins.shape
(16, 16, 3)
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the same names for static type checkers; a test compares both lists
    from refref_jax.choices import Material as Material
    from refref_jax.data import SceneError as SceneError
    from refref_jax.data.meshes import MeshPart as MeshPart
    from refref_jax.data.meshes import read_meshes as read_meshes
    from refref_jax.data.scene_assembly import assemble as assemble
    from refref_jax.data.scene_assembly import make_part as make_part
    from refref_jax.data.scene_assembly import single_object as single_object
    from refref_jax.geometry.cameras import Cameras as Cameras
    from refref_jax.geometry.cameras import image_rays as image_rays
    from refref_jax.geometry.cameras import orbit as orbit
    from refref_jax.geometry.rays import Rays as Rays
    from refref_jax.optics.differentiable_paths import follow_branch as follow_branch
    from refref_jax.optics.differentiable_paths import follow_main_branches as follow_main_branches
    from refref_jax.optics.light_paths import LightPaths as LightPaths
    from refref_jax.optics.light_paths import PathStatus as PathStatus
    from refref_jax.optics.media import Scene as Scene
    from refref_jax.optics.media import of_channel as of_channel
    from refref_jax.optics.media import with_index as with_index
    from refref_jax.optics.path_settings import PATH_PRESETS as PATH_PRESETS
    from refref_jax.optics.path_settings import PathSettings as PathSettings
    from refref_jax.optics.path_tracing import trace as trace
    from refref_jax.training.config import TrainConfig as TrainConfig
    from refref_jax.training.evaluation import evaluate as evaluate
    from refref_jax.training.fit import fit as fit

__version__ = "0.1.0"

_HOMES = {
    "PATH_PRESETS": "optics.path_settings",
    "PathSettings": "optics.path_settings",
    "Cameras": "geometry.cameras",
    "LightPaths": "optics.light_paths",
    "Material": "choices",
    "MeshPart": "data.meshes",
    "PathStatus": "optics.light_paths",
    "Rays": "geometry.rays",
    "Scene": "optics.media",
    "SceneError": "data",
    "TrainConfig": "training.config",
    "assemble": "data.scene_assembly",
    "evaluate": "training.evaluation",
    "fit": "training.fit",
    "follow_branch": "optics.differentiable_paths",
    "follow_main_branches": "optics.differentiable_paths",
    "image_rays": "geometry.cameras",
    "make_part": "data.scene_assembly",
    "of_channel": "optics.media",
    "orbit": "geometry.cameras",
    "read_meshes": "data.meshes",
    "single_object": "data.scene_assembly",
    "trace": "optics.path_tracing",
    "with_index": "optics.media",
}
"""Module that defines each public name."""


def __getattr__(name: str) -> Any:
    """Imports a public name on first access."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Lists the names of the module, including those that are not imported yet."""
    return sorted({*globals(), *_HOMES})
