"""The sweep: its points, its table, and what it makes of measurements. Nothing is trained here."""

import dataclasses
import json
import subprocess

import imageio.v3 as iio
import pytest

from experiments.runs import measured_runs, subprocesses
from experiments.runs.subprocesses import RunFailedError
from experiments.sweeps import far_fields, report, sweep, table
from experiments.sweeps import options as sweep_options
from experiments.sweeps import points as trade_points
from experiments.sweeps.points import BASE
from tests.factories.made_rows import made_row
from tests.processes.command import ROOT, run_command

pytestmark = pytest.mark.loose

_SCENE = ROOT / "experiments" / "data" / "cube_smcvx_ball"


def test_every_point_changes_one_option_of_the_base():
    base, *others = trade_points.sweep(preset="tiny", base={"interior": "clear"})
    assert base.name == BASE and "--interior=clear" in base.training
    for point in others:
        ours, theirs = (set(p.training) | set(p.evaluation) for p in (base, point))
        if point.name == "paths=straight":  # which has no inside
            ours.remove("--interior=clear")
        assert len(theirs - ours) == 1 and len(ours - theirs) <= 1, point.name
        assert f"--{point.option}={point.value}" in theirs


def test_no_point_is_the_base_and_none_comes_twice():
    points = trade_points.sweep(preset="tiny")
    options = [(p.training, p.evaluation) for p in points]
    assert len(set(options)) == len(options)
    names = {point.name for point in points}
    # What the preset, the path settings and evaluation have anyway.
    assert not names & {
        "samples_per_ray=32+20",
        "min_throughput=0.02",
        "paths=tree",
        "max_bends=24",
    }
    assert names >= {"samples_per_ray=48+30", "precision=bfloat16", "rays_per_pixel=4"}
    equal = {"min_throughput": ("0.020", "0.1"), "samples_per_ray": ("32, 20",)}
    points = trade_points.sweep(
        preset="tiny", values=equal, vary=["min_throughput", "samples_per_ray"]
    )
    assert [point.name for point in points] == [BASE, "min_throughput=0.1"]


def test_a_sweep_may_be_around_another_base():
    points = trade_points.sweep(
        preset="tiny",
        base={"field": "nerfacto"},
        vary=["samples_per_ray", "log2_hashmap_size", "footprint"],
    )
    names = {point.name for point in points}
    assert {"samples_per_ray=24+12+8", "log2_hashmap_size=18", "footprint=differential"} <= names
    assert not names & {"samples_per_ray=48+24+16", "log2_hashmap_size=17", "footprint=cone"}
    # Straight light has neither a cut nor bends.
    points = trade_points.sweep(
        preset="tiny", base={"min_throughput": "0.05"}, vary=["paths", "max_bends"]
    )
    straight = next(point for point in points if point.name == "paths=straight")
    assert not [
        word for word in straight.training if "min_throughput" in word or "max_bends" in word
    ]
    points = trade_points.sweep(preset="tiny", base={"paths": "straight"})
    assert not {"min_throughput", "max_bends"} & {point.option for point in points}


def test_rays_per_pixel_are_evaluations_alone():
    points = {point.name: point for point in trade_points.sweep(preset="tiny")}
    nine = points["rays_per_pixel=9"]
    assert nine.training == points[BASE].training and nine.evaluation == ("--rays_per_pixel=9",)
    names = {name: sweep.run_name(point, _SCENE) for name, point in points.items()}
    assert names["rays_per_pixel=9"] == names[BASE]  # trained once
    assert len(set(names.values())) == len(names) - 2
    assert sweep.run_name(points[BASE], ROOT) != names[BASE]


def test_around_a_backdrop_its_own_options_are_varied():
    base, *others = trade_points.sweep_backdrop(base={"backdrop_resolution": "64"})
    assert base.training[0] == "--far_field=backdrop"
    assert not [word for word in base.training if "preset" in word or "steps" in word]
    assert {point.option for point in others} >= {"backdrop_resolution", "iterations", "paths"}
    # The defaults of a backdrop are not tried again, unless the base has others.
    names = {point.name for point in others}
    assert "backdrop_resolution=256" in names and "iterations=16" in names
    assert not names & {"backdrop_resolution=64", "iterations=32", "rays_per_pixel=1"}
    field = next(point for point in others if point.name == "far_field=field")
    assert "--far_field=field" in field.training
    assert not [word for word in field.training if "backdrop" in word]
    nine = next(point for point in others if point.name == "rays_per_pixel=9")
    assert nine.training == base.training and nine.evaluation == ("--rays_per_pixel=9",)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"base": {"preset": "small"}}, "Use --preset"),
        ({"base": {"far_field": "field"}}, "Use --far_field"),
        ({"base": {"multisamples": "6"}}, "multisamples is an option of a field"),
        ({"values": {"max_res": ("64",)}}, "max_res is an option of a field"),
        ({"base": {"paths": "straight"}}, "not solved along straight rays"),
        ({"vary": ["iteration"]}, "Did you mean iterations"),
    ],
)
def test_what_a_backdrop_does_not_read_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        trade_points.sweep_backdrop(**options)


def test_the_far_field_follows_from_options_or_an_earlier_table(tmp_path):
    assert far_fields.of_options(["paths", "rays_per_pixel"]) is None
    assert far_fields.of_options(["paths", "steps"]) == "field"
    assert far_fields.of_options(["iterations"]) == "backdrop"
    assert far_fields.of_table(tmp_path) is None
    for row, expected in ((made_row(), "field"), (_backdrop_row(), "backdrop")):
        table.write(tmp_path / "trade_off.csv", [row])
        assert far_fields.of_table(tmp_path) == expected


def test_a_sweep_is_of_what_training_would_choose(tmp_path):
    options = (f"--scene={_SCENE}", f"--out={tmp_path / 'sweep'}", "--dry_run")
    told = run_command("trade_off", *options, "--points=iterations=16").stdout
    assert told.splitlines()[1].split() == [
        *("iterations=16", "--far_field=backdrop", "--seed=0", "--paths=tree", "--iterations=16")
    ]
    told = run_command("trade_off", *options, "--points=rays_per_pixel=4").stdout
    assert "Far field: backdrop (behind the objects is the cube that scene.json states" in told
    told = run_command("trade_off", *options, "--steps=9", "--points=max_bends=6").stdout
    assert told.splitlines()[0].startswith("base ") and "--preset=tiny --seed=0 --steps=9" in told
    wrong = run_command("trade_off", *options, "--far_field=backdrop", "--steps=9", fails=True)
    assert "--steps is an option of a field" in wrong.stderr


def _backdrop_row(name="base", *, seconds=60.0, **options):
    row = made_row(name, **options)
    training = "--far_field=backdrop --seed=0 --paths=tree"
    return dataclasses.replace(row, training=training, train_seconds=seconds, rays_per_second=None)


def test_a_backdrop_takes_the_time_of_its_whole_training(tmp_path):
    rows = [
        _backdrop_row(pace=1.0, steps=32),
        _backdrop_row("iterations=8", seconds=30.0, pace=1.0, steps=8, quality=24.0),
        _backdrop_row("rays_per_pixel=9", pace=1.0, steps=32, image=9.0, quality=27.0),
        made_row("far_field=field", pace=0.1, quality=21.0),
    ]
    assert [row.stepping for row in rows] == [60.0, 30.0, 60.0, 100.0]
    lines = report.markdown(rows).splitlines()
    assert any("Its backdrop is fitted to one traced ray per pixel" in line for line in lines)
    assert "| `--iterations=8` | -50 % | -1.00 |" in lines
    assert "| `--rays_per_pixel=9` | +2.00 | +800 % of evaluation | 0.003 |" in lines
    labels = [(panel.cost_label, panel.label) for panel in report._panels(rows)]
    assert labels == [
        ("time of training, s", "masked PSNR, dB"),
        ("time of training, s", "PSNR, dB"),
        ("time of rendering an image, s", "masked PSNR, dB"),
    ]
    unmasked = [dataclasses.replace(row, psnr_masked=None) for row in rows]
    assert [panel.label for panel in report._panels(unmasked)] == ["PSNR, dB"] * 2
    assert [panel.cost_label for panel in report._panels([made_row()])] == [
        "time of a step, ms",
        "time of all steps, s",
    ]
    report.write_figure(tmp_path / "figure.png", rows)
    assert iio.imread(tmp_path / "figure.png").shape[1] > 2000


def test_the_lists_of_a_knob_can_be_replaced_and_knobs_added():
    values = sweep_options.parse_values(["samples_per_ray=16,10/8,4", "batch=256"])
    vary = ("samples_per_ray", "batch", "steps")
    points = trade_points.sweep(preset="tiny", values=values, vary=vary)
    assert {point.name for point in points[1:]} == {
        "samples_per_ray=16+10",
        "samples_per_ray=8+4",
        "batch=256",
        *("steps=625", "steps=1250", "steps=5000"),
    }
    points = trade_points.sweep(preset="tiny", steps=[300, 100], vary=["steps"])
    assert [point.name for point in points] == [BASE, "steps=100"]
    assert "--steps=300" in points[0].training


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: trade_points.sweep(preset="huge"), "Choose from tiny, small, paper, best"),
        (lambda: trade_points.sweep(preset="tiny", vary=["colour"]), "--values=colour=A/B"),
        (lambda: trade_points.sweep(preset="tiny", base={"steps": "9"}), "Use --steps"),
        (
            lambda: trade_points.sweep(preset="tiny", base={"paths": "foo"}),
            "--base=paths=foo does not exist",
        ),
        (lambda: trade_points.sweep(preset="tiny", base={"out": "x"}), "--out"),
        (lambda: trade_points.sweep(preset="tiny", base={"scene": "x"}), "--scene"),
        (
            lambda: trade_points.sweep(preset="tiny", base={"field": "a"}),
            "Choose from zipnerf",
        ),
        (lambda: sweep_options.parse_base(["min_throughput"]), "NAME=VALUE"),
        (lambda: sweep_options.parse_values(["min_throughput="]), "NAME=A/B"),
        (
            lambda: trade_points.choose(trade_points.sweep(preset="tiny"), ["min_throughput=1"]),
            "min_throughput=1",
        ),
    ],
)
def test_what_does_not_exist_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_table_is_read_as_it_was_written(tmp_path):
    rows = [made_row(), dataclasses.replace(made_row("min_throughput=0.1"), psnr_masked=None)]
    table.write(tmp_path / "t.csv", rows)
    assert table.read(tmp_path / "t.csv") == rows
    assert rows[1].quality == rows[1].psnr == 28.0


@pytest.mark.parametrize(
    ("text", "message"),
    [(None, "experiments.trade_off"), ("a,b\n1,2\n", "not a table"), ("", "no row of the base")],
)
def test_a_table_that_is_none_is_named(tmp_path, text, message):
    path = tmp_path / "table.csv"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ValueError, match=message):
        table.read(path)


def test_the_front_holds_what_nothing_beats():
    rows = [
        made_row("a=1", pace=0.1, quality=20.0),
        made_row("a=2", pace=0.2, quality=25.0),
        made_row("a=3", pace=0.2, quality=24.0),
        made_row("a=4", pace=0.3, quality=25.0),
        made_row("a=5", pace=0.4, quality=26.0),
    ]
    front = table.pareto(rows, lambda row: row.stepping)
    assert [row.name for row in front] == ["a=1", "a=2", "a=5"]


def _measured():
    return [
        made_row(),
        made_row("free=1", pace=0.09, quality=26.0),
        made_row("dear=1", pace=0.2, quality=27.0),
        made_row("fair=1", pace=0.11, quality=26.0),
        made_row("fair=2", pace=0.15, quality=26.5),
        made_row("noise=1", pace=0.1, quality=25.2),
        made_row("less=1", pace=0.05, quality=24.9),
        made_row("less=2", pace=0.04, quality=20.0),
        made_row("rays_per_pixel=4", image=4.0, quality=25.9),
    ]


def test_what_to_turn_first_is_what_is_free_then_what_gives_most_for_its_time():
    found = table.turns(_measured())
    worth = table.worth_turning(found)
    assert [turn.row.name for turn in worth] == ["free=1", "fair=1", "dear=1", "rays_per_pixel=4"]
    assert worth[1].gain == pytest.approx(1.0) and worth[1].percent == pytest.approx(10.0)
    # Of rendering: training takes as long as the base's.
    assert worth[3].percent == pytest.approx(300.0)
    assert [turn.row.name for turn in table.worth_saving(found)] == ["less=1"]


def test_the_report_marks_the_front_and_sorts_by_time():
    text = report.markdown(_measured())
    lines = [line for line in text.splitlines() if line.startswith(("| ● |", "|  |"))]
    assert [line.split("|")[2].strip() for line in lines][:3] == ["less=2", "less=1", "free=1"]
    assert [line.split("|")[1].strip() for line in lines][:5] == ["●", "●", "●", "", ""]
    assert "| `--fair=1` | +1.00 | +10 % | 0.100 |" in text
    assert "| `--free=1` | +1.00 | -10 % | free |" in text


@pytest.mark.slow
def test_a_sweep_writes_everything_and_outlives_a_point_that_fails(tmp_path):
    points = trade_points.sweep(preset="tiny", vary=["min_throughput", "paths"])

    def measure(point):
        if point.name == "min_throughput=0.05":
            raise RunFailedError("out of memory")
        return made_row(point.name, pace=0.1 + 0.01 * len(point.name), quality=20.0)

    failed = sweep.sweep(points, tmp_path / "out", measure)
    assert failed == {"min_throughput=0.05": "out of memory"}
    rows = table.read(tmp_path / "out" / "trade_off.csv")
    assert [row.name for row in rows] == [p.name for p in points if p.name != "min_throughput=0.05"]
    assert "paths=straight" in (tmp_path / "out" / "trade_off.md").read_text()
    assert iio.imread(tmp_path / "out" / "trade_off.png").shape[1] > 1000


@pytest.mark.slow
def test_a_sweep_adds_to_the_one_before_it_around_the_same_base(tmp_path):
    def measure(point):
        (tmp_path / "runs" / sweep.run_name(point, _SCENE)).mkdir(parents=True, exist_ok=True)
        options = " ".join(point.training), " ".join(point.evaluation)
        row = made_row(point.name)
        return dataclasses.replace(
            row, scene=_SCENE.name, training=options[0], evaluation=options[1]
        )

    for vary in (["min_throughput"], ["paths"]):
        points = trade_points.sweep(preset="tiny", vary=vary)
        earlier = sweep.earlier_rows(tmp_path, points[0], _SCENE, images=20)
        sweep.sweep(points, tmp_path, measure, earlier)
    names = [row.name for row in table.read(tmp_path / "trade_off.csv")]
    assert names[0] == BASE and {"min_throughput=0.1", "paths=straight"} < set(names)
    other = trade_points.sweep(preset="tiny", base={"batch": "64"})[0]
    with pytest.raises(ValueError, match="another --out"):
        sweep.earlier_rows(tmp_path, other, _SCENE, images=20)
    with pytest.raises(ValueError, match="another --out"):
        sweep.earlier_rows(tmp_path, points[0], ROOT, images=20)
    # Measured on other images they could not stand in one table.
    with pytest.raises(ValueError, match="on 20 images, and this sweep would be on 5"):
        sweep.earlier_rows(tmp_path, points[0], _SCENE, images=5)
    namesake = tmp_path / _SCENE.name  # elsewhere it is another scene
    namesake.mkdir()
    with pytest.raises(ValueError, match="another folder named"):
        sweep.earlier_rows(tmp_path, points[0], namesake, images=20)

    def fail(point):
        raise RunFailedError("unknown flag")

    with pytest.raises(ValueError, match="unknown flag"):  # without its base
        sweep.sweep(points, tmp_path / "failed", fail)


def test_the_pace_is_the_median_without_the_interval_that_compiles():
    seconds = [30.0, 31.0, 32.0, 50.0, 51.0]
    lines = [{"step": 10 * i, "seconds": s} for i, s in enumerate(seconds, 1)]
    assert measured_runs.seconds_per_step(lines) == pytest.approx(0.1)
    assert measured_runs.seconds_per_step(lines[:1]) == pytest.approx(3.0)


_STUB = """
import json, pathlib, sys
options = dict(word.lstrip("-").partition("=")[::2] for word in sys.argv[2:])
command, run = sys.argv[1], pathlib.Path(options.get("out") or options["run"])
with (run.parent / "calls.txt").open("a") as file:
    file.write(command + "\\n")
(run.parent / "words.json").write_text(json.dumps(sys.argv[2:]))
if options.get("min_throughput") == "2":
    sys.exit("error: The cut is a share, not 2. Give 0.02.")
run.mkdir(exist_ok=True)
if command == "train":
    lines = [{"step": n, "seconds": 5.0 + 0.5 * n, "peak_device_bytes": 2**30} for n in (1, 2, 4)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\\n" for line in lines))
    (run / "config.json").write_text('{"schedule": {"batch": 100}}')
else:
    results = {"psnr": "inf", "psnr_masked": None, "ssim": 1.0, "distance_mae": 0.1}
    results |= {"distance_mae_masked": None, "seconds_per_image": 2.0}
    (run / "eval" / "test").mkdir(parents=True, exist_ok=True)
    text = json.dumps({"results": results, "per_image": [1, 2]})
    (run / "eval" / "test" / "metrics.json").write_text(text)
"""


@pytest.mark.parametrize(
    ("text", "status", "told"),
    [
        ("$ python -m experiments.train --scene=mirror\nCompiling\n", 1, "Compiling"),
        (
            "$ python -m experiments.train --scene=mirror\n",
            -9,
            "killed by SIGKILL, as when memory runs out: lower --batch",
        ),
        ("ValueError: no\nbye\n", 1, "ValueError: no"),
        ("", 3, "ended with status 3, and printed nothing"),
    ],
)
def test_the_complaint_is_what_was_said_last(text, status, told):
    assert subprocesses._complaint(text, status) == told


@pytest.fixture
def stub(tmp_path, monkeypatch):
    """Stands in for the commands; writes their names into `calls.txt`."""
    (tmp_path / "stub.py").write_text(_STUB)
    start = subprocess.Popen

    def popen(command, **options):
        name = command[2].removeprefix("experiments.")
        return start([command[0], str(tmp_path / "stub.py"), name, *command[3:]], **options)

    monkeypatch.setattr(subprocesses.subprocess, "Popen", popen)
    return tmp_path / "runs"


def test_a_point_is_measured_once(stub):
    points = {p.name: p for p in trade_points.sweep(preset="tiny", steps=[4])}
    row = sweep.measure(points[BASE], _SCENE, stub)
    assert (row.steps, row.seconds_per_step, row.rays_per_second) == (4, 0.5, 200.0)
    assert row.train_seconds == 7.0 and row.peak_device_mib == 1024.0
    assert 1.0 < row.peak_host_mib < 10_000.0
    assert (row.psnr, row.psnr_masked, row.images) == (float("inf"), None, 2)
    assert sweep.measure(points[BASE], _SCENE, stub) == row
    sweep.measure(points["rays_per_pixel=4"], _SCENE, stub)
    sweep.measure(points[BASE], _SCENE, stub, ["--limit=1"])
    sweep.measure(points["min_throughput=0.1"], _SCENE, stub)
    calls = (stub / "calls.txt").read_text().split()
    assert calls == ["train", "evaluate", "evaluate", "evaluate", "train", "evaluate"]
    (stub / sweep.run_name(points[BASE], _SCENE) / "measured.json").unlink()
    again = sweep.measure(points[BASE], _SCENE, stub)  # it ended unmeasured
    assert again.peak_host_mib is None and again.seconds_per_step == row.seconds_per_step


@pytest.mark.parametrize(("far_field", "rays"), [("field", 200.0), ("backdrop", None)])
def test_only_a_field_is_trained_on_rays_per_second(tmp_path, far_field, rays):
    config = {"schedule": {"batch": 100}, "model": {"far_field": far_field}}
    (tmp_path / "config.json").write_text(json.dumps(config))
    lines = [json.dumps({"step": n, "seconds": 5.0 + 0.5 * n}) for n in (1, 2)]
    (tmp_path / "metrics.jsonl").write_text("\n".join(lines) + "\n")
    training = measured_runs.read_training(tmp_path, wall=9.0, peak_host_mib=None)
    assert (training.seconds_per_step, training.rays_per_second) == (0.5, rays)
    row = dataclasses.replace(made_row("base"), rays_per_second=training.rays_per_second)
    table.write(tmp_path / "trade_off.csv", [row])
    assert table.read(tmp_path / "trade_off.csv") == [row]
    assert f"| 100.0 | {'-' if rays is None else '200'} |" in report.markdown([row])


def test_an_iteration_of_a_backdrop_takes_the_mean_of_its_rounds(tmp_path):
    """Iterations that begin a round take longer; a training of fewer than asked has ended."""
    model = {"far_field": "backdrop", "iterations": 32}
    (tmp_path / "config.json").write_text(json.dumps({"model": model}))
    seconds = [20.0, 21.0, 22.0, 26.0]
    lines = [json.dumps({"step": n, "seconds": s}) for n, s in enumerate(seconds, 1)]
    (tmp_path / "metrics.jsonl").write_text("\n".join(lines) + "\n")
    training = measured_runs.read_training(tmp_path, wall=30.0, peak_host_mib=None)
    assert training.seconds_per_step == pytest.approx(2.0)
    assert (training.steps, training.train_seconds, training.startup_seconds) == (4, 26.0, 4.0)
    assert not measured_runs._has_ended(tmp_path, None)
    (tmp_path / "checkpoints" / "32").mkdir(parents=True)
    assert measured_runs._has_ended(tmp_path, None)


def test_a_failure_tells_its_last_word_and_is_tried_again(stub):
    values = {"min_throughput": ("2",)}
    point = trade_points.sweep(preset="tiny", values=values, vary=["min_throughput"])[1]
    log = stub / f"{sweep.run_name(point, _SCENE)}.log"
    log.parent.mkdir()
    log.write_text("error: an older one\n")
    for _ in range(2):
        with pytest.raises(RunFailedError, match=r"The cut is a share, not 2.*\.log"):
            sweep.measure(point, _SCENE, stub)
    assert (stub / "calls.txt").read_text().split() == ["train", "train"]


def test_an_option_with_a_space_stays_one_and_its_line_can_be_pasted(stub):
    point = trade_points.sweep(preset="tiny", steps=[4])[0]
    sweep.measure(point, _SCENE, stub, ["--lpips_weights=a b.npz"])
    assert json.loads((stub / "words.json").read_text())[-2:] == [
        "--lpips_weights=a b.npz",
        "--overwrite",
    ]
    log = (stub / f"{sweep.run_name(point, _SCENE)}.log").read_text()
    assert " '--lpips_weights=a b.npz' --overwrite" in log


@pytest.mark.slow
def test_a_real_sweep_of_three_steps(tmp_path):
    options = (f"--scene={_SCENE}", f"--out={tmp_path}", "--steps=3", "--limit=1")
    options += ("--base=interior=field", "--base=batch=64", "--points=paths=straight,paths=paper")
    result = run_command("trade_off", *options)
    assert "experiments.recommend" in result.stdout
    rows = table.read(tmp_path / "trade_off.csv")
    assert [row.name for row in rows] == [BASE, "paths=straight", "paths=paper"]
    assert all(row.steps == 3 and row.psnr_masked > 5.0 for row in rows)
    before = (tmp_path / "trade_off.csv").read_text()
    run_command("trade_off", *options)
    assert (tmp_path / "trade_off.csv").read_text() == before
