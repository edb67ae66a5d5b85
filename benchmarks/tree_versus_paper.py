"""Claim: with the same training, the path tree beats the paper's paths in masked PSNR.

    python -m benchmarks.tree_versus_paper [--scenes=FOLDER,FOLDER] [--curve_steps=500,1000,2500]

Trains both on the same scenes, pixels and steps, evaluates both on the test split, and prints a
table. With --curve_steps both are also trained for each of those numbers of steps, separately since
the learning rate schedule depends on them, and the gap over steps is drawn.

Asserted are a higher masked PSNR of the tree on every scene; an average margin of 2.5 dB, if the
scenes are all four of the ball, torus, flask and pyramid and the training is the full one of the
preset `tiny`; and a larger mean gap after the most steps of the curve than after the fewest.
Finished trainings are reused.
"""

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from absl import app, flags

from experiments.figures.style import pyplot, style
from experiments.runs import measured_runs
from experiments.runs.measured_runs import Evaluation, Training
from refref_jax.training.presets import PRESETS

_SCENES = flags.DEFINE_list("scenes", ["experiments/data/cube_smcvx_ball"], "Folders of scenes.")
_PRESET = flags.DEFINE_enum("preset", "tiny", list(PRESETS), "Preset of all trainings.")
_STEPS = flags.DEFINE_integer("steps", None, "Training steps; the preset's if not given.", 1)
_CURVE_STEPS = flags.DEFINE_list("curve_steps", [], "Numbers of steps of the curve.")
_INTERIOR = flags.DEFINE_string("interior", "auto", "Interior model of all trainings.")
_RAYS_PER_PIXEL = flags.DEFINE_integer("rays_per_pixel", 4, "Rays per pixel in evaluation.", 1)
_LIMIT = flags.DEFINE_integer(
    "limit", None, "Number of test images, evenly spaced; all if not given.", 1
)
_OUT = flags.DEFINE_string("out", "runs/tree_versus_paper", "Output folder of the runs.")

_OBJECTS = {"ball", "torus", "flask", "pyramid"}
_MEAN_GAIN = 2.5


class Duel(NamedTuple):
    """Both trainings of a scene, and their results.

    Attributes:
      scene: name of its folder.
      steps: number of steps of both.
      cost: cost of the paper's training and of the tree's.
      result: result of the paper's and of the tree's evaluation.
    """

    scene: str
    steps: int
    cost: tuple[Training, Training]
    result: tuple[Evaluation, Evaluation]

    @property
    def gain(self) -> float:
        """Gain of the tree over the paper's paths in masked PSNR, dB."""
        return self.result[1].psnr_masked - self.result[0].psnr_masked


def main(arguments: list[str]) -> None:
    del arguments
    full = _STEPS.value or PRESETS[_PRESET.value].schedule.steps
    scenes = [Path(scene) for scene in _SCENES.value]
    counts = sorted({full, *map(int, _CURVE_STEPS.value)})
    for scene in scenes:
        measured_runs.check_masks(scene)
    duels = [fight(scene, steps) for steps in counts for scene in scenes]
    print(table(duels))
    if len(counts) > 1:
        image = Path(_OUT.value) / "tree_versus_paper.png"
        draw(image, duels)
        print(f"\nCurve: {image}")
    check(duels, full=full, tiny=_PRESET.value == "tiny" and _STEPS.value is None)


def fight(scene: Path, steps: int) -> Duel:
    """Trains and evaluates both on a scene; finished runs are reused."""
    looks = [f"--rays_per_pixel={_RAYS_PER_PIXEL.value}"]
    if _LIMIT.value is not None:
        looks.append(f"--limit={_LIMIT.value}")
    costs, results = [], []
    for paths in ("paper", "tree"):
        name = f"{_PRESET.value}_{_INTERIOR.value}_{paths}_{steps}"
        run = Path(_OUT.value) / scene.resolve().name / name
        options = [f"--preset={_PRESET.value}", f"--interior={_INTERIOR.value}"]
        options += [f"--paths={paths}", f"--steps={steps}"]
        print(f"{scene.resolve().name}: {paths}, {steps} steps ...", flush=True)
        costs.append(measured_runs.train(run, scene=scene, options=options))
        results.append(measured_runs.evaluate(run, scene=scene, options=looks))
    return Duel(scene.resolve().name, steps, tuple(costs), tuple(results))


def table(duels: Sequence[Duel]) -> str:
    """Returns all duels as a Markdown table."""
    lines = [
        "",
        "| scene | steps | paper: PSNR / in mask | tree: PSNR / in mask | gain in mask "
        "| training, s: paper, tree |",
        "|---|---|---|---|---|---|",
    ]
    for duel in duels:
        paper, tree = (f"{each.psnr:.2f} / {each.psnr_masked:.2f}" for each in duel.result)
        seconds = ", ".join(f"{each.train_seconds:.0f}" for each in duel.cost)
        lines.append(
            f"| {duel.scene} | {duel.steps} | {paper} | {tree} | {duel.gain:+.2f} | {seconds} |"
        )
    lines += [
        f"| mean | {steps} | | | {mean_gain(duels, steps):+.2f} | |"
        for steps in dict.fromkeys(duel.steps for duel in duels)
    ]
    return "\n".join(lines)


def mean_gain(duels: Sequence[Duel], steps: int) -> float:
    """Returns the mean gain over scenes after the given steps."""
    return statistics.mean(duel.gain for duel in duels if duel.steps == steps)


def draw(path: Path, duels: Sequence[Duel]) -> None:
    """Draws the gain over steps, one line per scene and one for their mean."""
    figure, axis = pyplot.subplots(figsize=(7.0, 4.5), layout="constrained")
    for scene in dict.fromkeys(duel.scene for duel in duels):
        own = [duel for duel in duels if duel.scene == scene]
        axis.plot([d.steps for d in own], [d.gain for d in own], "-o", label=scene)
    steps = list(dict.fromkeys(duel.steps for duel in duels))
    axis.plot(steps, [mean_gain(duels, n) for n in steps], "--", color="black", label="mean")
    axis.axhline(0.0, color="#999999", linewidth=0.8)
    axis.set_xscale("log")
    axis.set_xticks(steps, map(str, steps))
    axis.minorticks_off()
    axis.set_xlabel("training steps")
    axis.set_ylabel("tree over paper inside the mask, dB")
    style(axis)
    axis.legend(frameon=False)
    figure.savefig(path, dpi=130)
    pyplot.close(figure)


def check(duels: Sequence[Duel], *, full: int, tiny: bool) -> None:
    """Asserts the claim, as far as the given scenes and steps allow."""
    final = [duel for duel in duels if duel.steps == full]
    for duel in final:
        assert duel.gain > 0.0, f"the tree does not beat the paper on {duel.scene}"
    objects = {duel.scene.rpartition("_")[2] for duel in final}
    if tiny and objects == _OBJECTS:
        assert mean_gain(final, full) >= _MEAN_GAIN
    counts = sorted({duel.steps for duel in duels})
    if len(counts) > 1:
        assert mean_gain(duels, counts[-1]) > mean_gain(duels, counts[0])


if __name__ == "__main__":
    app.run(main)
