"""Claim: the tests catch each of these bugs, which are planted one at a time in a copy.

    python -m benchmarks.planted_bugs [--only=NAME,...] [--jobs=N]

Each bug replaces one piece of text in one file of the library. Its tests must pass on a copy
without bugs, and one of them must fail, rather than not start, on a copy with the bug. Prints a
table, writes benchmarks/results/planted_bugs.csv unless `--only` is given, and asserts that all
bugs are caught.
"""

import concurrent.futures
import csv
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from absl import app, flags

_ONLY = flags.DEFINE_list("bugs", [], "Names of the bugs to plant; all by default.")
_JOBS = flags.DEFINE_integer("copies", 2, "Number of copies that are tested at the same time.", 1)

_ROOT = Path(__file__).parents[1]
_RESULTS = _ROOT / "benchmarks" / "results" / "planted_bugs.csv"

# Exit status of pytest if a test failed, rather than that it could not be run.
_FAILED = 1


class Bug(NamedTuple):
    """A bug to plant.

    Attributes:
      name: what is wrong.
      file: module of the library, below `refref_jax`.
      old: text of the module, which occurs once.
      new: what replaces it.
      tests: arguments for pytest, below `tests`.
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


class Outcome(NamedTuple):
    """What became of a bug.

    Attributes:
      name: name of the bug.
      caught: whether a test failed.
      test: name of the test that failed, or why none did.
      seconds: duration of the tests.
    """

    name: str
    caught: bool
    test: str
    seconds: float


_FRESNEL = "optics/fresnel.py"
_STEP = "optics/path_step.py"
_MEDIA = "optics/media.py"
_VOLUME = "render/volume_rendering.py"
_BOUNDS = "sampling/scene_bounds.py"
_OBJECTIVE = "training/objective.py"
_KERNELS = "fields/hash_grid_kernels.py"

_TEST_STEP = ("optics/test_path_step.py",)
_TEST_TREE = ("optics/test_path_tree.py",)
_TEST_MEDIA = ("optics/test_media.py",)
_TEST_BOUNDS = ("sampling/test_scene_bounds.py",)
_TEST_COMPOSITING = ("render/test_compositing.py",)
_TEST_OBJECTIVE = ("training/test_objective.py",)
_REFRACTION = "reconstruct/test_shape_from_refraction.py"
_TEST_REFRACTION = (f"{_REFRACTION}::test_sensitivities_are_central_differences_of_predictions",)

BUGS = (
    Bug(
        "sign of gamma",
        _FRESNEL,
        "(alpha * beta - gamma) * normal",
        "(alpha * beta + gamma) * normal",
        ("optics/test_snell.py",),
    ),
    Bug(
        "alpha inverted",
        _FRESNEL,
        "alpha = index_near / index_far",
        "alpha = index_far / index_near",
        ("optics/test_snell.py",),
    ),
    Bug(
        "total reflection on the wrong side",
        _FRESNEL,
        "squared < 0.0)",
        "squared > 0.0)",
        ("optics/test_snell.py",),
    ),
    Bug(
        "indices of Fresnel swapped",
        _FRESNEL,
        "gamma, total = transmission(beta, index_near, index_far)",
        "gamma, total = transmission(beta, index_far, index_near)",
        ("optics/test_fresnel.py",),
    ),
    Bug(
        "one polarisation counts twice",
        _FRESNEL,
        "_amplitude(index_far * beta, index_near * gamma)",
        "_amplitude(index_near * beta, index_far * gamma)",
        ("optics/test_fresnel.py",),
    ),
    Bug(
        "limit of bends off by one",
        _STEP,
        "state.num_bends < settings.max_bends",
        "state.num_bends <= settings.max_bends",
        _TEST_TREE,
    ),
    Bug(
        "total reflection not followed",
        _STEP,
        "reflected = jnp.where(total, jnp.ones_like(partial), partial)",
        "reflected = partial",
        _TEST_STEP,
    ),
    Bug(
        "reflected branch dropped",
        _STEP,
        "reflected = arrival.throughput * share.reflected",
        "reflected = arrival.throughput * share.reflected * 0.0",
        _TEST_TREE,
    ),
    Bug(
        "threshold compared with the wrong side",
        _STEP,
        "weaker * strength < settings.min_throughput",
        "weaker * strength > settings.min_throughput",
        _TEST_STEP,
    ),
    Bug(
        "sibling does not get the dropped branch's share",
        _STEP,
        "return Shares(reflected, 1.0 - reflected)",
        "return Shares(reflected, 1.0 - jnp.where(total, 1.0, partial))",
        _TEST_STEP,
    ),
    Bug(
        "paper's reflection also at the second surface",
        _STEP,
        "first=state.num_bends == 0",
        "first=state.num_bends <= 1",
        ("optics/test_path_tracing.py::test_the_paper_reflects_once_at_the_first_surface",),
    ),
    Bug(
        "wrong normal for entering",
        _STEP,
        "outward = jnp.where(entering, 1.0, -1.0)",
        "outward = jnp.where(entering, -1.0, 1.0)",
        _TEST_STEP,
    ),
    Bug(
        "shading normal tells the sides",
        _STEP,
        "entering = numerics.dot(direction, point.geometric_normal)",
        "entering = numerics.dot(direction, point.shading_normal)",
        _TEST_STEP,
    ),
    Bug(
        "shading normal sends rays to the wrong side",
        _STEP,
        "below = jnp.maximum(-numerics.dot(direction, geometric_normal), 0.0)",
        "below = jnp.zeros_like(numerics.dot(direction, geometric_normal))",
        _TEST_STEP,
    ),
    Bug(
        "absorption adds light",
        "numerics.py",
        "decay = jnp.exp(-rate *",
        "decay = jnp.exp(rate *",
        ("optics/test_media.py::test_absorption_follows_beer_and_lambert",),
    ),
    Bug(
        "tint at the first surface only",
        _STEP,
        "throughput = state.throughput * passed * met.sides.tint",
        "throughput = state.throughput * passed "
        "* jnp.where(state.num_bends == 0, met.sides.tint, 1.0)",
        _TEST_TREE,
    ),
    Bug(
        "priority list not updated",
        _STEP,
        "interior_list=met.sides.interior_list_after",
        "interior_list=state.interior_list",
        ("optics/test_media_paths.py",),
    ),
    Bug(
        "part not taken off the priority list",
        _MEDIA,
        "without = jnp.where(interior_list == part, EMPTY_SLOT, interior_list)",
        "without = interior_list",
        _TEST_MEDIA,
    ),
    Bug(
        "lowest priority wins",
        _MEDIA,
        "return 1 + interior_list[jnp.argmax(",
        "return 1 + interior_list[jnp.argmin(",
        _TEST_MEDIA,
    ),
    Bug(
        "air around a nested part",
        "optics/interface_rules.py",
        "self.ambient if self.always or parent == NO_PARENT else inside[parent]",
        "self.ambient if self.always or parent == NO_PARENT else self.ambient",
        ("optics/test_interface_rules.py",),
    ),
    Bug(
        "tau not accumulated",
        _STEP,
        "tau=state.tau + arrival.length",
        "tau=arrival.length",
        ("optics/test_path_tracing.py::test_a_slab_shifts_light_sideways",),
    ),
    Bug(
        "weakest records are kept",
        "optics/path_tree.py",
        "jnp.where(mask, -strength, jnp.inf)",
        "jnp.where(mask, strength, jnp.inf)",
        ("optics/test_queues.py",),
    ),
    Bug(
        "dropped light is not counted",
        "optics/path_tree.py",
        "add(jnp.where(which[:, None], throughput, 0.0))",
        "add(jnp.where(which[:, None], 0.0, 0.0 * throughput))",
        ("optics/test_queues.py",),
    ),
    Bug(
        "interval lengths not in units of the scene",
        _VOLUME,
        "lengths = jnp.diff(edges) / config.radius",
        "lengths = jnp.diff(edges)",
        ("render/test_transport.py::test_weights_follow_from_densities_and_lengths",),
    ),
    Bug(
        "sub-spaces have equal shares in the weights",
        _VOLUME,
        "jnp.sum(each * blend.shares[None], axis=-1)",
        "jnp.mean(each, axis=-1)",
        ("render/test_sub_spaces.py::test_a_path_has_the_numbers_of_the_released_functions",),
    ),
    Bug(
        "a surface stops light that leaves it",
        "fields/neus.py",
        "jax.nn.relu(-cosine) * head_on",
        "jnp.abs(cosine) * head_on",
        ("fields/test_neus.py::test_a_ray_that_leaves_is_not_stopped",),
    ),
    Bug(
        "clear glass reflects what is not transmitted",
        "fields/nunerf.py",
        "through = clear * mirrored + (1.0 - clear) * refracted",
        "through = clear * refracted + (1.0 - clear) * mirrored",
        (
            "fields/test_nunerf.py::"
            "test_clear_glass_reflects_four_percent_head_on_and_everything_at_grazing_incidence",
        ),
    ),
    Bug(
        "transmittance includes the own sample",
        _VOLUME,
        "jnp.concatenate([jnp.zeros_like(depth[:1]), jnp.cumsum(depth[:-1])])",
        "jnp.cumsum(depth)",
        _TEST_COMPOSITING,
    ),
    Bug(
        "median distance at 0.4",
        _VOLUME,
        "jnp.full((1,), 0.5, weights",
        "jnp.full((1,), 0.4, weights",
        _TEST_COMPOSITING,
    ),
    Bug(
        "distortion inside the objects",
        _OBJECTIVE,
        "jnp.where(outside, final.weights, 0.0)",
        "jnp.where(outside, 0.0, final.weights)",
        _TEST_OBJECTIVE,
    ),
    Bug(
        "interlevel gradient reaches the final histogram",
        _OBJECTIVE,
        "edges, weights = jax.lax.stop_gradient(final)\n"
        "    below = stepfun.blurred_mass_below(proposal.edges, edges, weights, blur)\n"
        "    target = jax.lax.stop_gradient(jnp.diff(below))",
        "edges, weights = final\n"
        "    below = stepfun.blurred_mass_below(proposal.edges, edges, weights, blur)\n"
        "    target = jnp.diff(below)",
        _TEST_OBJECTIVE,
    ),
    Bug(
        "different vertices share a hash",
        _KERNELS,
        "(x ^ (y ^ z)) & jnp",
        "(x ^ (y ^ y)) & jnp",
        ("fields/test_hash_grid_kernels.py",),
    ),
    Bug(
        "different vertices share a row",
        _KERNELS,
        "side = resolution + 1",
        "side = resolution",
        ("fields/test_hash_grid_kernels.py",),
    ),
    Bug(
        "contraction begins at twice the radius",
        _BOUNDS,
        "positions = _from_centre(domain, gaussian.positions) / domain.radius",
        "positions = _from_centre(domain, gaussian.positions) / (2.0 * domain.radius)",
        _TEST_BOUNDS,
    ),
    Bug(
        "exit of the scene cube by its last face",
        _BOUNDS,
        "jnp.min(jnp.maximum(first, second))",
        "jnp.max(jnp.maximum(first, second))",
        _TEST_BOUNDS,
    ),
    Bug(
        "a knot belongs to the segment before",
        "sampling/polylines.py",
        "line.knots[1:] <= t",
        "line.knots[1:] < t",
        ("sampling/test_polylines.py",),
    ),
    Bug(
        "encoded before summed",
        "render/pixels.py",
        "return Light(linear, seen)",
        "return Light(srgb_to_linear(jax.ops.segment_sum(paths.throughput * "
        "linear_to_srgb(seen.composite.rgb), paths.rays, num_segments=rays)), seen)",
        (
            "render/test_pixels.py::"
            "test_the_paths_of_a_ray_are_blended_by_their_weights_in_linear_space",
        ),
    ),
    Bug(
        "rays through the corners of pixels",
        "geometry/cameras.py",
        "x = (column + 0.5 - 0.5 *",
        "x = (column - 0.5 *",
        ("data/test_cameras.py",),
    ),
    Bug(
        "no warm-up of the learning rate",
        "training/loop.py",
        "init_value=0.0",
        "init_value=schedule.peak",
        ("training/test_schedule.py",),
    ),
    Bug(
        "order of batches regardless of the seed",
        "data/batches.py",
        "key=[self._seed, number]",
        "key=[0, number]",
        ("data/test_batches.py",),
    ),
    Bug(
        "same order of batches in every epoch",
        "data/batches.py",
        "self._generator(int(each) + 1)",
        "self._generator(1)",
        ("data/test_batches.py",),
    ),
    Bug(
        "leaf of the tree skipped",
        "geometry/traversal.py",
        "leaf = jnp.where(leaf != 0, leaf, next_leaf)",
        "leaf = next_leaf",
        ("geometry/test_bvh.py::test_hits_of_random_rays_equal_brute_force",),
    ),
    Bug(
        "triangle of a leaf skipped",
        "geometry/traversal.py",
        "for offset in range(1, bvh.LEAF_SIZE)",
        "for offset in range(2, bvh.LEAF_SIZE)",
        ("geometry/test_bvh.py::test_hits_of_random_rays_equal_brute_force",),
    ),
    Bug(
        "normals weighted by one edge",
        "geometry/triangle_meshes.py",
        "return sines * factors * np.roll(factors, 1, axis=1)",
        "return sines * factors",
        ("geometry/test_corner_normals.py",),
    ),
    Bug(
        "spare rows of a tree lead to its beginning",
        "geometry/bvh_build.py",
        "tables[:, rows - 1 :, 6] = (octants + 1) * tables.shape[1] - 1",
        "tables[:, rows - 1, 6] = 0",
        ("geometry/test_bvh.py::test_the_spare_rows_of_a_tree_lead_to_its_end",),
    ),
    Bug(
        "slope of the radiance of the other axis",
        "reconstruct/photometry.py",
        "return jnp.stack([along(0), along(1)], axis=1)",
        "return jnp.stack([along(1), along(0)], axis=1)",
        _TEST_REFRACTION,
    ),
    Bug(
        "derivatives by normals left out",
        "reconstruct/gauss_newton.py",
        "turned @ by_normals",
        "0.0 * turned @ by_normals",
        _TEST_REFRACTION,
    ),
    Bug(
        "the best shape is chosen, however little better it is",
        "reconstruct/model_selection.py",
        "if worse.mean <= max(_WORSE * worse.error, level):",
        "if worse.mean <= max(0.0 * worse.error, _LEVEL):",
        (f"{_REFRACTION}::test_the_smallest_shape_within_two_standard_errors_is_chosen",),
    ),
    Bug(
        "rows of an image upwards",
        "geometry/cameras.py",
        "by_row = scale[:, None] * (-up + y[:, None] * back)",
        "by_row = scale[:, None] * (up + y[:, None] * back)",
        ("reconstruct/test_outlines.py",),
    ),
    Bug(
        "small pieces decide at a bevel",
        "geometry/triangle_meshes.py",
        "peer = size >= _PEER *",
        "peer = size <= _PEER *",
        ("geometry/test_corner_normals.py",),
    ),
    Bug(
        "light behind a splat is not divided by what passes it",
        "splats/rasterizer.py",
        "back.passing * colour - (total - prefix) / (1.0 - seen.alpha)",
        "back.passing * colour - (total - prefix)",
        ("splats/test_rasterizer.py",),
    ),
    Bug(
        "splats that share a place keep their opacity",
        "splats/training.py",
        "new = -jnp.expm1(jnp.log1p(-held) / count.astype(held.dtype))",
        "new = held",
        ("splats/test_training.py",),
    ),
)


def main(arguments: list[str]) -> None:
    del arguments
    if strange := set(_ONLY.value) - {bug.name for bug in BUGS}:
        raise app.UsageError(f"There is no bug {', '.join(sorted(strange))}.")
    chosen = [bug for bug in BUGS if not _ONLY.value or bug.name in _ONLY.value]
    print("| bug | caught | test that failed | s |")
    print("|---|---|---|---|")
    with tempfile.TemporaryDirectory(prefix="refref_jax_bugs_") as folder:
        with concurrent.futures.ThreadPoolExecutor(_JOBS.value) as pool:
            sound = pool.submit(_assert_sound, Path(folder), chosen)
            outcomes = list(pool.map(lambda bug: _try(Path(folder), bug), chosen))
        sound.result()
    if not _ONLY.value:
        _write(outcomes)
    missed = [found.name for found in outcomes if not found.caught]
    assert not missed, f"not caught: {', '.join(missed)}"


def _assert_sound(folder: Path, bugs: list[Bug]) -> None:
    """Asserts that the tests pass on a copy without bugs."""
    copy = _copy(folder / "sound")
    tests = sorted({test for bug in bugs for test in bug.tests})
    whole = [test for test in tests if "::" not in test]
    parts = [test for test in tests if "::" in test and test.split("::")[0] not in whole]
    ended = _run(copy, [*whole, *parts])
    assert ended.returncode == 0, f"tests fail without a bug:\n{ended.stdout[-2000:]}"


def _try(folder: Path, bug: Bug) -> Outcome:
    copy = _copy(folder / re.sub(r"\W+", "_", bug.name))
    module = copy / "refref_jax" / bug.file
    text = module.read_text()
    assert text.count(bug.old) == 1, f"{bug.name}: {bug.file} holds {bug.old!r} other than once"
    module.write_text(text.replace(bug.old, bug.new))
    begin = time.perf_counter()
    ended = _run(copy, bug.tests)
    seconds = time.perf_counter() - begin
    shutil.rmtree(copy)
    failed = re.search(r"^FAILED (?:tests/)?(.+?)(?: - |\[|$)", ended.stdout, re.MULTILINE)
    caught = ended.returncode == _FAILED and failed is not None
    test = failed[1] if failed else f"pytest ended with {ended.returncode}"
    print(f"| {bug.name} | {'yes' if caught else 'NO'} | {test} | {seconds:.0f} |", flush=True)
    return Outcome(bug.name, caught, test, seconds)


def _copy(target: Path) -> Path:
    """Copies the files of the working tree that git knows or does not ignore."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    listed = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True, check=True)
    for name in filter(None, listed.stdout.split("\0")):
        if (_ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(_ROOT / name, target / name)
    return target


def _run(copy: Path, tests: tuple[str, ...] | list[str]) -> subprocess.CompletedProcess:
    options = ["-x", "-q", "-p", "no:cacheprovider", "-m", "slow or not slow"]
    options += [f"tests/{test}" for test in tests]
    # Copies share what they compile; a bug compiles anew what it changes.
    shared = {"JAX_COMPILATION_CACHE_DIR": str(copy.parent / "compiled")}
    return subprocess.run(
        [sys.executable, "-m", "pytest", *options],
        cwd=copy,
        env=os.environ | shared,
        capture_output=True,
        text=True,
    )


def _write(outcomes: list[Outcome]) -> None:
    """Replaces the rows of the file of results; its header lines are edited by hand."""
    lines = _RESULTS.read_text().splitlines() if _RESULTS.exists() else []
    with _RESULTS.open("w", newline="") as file:
        file.writelines(f"{line}\n" for line in lines if line.startswith("# "))
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["bug", "caught", "test that failed", "seconds"])
        for found in outcomes:
            caught = "yes" if found.caught else "no"
            table.writerow([found.name, caught, found.test, round(found.seconds)])


if __name__ == "__main__":
    app.run(main)
