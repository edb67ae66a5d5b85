"""Recommendations from a table, where nothing is trained, and from a trial of a backdrop."""

import dataclasses
import re

import numpy as np
import pytest

from experiments.runs.measured_runs import Training
from experiments.sweeps import backdrop_trial, far_fields, recommend, table
from experiments.sweeps.backdrop_trial import Setting, Trial
from experiments.sweeps.recommend import Machine
from refref_jax.render.backdrop import Lookups
from refref_jax.training.backdrop_equations import Block
from tests.factories.cut_ball import cut_ball
from tests.factories.made_rows import made_row
from tests.processes.command import ROOT, run_command

pytestmark = pytest.mark.loose

# Twice as fast as the table's machine; both commands together start for 20 s.
_MACHINE = Machine(ratio=0.5, startup=10.0, images=20)

# 1000 steps, 20 images of 1 s: 0.5 * (1000 * pace + 20) + 20 seconds.
_ROWS = [
    made_row("steps=250", pace=0.1, steps=250, quality=20.0),
    made_row("base", pace=0.1, quality=25.0),
    made_row("max_res=64", pace=0.12, quality=22.0),
    made_row("samples_per_ray=48+30", pace=0.2, quality=27.0),
]


@pytest.mark.parametrize(
    ("seconds", "cheaper", "best", "dearer"),
    [
        (45.0, None, "steps=250", "base"),
        (80.1, "steps=250", "base", "samples_per_ray=48+30"),
        (129.0, "steps=250", "base", "samples_per_ray=48+30"),
        (1e6, "base", "samples_per_ray=48+30", None),
    ],
)
def test_the_best_that_fits_is_chosen(seconds, cheaper, best, dearer):
    choice = recommend.choose(_ROWS, _MACHINE, seconds)
    names = [row and row.name for row in (choice.cheaper, choice.best, choice.dearer)]
    assert names == [cheaper, best, dearer]
    assert recommend.seconds_of(_ROWS[1], _MACHINE) == pytest.approx(80.0)
    # 0.5 * (25 + 20) + 20 = 42.5 s.
    with pytest.raises(ValueError, match=r"less than 0\.7 minutes here \(steps=250\)"):
        recommend.choose(_ROWS, _MACHINE, 42.0)


def test_noise_decides_nothing():
    rows = [
        made_row("base", pace=0.1, quality=25.0),
        made_row("max_res=64", pace=0.09, quality=24.9),
        made_row("max_res=256", pace=0.3, quality=25.2),
    ]
    # A point that is as good and takes less time is better, unless the time is the same.
    choice = recommend.choose(rows, _MACHINE, 1e6)
    assert (choice.best.name, choice.cheaper, choice.dearer) == ("max_res=64", None, None)
    near = [rows[0], made_row("max_res=64", pace=0.0995, quality=24.9)]
    assert recommend.choose(near, _MACHINE, 1e6).best.name == "base"


def test_turns_are_combined_when_there_is_time_and_that_is_said(tmp_path):
    rows = [
        made_row("base", pace=0.1, quality=25.0, evaluation="--rays_per_pixel=1"),
        made_row("samples_per_ray=48+30", pace=0.2, quality=27.0),
        made_row("samples_per_ray=64+40", pace=0.3, quality=27.5),
        made_row("log2_hashmap_size=19", pace=0.15, quality=26.0),
        made_row("log2_hashmap_size=20", pace=0.15, quality=25.1),
        made_row("steps=2000", pace=0.1, steps=2000, quality=25.5),
        made_row("rays_per_pixel=4", quality=28.0, evaluation="--rays_per_pixel=4"),
    ]
    choice = recommend.choose(rows, _MACHINE, 1e6)
    together = choice.combined
    assert set(together.name.split()) >= {"log2_hashmap_size=19", "steps=2000", "rays_per_pixel=4"}
    assert together.steps == 2000 and together.evaluation == "--rays_per_pixel=4"
    # 2 or 2.5 of samples, 1 of entries, 0.5 of steps, 3 of rays.
    assert together.quality == pytest.approx(25.0 + 2.0 + 1.0 + 0.5 + 3.0, abs=0.51)
    assert "--steps=2000" in together.training and "--log2_hashmap_size=19" in together.training
    assert (
        together.training.count("--steps") == 1
        and "--log2_hashmap_size=20" not in together.training
    )
    text = " ".join(recommend.describe(choice, _MACHINE, tmp_path))
    assert "not measured together" in text
    tight = recommend.seconds_of(rows[-1], _MACHINE)
    assert recommend.choose(rows, _MACHINE, tight + 0.1).combined is None


def test_the_machine_is_compared_by_the_base():
    timing = Training(96, 0.3, 3413.0, 60.0, 31.0, 900.0, None)
    machine = recommend.compare(timing, made_row(pace=0.1), 40)
    assert machine.ratio == pytest.approx(3.0)
    assert machine.startup == 31.0 and machine.images == 40


def test_the_bundled_table_is_a_whole_sweep():
    rows = table.read(ROOT / "experiments" / "data" / "trade_off.csv")
    assert {row.scene for row in rows} == {"cube_smcvx_ball"}
    assert {row.option for row in rows} >= {
        "",
        "paths",
        "min_throughput",
        "samples_per_ray",
        "steps",
        "rays_per_pixel",
    }
    # It would be compared with a training of other samples, which the scene decides.
    assert all("--samples_per_ray=" in row.training for row in rows)
    choice = recommend.choose(rows, _MACHINE, 600.0)
    assert choice.best.quality > 30.0


def test_what_is_told_can_be_pasted(tmp_path):
    rows = [made_row("base", evaluation="--rays_per_pixel=4")]
    choice = recommend.choose(rows, _MACHINE, 1e6)
    blank = "\n".join(recommend.describe(choice, _MACHINE, tmp_path / "my ball"))
    assert f"'--scene={tmp_path / 'my ball'}' '--out=runs/my ball'" in blank
    text = "\n".join(recommend.describe(choice, _MACHINE, tmp_path / "ball"))
    train = f"python -m experiments.train --scene={tmp_path / 'ball'} --out=runs/ball"
    assert f"{train} --preset=tiny --steps=1000" in text
    assert "experiments.evaluate --run=runs/ball --split=test --rays_per_pixel=4" in text
    assert "1.3 minutes, 25.0 dB" in text


def test_a_missing_table_is_named(tmp_path):
    scene = ROOT / "experiments" / "data" / "cube_smcvx_ball"
    options = (f"--scene={scene}", "--minutes=5", f"--table={tmp_path / 'none.csv'}")
    result = run_command("recommend", *options, fails=True)
    assert "none.csv" in result.stderr and "experiments.trade_off" in result.stderr
    assert "Traceback" not in result.stderr


def test_a_table_of_a_backdrop_is_timed_by_its_iterations(tmp_path, monkeypatch):
    training = "--far_field=backdrop --paths=tree --iterations=32"
    base = dataclasses.replace(made_row(pace=1.0, steps=32), training=training, train_seconds=60.0)
    asked = {}

    def train(run, *, scene, options, log_every):
        asked["options"] = options
        return Training(8, 3.0, None, 40.0, 10.0, None, None)

    monkeypatch.setattr(recommend.measured_runs, "train", train)
    timing = recommend.time_machine(tmp_path, base, 96)
    assert asked["options"] == ["--far_field=backdrop", "--paths=tree", "--iterations=8"]
    machine = recommend.compare(timing, base, 20)
    # Three times as slow: 60 s of training, 20 images of 1 s, and two startups of 10 s.
    assert recommend.seconds_of(base, machine) == pytest.approx(3.0 * (60.0 + 20.0) + 20.0)
    eight = dataclasses.replace(
        made_row("iterations=48", pace=1.0, steps=48, quality=26.0),
        training=training.replace("32", "48"),
        train_seconds=80.0,
    )
    both = recommend.combine([base, eight], lambda row: recommend.seconds_of(row, machine), 1e6)
    assert (both.steps, both.train_seconds) == (48, 80.0) and "--iterations=48" in both.training


# 40 views of 0.1 s; an iteration of 40 * 0.02 s for the views and 0.2 s for the grid of 256 cells.
_TRIAL = Trial(
    startup=5.0,
    compiling=10.0,
    view=0.1,
    iteration=0.02,
    grid=0.2,
    image=0.5,
    views=40,
    images=20,
    resolution=256,
)


def test_seconds_of_a_backdrop_are_reckoned_from_the_trial():
    training, evaluating = backdrop_trial.seconds_of(Setting(256, 32, 9), _TRIAL)
    assert training == pytest.approx(5.0 + 10.0 + 4.0 + 32 * 1.0)
    assert evaluating == pytest.approx(5.0 + 20 * 9 * 0.5)
    # A quarter of the cells.
    training, _ = backdrop_trial.seconds_of(Setting(128, 8, 1), _TRIAL)
    assert training == pytest.approx(19.0 + 8 * 0.85)


@pytest.mark.parametrize("resolution", [64, 128, 192, 384, 1472])
def test_settings_cost_more_from_one_to_the_next(resolution):
    trial = dataclasses.replace(_TRIAL, resolution=resolution)
    found = backdrop_trial.settings(resolution)
    costs = [sum(backdrop_trial.seconds_of(each, trial)) for each in found]
    assert costs == sorted(costs) and len(set(costs)) == len(found)
    assert found[-1] == Setting(resolution, 32, 9)
    assert all(each.backdrop_resolution % 64 == 0 for each in found)


def test_the_best_setting_that_fits_is_chosen():
    whole = backdrop_trial.choose(_TRIAL, 1e6)
    assert whole.best == Setting(256, 32, 9) and whole.dearer is None
    tight = sum(backdrop_trial.seconds_of(whole.best, _TRIAL)) - 0.1
    choice = backdrop_trial.choose(_TRIAL, tight)
    assert choice.best == whole.cheaper and choice.dearer == whole.best
    # 5 + 10 + 4 + 8 * 0.85 s of training, 5 + 20 * 0.5 s of evaluation.
    with pytest.raises(ValueError, match=r"less than 0\.7 minutes here \(128 cells per side, 8"):
        backdrop_trial.choose(_TRIAL, 40.7)
    cheapest = backdrop_trial.choose(_TRIAL, 41.0)
    assert cheapest.cheaper is None and cheapest.best == Setting(128, 8, 1)
    assert "1 ray per pixel" in cheapest.best.words()


def test_the_command_of_a_backdrop_can_be_pasted(tmp_path):
    choice = backdrop_trial.choose(_TRIAL, 1e6)
    text = "\n".join(backdrop_trial.describe(choice, _TRIAL, tmp_path / "ball"))
    assert "an iteration takes 1.00 s at 256 cells per side" in text
    train = f"python -m experiments.train --scene={tmp_path / 'ball'} --out=runs/ball"
    assert f"{train} --far_field=backdrop --backdrop_resolution=256 --iterations=32" in text
    assert "experiments.evaluate --run=runs/ball --split=test --rays_per_pixel=9" in text
    assert "about 2.4 minutes (51 s of training, 95 s for 20 test images)" in text
    assert "Dearer: more cells or iterations hardly gain anything." in text


def test_a_cell_is_as_wide_as_the_median_pixel():
    # Three pixels of 0.5, 2 and 8 cells of a surface of 256: the last reads a level of 64 cells.
    widths, sides = np.array([0.5, 2.0, 2.0]), np.array([256, 256, 64])
    taps = np.array([[1, 1], [2, 1], [1, 1]])
    steps = np.zeros((3, 2, 2))
    steps[:, 0, 1] = widths / taps[:, 0]
    steps[:, 1, 0] = 0.1 * widths / taps[:, 1]
    lookups = Lookups(*([None] * 2), sides, taps, None, steps, None, None)
    blocks = [Block(lookups, *([None] * 5))]
    assert backdrop_trial.resolution_of(blocks, 256) == 128
    tiny = [Block(lookups._replace(steps=0.0 * steps), *([None] * 5))]
    assert backdrop_trial.resolution_of(tiny, 256) == 4096
    wide = [Block(lookups._replace(steps=1e3 * steps), *([None] * 5))]
    assert backdrop_trial.resolution_of(wide, 256) == 64


@pytest.mark.slow
def test_a_trial_times_each_part_of_a_training(tmp_path):
    scene = cut_ball(tmp_path / "cube_smcvx_ball")
    resolved, objects = far_fields.prepare(scene, {})
    assert "backdrop (behind the objects is the cube" in far_fields.describe(resolved)
    trial = backdrop_trial.try_out(resolved, objects, startup=3.0, images=7)
    assert (trial.startup, trial.images) == (3.0, 7)
    times = (trial.view, trial.iteration, trial.image, trial.compiling)
    assert all(0.0 < each < 100.0 for each in times) and trial.grid >= 0.0
    assert trial.resolution % 64 == 0 and trial.views > 1
    assert backdrop_trial.choose(trial, 1e6).best.iterations == 32


def test_a_far_field_that_the_table_lacks_is_named():
    scene = ROOT / "experiments" / "data" / "cube_smcvx_ball"
    bundled = ROOT / "experiments" / "data" / "trade_off.csv"
    options = (f"--scene={scene}", "--minutes=5", f"--table={bundled}", "--far_field=backdrop")
    result = run_command("recommend", *options, fails=True)
    assert re.search(r"--far_field=backdrop, but the base of .* has a field", result.stderr)
