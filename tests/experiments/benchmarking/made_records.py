"""Results of jobs whose tables can be reckoned by hand."""

from experiments.benchmarking import plan, results
from experiments.benchmarking.methods import METHODS
from experiments.benchmarking.results import Costs, Image, Record
from experiments.benchmarking.settings import Settings

SETTINGS = Settings(preset="tiny", steps=6, limit=None, rays_per_pixel=1, seed=0, lpips=None)


def made_record(scene, method, **metrics):
    """A result with some metrics, and one image of the same."""
    category, background = results.category_and_background(scene)
    return Record(
        scene=scene,
        category=category,
        background=background,
        method=method,
        fingerprint="",
        options=plan.options(method, METHODS[method].train if method in METHODS else (), SETTINGS),
        settings=SETTINGS,
        metrics=metrics,
        per_image=[Image("r_0", 0.1, None, metrics)],
        costs=Costs(),
        versions={},
        views=[],
        scene_path="/nowhere",
        facts={},
    )
