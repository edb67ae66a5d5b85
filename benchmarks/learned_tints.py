"""Claim: learned tints beat a learned volume inside coloured glass, and match the true colours.

    python -m benchmarks.learned_tints --scene=FOLDER [--steps=N] [--rays_per_pixel=N]

Trains a tinted scene along the path tree twice, with the same pixels and steps: once with the
paper's field inside the objects, once with learned tints and absorption, without known values.
Asserts that the learned colours give the higher masked PSNR, and that every tint is within 0.05 of
the one in `scene.json`.
"""

import json
from pathlib import Path

import numpy as np
from absl import app, flags

from experiments.runs import measured_runs
from refref_jax.data import meshes

_SCENE = flags.DEFINE_string("scene", None, "Folder of a tinted scene.", required=True)
_PRESET = flags.DEFINE_string("preset", "tiny", "Preset of both trainings.")
_STEPS = flags.DEFINE_integer("steps", None, "Training steps; the preset's if not given.")
_RAYS_PER_PIXEL = flags.DEFINE_integer("rays_per_pixel", 4, "Rays per pixel in evaluation.")
_OUT = flags.DEFINE_string("out", "runs/learned_tints", "Output folder of the runs.")

_INTERIORS = {
    "field": ["--interior=field"],
    "learned": ["--interior=absorbing", "--tints=learned"],
}

_TOLERANCE = 0.05


def main(arguments: list[str]) -> None:
    del arguments
    scene = Path(_SCENE.value)
    measured_runs.check_masks(scene)
    results = {name: _measure(scene, name, options) for name, options in _INTERIORS.items()}
    print("| interior | PSNR | PSNR in mask | ms a step |")
    print("|---|---|---|---|")
    for name, row in results.items():
        pace = 1e3 * row["seconds_per_step"]
        print(f"| {name} | {row['psnr']:.2f} | {row['psnr_masked']:.2f} | {pace:.0f} |")
    error = _print_tints(scene, _run(scene, "learned"))
    assert results["learned"]["psnr_masked"] > results["field"]["psnr_masked"]
    assert error <= _TOLERANCE, f"a tint is {error:.3f} off"


def _run(scene: Path, name: str) -> Path:
    return Path(_OUT.value) / scene.resolve().name / name


def _measure(scene: Path, name: str, options: list[str]) -> dict[str, float]:
    """Trains and evaluates one interior; a finished run is reused."""
    options = [f"--preset={_PRESET.value}", "--paths=tree", *options]
    if _STEPS.value:
        options.append(f"--steps={_STEPS.value}")
    print(f"{scene.resolve().name}: interior {name} ...", flush=True)
    run = _run(scene, name)
    cost = measured_runs.train(run, scene=scene, options=options)
    looks = [f"--rays_per_pixel={_RAYS_PER_PIXEL.value}"]
    return vars(cost) | vars(measured_runs.evaluate(run, scene=scene, options=looks))


def _print_tints(scene: Path, run: Path) -> float:
    """Prints learned and true tints; returns the largest difference."""
    summary = json.loads((run / "eval" / "test" / "metrics.json").read_text("utf-8"))
    learned = np.array(summary["learned"]["tints"])
    parts = meshes.read_meshes(scene)
    print("\n| part | learned tint | in scene.json | learned absorption |")
    print("|---|---|---|---|")
    for part, tint, absorption in zip(
        parts, learned, summary["learned"]["absorptions"], strict=True
    ):
        columns = (" ".join(f"{x:.3f}" for x in row) for row in (tint, part.tint, absorption))
        print(f"| {part.name} | {' | '.join(columns)} |")
    return float(np.max(np.abs(learned - np.array([part.tint for part in parts]))))


if __name__ == "__main__":
    app.run(main)
