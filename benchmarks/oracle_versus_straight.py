"""Claim: with the same training, the oracle clearly beats a straight NeRF in masked PSNR.

    python -m benchmarks.oracle_versus_straight [--scene=FOLDER] [--steps=N] [--out=DIR]

Trains both on the same scene, pixels and steps, evaluates both on the test split, prints a table
and asserts the margins: 8 dB masked PSNR and 5 dB PSNR on the bundled scene, and a positive masked
margin on any other.
"""

from pathlib import Path

from absl import app, flags

from experiments.runs import measured_runs

_BUNDLED = "cube_smcvx_ball"

_SCENE = flags.DEFINE_string("scene", f"experiments/data/{_BUNDLED}", "Folder of the scene.")
_PRESET = flags.DEFINE_string("preset", "tiny", "Preset of both trainings.")
_STEPS = flags.DEFINE_integer("steps", None, "Training steps; the preset's if not given.")
_INTERIOR = flags.DEFINE_string("interior", "field", "Interior model of both trainings.")
_OUT = flags.DEFINE_string("out", "runs/oracle_versus_straight", "Output folder of the runs.")

_METHODS = {"straight": "straight", "oracle": "paper"}


def main(arguments: list[str]) -> None:
    del arguments
    scene = Path(_SCENE.value)
    results = {name: _measure(scene, name, paths) for name, paths in _METHODS.items()}
    _print_table(scene.name, results)
    masked = results["oracle"]["psnr_masked"] - results["straight"]["psnr_masked"]
    whole = results["oracle"]["psnr"] - results["straight"]["psnr"]
    print(f"Margin of the oracle: {masked:+.2f} dB masked PSNR, {whole:+.2f} dB PSNR")
    assert masked > 0.0, "the oracle does not beat the straight model in masked PSNR"
    if scene.name == _BUNDLED:
        assert results["oracle"]["psnr_masked"] >= 24.0
        assert masked >= 8.0
        assert whole >= 5.0


def _measure(scene: Path, name: str, paths: str) -> dict[str, float]:
    """Trains and evaluates one method; a finished run is reused."""
    run = Path(_OUT.value) / scene.resolve().name / name
    options = [f"--preset={_PRESET.value}", f"--interior={_INTERIOR.value}", f"--paths={paths}"]
    if _STEPS.value:
        options.append(f"--steps={_STEPS.value}")
    print(f"{scene.resolve().name}: {name} ...", flush=True)
    cost = measured_runs.train(run, scene=scene, options=options)
    return vars(cost) | vars(measured_runs.evaluate(run, scene=scene))


def _print_table(scene: str, results: dict[str, dict[str, float]]) -> None:
    print(f"\n| {scene} | steps | PSNR | PSNR in mask | SSIM | training, s |")
    print("|---|---|---|---|---|---|")
    for name, row in results.items():
        print(
            f"| {name} | {row['steps']} | {row['psnr']:.2f} | {row['psnr_masked']:.2f} "
            f"| {row['ssim']:.3f} | {row['train_seconds']:.0f} |"
        )
    print()


if __name__ == "__main__":
    app.run(main)
