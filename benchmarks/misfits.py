"""Claim: the images tell if the far field is the surface that scene.json states.

    python -m benchmarks.misfits --scenes='experiments/data/cube_smcvx_ball,runs/scenes/*'

Prints, for each scene, the share of patches of the training images that differ from the surface,
in percent: with its size as stated, and with a wrong one. Asserted is that no scene differs from
its own surface. An environment has no size.
"""

from pathlib import Path

from absl import app, flags

from refref_jax.data.scene_analysis import MOST_MISFITS
from refref_jax.training import resolve
from refref_jax.training.config import SceneConfig

_SCENES = flags.DEFINE_list(
    "scenes", ["experiments/data/cube_smcvx_ball"], "Folders of scenes, or patterns."
)

_FACTORS = (1.0, 0.97, 1.01, 1.03)


def measure(folder: Path) -> list[float | None]:
    """Returns the share of patches that differ, for each factor of the size."""
    facts = resolve.read_facts(SceneConfig(str(folder)))
    if facts.misfits is None or not facts.stated:
        raise SystemExit(f"{folder} does not state its background. Choose another scene.")
    space, size = facts.analysis.space, facts.half_extent
    if size is None:
        return [facts.misfits(space=space, size=1.0, centre=facts.centre), None, None, None]
    return [
        facts.misfits(space=space, size=factor * size, centre=facts.centre) for factor in _FACTORS
    ]


def main(arguments: list[str]) -> None:
    del arguments
    folders = sorted(path for pattern in _SCENES.value for path in Path().glob(pattern))
    if not folders:
        raise SystemExit("--scenes names no folder. Render scenes with experiments.dataset.make.")
    rows = {folder.name: measure(folder) for folder in folders}
    print(",".join(["scene", *(f"size_times_{factor:g}" for factor in _FACTORS)]))
    for name, shares in rows.items():
        print(",".join([name, *("" if x is None else f"{100.0 * x:.3f}" for x in shares)]))
    for name, shares in rows.items():
        assert shares[0] is not None and shares[0] <= MOST_MISFITS, f"{name}: {shares[0]:.2%}"


if __name__ == "__main__":
    app.run(main)
