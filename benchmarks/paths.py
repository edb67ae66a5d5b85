"""Claim: the path tree costs at most 1.3 times the same tree on Embree in NumPy, on one core.

    python -m benchmarks.paths [--scene=FOLDER] [--view=N] [--fine=N] [--repeats=N]

All camera rays of one test view are traced with the path settings `tree`. In NumPy a round casts
all live rays with Embree (single precision, `rtcIntersect1`) and shades them as arrays in single
precision; the table also shows Embree's own share of that time. Compiling is not timed.

If Mitsuba is installed, its `path` integrator (variant `scalar_rgb`) renders the same view. It
samples one branch at an interface where the tree follows both, so only casts per second can be
compared: its samples times the mean number of casts of a random path, from the tree's weights. Its
time includes the film and random numbers; the others' includes the list of paths.

The process is pinned to one core and the methods are timed in turn, by CPU time, so that ratios
hold when the machine's speed drifts or other programs run.
"""

import os

if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import functools
import importlib.util
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from absl import app, flags

from benchmarks.oracles import reference_images, reference_surfaces, reference_tree
from benchmarks.oracles.reference_surfaces import Embree, Hits, Surfaces
from refref_jax.data import mesh_queries, meshes
from refref_jax.data.scene_assembly import assemble_scene
from refref_jax.geometry.rays import Rays
from refref_jax.optics import path_tracing
from refref_jax.optics.light_paths import exists
from refref_jax.optics.path_settings import TREE

_SCENE = flags.DEFINE_string("scene", "experiments/data/cube_smcvx_ball", "Folder of the scene.")
_VIEW = flags.DEFINE_integer("view", 0, "Test view.")
_FINE = flags.DEFINE_integer("fine", 2, "Rays per pixel along each axis.")
_REPEATS = flags.DEFINE_integer("repeats", 7, "Number of timings of each method.")

_LIMIT = 1.3

# Only the length limit ends Mitsuba's paths; long ones carry almost no light.
_MITSUBA_DEPTH = 64


class Outcome(NamedTuple):
    """Result of tracing a view with one method."""

    casts: float
    paths: int


class SinglePrecisionEmbree(Embree):
    """Uses Embree's hits without refinement, and measures its time."""

    def __init__(self, surfaces: Surfaces):
        """Builds Embree's tree."""
        super().__init__(surfaces)
        self.seconds = 0.0

    def __call__(
        self, origins: np.ndarray, directions: np.ndarray, exclude_primitive: np.ndarray
    ) -> Hits:
        """Returns the closest hits of rays that start on the given triangles (-1: none)."""
        starts = self.off_surface(origins, directions, exclude_primitive)
        begin = time.process_time()
        found = self.scene.run(starts, directions, output=1)
        self.seconds += time.process_time() - begin
        return Hits(found["tfar"], found["primID"], np.stack([found["u"], found["v"]], axis=-1))


class _Library:
    """The library's tree; the first call compiles."""

    def __init__(self, scene: Path, origins: np.ndarray, directions: np.ndarray):
        parts = meshes.read_meshes(scene)
        parents = mesh_queries.find_containment(parts).parents
        scene = jax.tree.map(jnp.asarray, assemble_scene(parts, parents, rule="nested"))
        radii = jnp.full(len(origins), 1e-3, jnp.float32)
        rays = Rays(jnp.asarray(origins), jnp.asarray(directions), radii)
        trace = jax.jit(functools.partial(path_tracing.trace_ends, settings=TREE))
        self._trace = lambda: jax.block_until_ready(trace(scene, rays))
        self._trace()

    def __call__(self) -> Outcome:
        traced = self._trace()
        return Outcome(int(traced.casts), int(np.sum(exists(traced.ends))))


class _NumPy:
    """The reference tree in single precision."""

    def __init__(self, surfaces: Surfaces, origins: np.ndarray, directions: np.ndarray):
        halved = (x.astype(np.float32) if x.dtype == np.float64 else x for x in surfaces)
        self._surfaces = Surfaces(*halved)
        self._rays = origins, directions
        self.embree = SinglePrecisionEmbree(self._surfaces)

    def __call__(self) -> Outcome:
        rule = reference_tree.TREE
        ends = reference_tree.trace(self._surfaces, self.embree, *self._rays, rule)
        return Outcome(ends.casts, len(ends.rays))


class _Mitsuba:
    """One random path for each camera ray, by Mitsuba."""

    def __init__(self, scene: Path, view: reference_images.View, casts: float):
        import mitsuba as mi

        mi.set_variant("scalar_rgb")
        self._render = lambda: mi.render(self._scene, spp=_FINE.value**2)
        height, width, _ = view.image.shape
        flip = np.diag([-1.0, 1.0, -1.0, 1.0])
        content = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": _MITSUBA_DEPTH, "rr_depth": 10_000},
            "emitter": {"type": "constant"},
            "sensor": {
                "type": "perspective",
                "fov": float(np.degrees(2.0 * np.arctan(0.5 * width / view.focal))),
                "to_world": mi.ScalarTransform4f(view.pose @ flip),
                "film": {"type": "hdrfilm", "width": width, "height": height},
            },
        }
        for i, part in enumerate(json.loads((scene / "scene.json").read_text())["parts"]):
            content[f"part{i}"] = {
                "type": "ply",
                "filename": str(scene / part["mesh"]),
                "face_normals": not part["smooth_normals"],
                "bsdf": {
                    "type": "dielectric",
                    "int_ior": part["ior_inside"],
                    "ext_ior": part["ior_outside"],
                },
            }
        self._scene = mi.load_dict(content)
        self._outcome = Outcome(casts * height * width * _FINE.value**2, 0)

    def __call__(self) -> Outcome:
        self._render()
        return self._outcome


def main(arguments: list[str]) -> None:
    del arguments
    scene = Path(_SCENE.value)
    surfaces = reference_surfaces.read_surfaces(scene)
    view = reference_images.read_view(scene, _VIEW.value)
    rows = np.arange(view.image.shape[0])
    shaped = reference_images.pixel_rays(view, rows, _FINE.value)
    origins, directions = (x.reshape(-1, 3).astype(np.float32) for x in shaped)
    numpy = _NumPy(surfaces, origins, directions)
    ways = {"refref_jax": _Library(scene, origins, directions), "Embree in NumPy": numpy}
    if importlib.util.find_spec("mitsuba"):
        casts = _casts_of_random_paths(surfaces, origins, directions)
        ways["Mitsuba"] = _Mitsuba(scene, view, casts)
    else:
        print("Mitsuba is not installed and is omitted. `pip install mitsuba` adds it.")
    seconds, outcomes, embree = _take_turns(ways, numpy)
    _print_table(f"{scene.name}, view {_VIEW.value}", len(origins), seconds, outcomes, embree)
    ratio = np.median(seconds["refref_jax"]) / np.median(seconds["Embree in NumPy"])
    print(f"Ratio of the tree's times, refref_jax to Embree in NumPy: {ratio:.2f}")
    _check_same_tree(outcomes["refref_jax"], outcomes["Embree in NumPy"])
    assert ratio <= _LIMIT, f"the tree costs more than {_LIMIT} times the tree on Embree in NumPy"


def _casts_of_random_paths(
    surfaces: Surfaces, origins: np.ndarray, directions: np.ndarray
) -> float:
    """Returns the mean casts of a path that takes each branch with its share as probability."""
    clear = surfaces._replace(tints=np.ones_like(surfaces.tints))
    rule = reference_tree.Rule(_MITSUBA_DEPTH, "all", min_throughput=0.002)
    some = np.arange(0, len(origins), 4)
    rays = origins[some].astype(float), directions[some].astype(float)
    ends = reference_tree.trace(clear, Embree(clear), *rays, rule)
    return float(np.sum(ends.throughput[:, 0] * (ends.num_bends + 1.0)) / len(some))


def _take_turns(
    ways: dict[str, Callable[[], Outcome]], numpy: _NumPy
) -> tuple[dict[str, list[float]], dict[str, Outcome], float]:
    """Returns the seconds of every turn, the outcomes, and Embree's own share of the time."""
    outcomes = {name: way() for name, way in ways.items()}
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    numpy.embree.seconds = 0.0
    for _ in range(_REPEATS.value):
        for name, way in ways.items():
            begin = time.process_time()
            way()
            seconds[name].append(time.process_time() - begin)
    return seconds, outcomes, numpy.embree.seconds / sum(seconds["Embree in NumPy"])


def _print_table(
    title: str,
    rays: int,
    seconds: dict[str, list[float]],
    outcomes: dict[str, Outcome],
    embree: float,
) -> None:
    print(f"\n{title}: {rays} rays, medians of {_REPEATS.value} turns on one core\n")
    print("| way | ms (least, most) | casts a ray | paths a ray | million casts a second |")
    print("|---|---|---|---|---|")
    for name, times in seconds.items():
        middle, outcome = np.median(times), outcomes[name]
        paths = f"{outcome.paths / rays:.3f}" if outcome.paths else "1 (random)"
        print(
            f"| {name} | {1e3 * middle:.0f} ({1e3 * min(times):.0f}, {1e3 * max(times):.0f}) "
            f"| {outcome.casts / rays:.3f} | {paths} | {1e-6 * outcome.casts / middle:.2f} |"
        )
    print(f"\nEmbree itself takes {100.0 * embree:.0f} % of the time of Embree in NumPy.")


def _check_same_tree(ours: Outcome, theirs: Outcome) -> None:
    """Checks that both trees agree, up to rounding of long trapped paths."""
    assert abs(ours.casts / theirs.casts - 1.0) < 0.01
    assert abs(ours.paths / theirs.paths - 1.0) < 0.01


if __name__ == "__main__":
    app.run(main)
