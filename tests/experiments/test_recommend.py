"""Recommendations from a table; nothing is trained here."""

import pytest

from experiments.runs.measured_runs import Training
from experiments.sweeps import recommend, table
from experiments.sweeps.recommend import Machine
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
