"""Results of jobs whose tables can be reckoned by hand."""

import dataclasses

from experiments.benchmarking import records
from experiments.benchmarking.records import Record
from experiments.benchmarking.settings import Settings

SETTINGS = Settings(preset="tiny", steps=6, limit=None, rays_per_pixel=1, seed=0, lpips=None)


def made_record(scene, method, **metrics):
    """A result with some metrics, and one image of the same."""
    category, background = records.category_and_background(scene)
    return Record(
        scene=scene,
        category=category,
        background=background,
        method=method,
        options={"train": [], "evaluate": []},
        settings=dataclasses.asdict(SETTINGS),
        metrics=metrics,
        per_image=[{"name": "r_0", "pose_distance": 0.1, **metrics}],
        costs={},
        versions={},
        views=[],
        scene_path="/nowhere",
        facts={},
    )
