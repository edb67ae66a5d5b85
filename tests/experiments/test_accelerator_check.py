"""The check of an accelerator, as a user without one runs it, and what becomes of failures."""

import json

import jax
import numpy as np
import pytest

from experiments.accelerator import comparisons, measuring, report
from experiments.accelerator.measuring import Context, Row, Sizes
from tests.processes.command import ROOT, run_command

pytestmark = pytest.mark.loose

_AGREEING = {
    "Single operations": 4,
    "Closest hits": 3,
    "Light paths": 4,
    "Repeated training": 3,
    "Gradients of one step": 4,
}


@pytest.fixture(scope="module")
def checked(tmp_path_factory):
    """The folder of a check with few steps, and what it printed."""
    out = tmp_path_factory.mktemp("check") / "out"
    result = run_command("accelerator_check", f"--out={out}", "--presets=tiny", "--steps=4")
    return out, result.stdout


@pytest.fixture(scope="module")
def found(checked):
    content = json.loads((checked[0] / "report.json").read_text("utf-8"))
    return {part["name"]: part["rows"] for part in content["parts"]}


@pytest.mark.slow
def test_the_report_has_every_part_and_nothing_failed(checked, found):
    text = (checked[0] / "report.md").read_text("utf-8")
    parts = [part.name for part in report.parts_of(["tiny"])]
    assert list(found) == parts and len(parts) == 12
    for name, rows in found.items():
        assert f"## {name}\n" in text and rows
        for row in rows:
            assert f"| {row['name']} |" in text
            assert row["verdict"] in ("ok", "-"), row
    assert "0 problems, 0 failed" in text and "0 problems, 0 failed" in checked[1]


@pytest.mark.slow
def test_without_an_accelerator_the_report_says_so(checked):
    said = "no accelerator found: compared the CPU with itself"
    assert said in checked[1]
    assert said[1:] in (checked[0] / "report.md").read_text("utf-8")
    assert "Next: python -m experiments.train" in checked[1]


@pytest.mark.slow
@pytest.mark.parametrize("part", _AGREEING)
def test_a_cpu_agrees_with_itself(found, part):
    compared = [row for row in found[part] if row["verdict"] == "ok"]
    assert len(compared) == _AGREEING[part]
    for row in compared:
        if row["name"].startswith("loss"):
            assert 0.0 < row["value"] < 1.0
        else:
            assert row["value"] <= 1e-5, row


@pytest.mark.slow
def test_something_was_compared(found):
    values = {row["name"]: row["value"] for rows in found.values() for row in rows}
    assert 0.1 < values["rays that hit something"] < 0.9
    assert values["light paths"] > values["rays"] == 32 * 1024
    assert values["a step of 1,024 rays"] > 0.0
    assert values["bytes of a step, counted by the compiler"] > 0.1
    assert values["peak memory since the start"] == "not reported"


def test_parts_that_train_nothing_are_reported_and_agree(tmp_path, monkeypatch):
    few = Sizes(copied=1 << 16, lookups=1 << 12, rays=1 << 12, views=2, cells=64)
    monkeypatch.setattr(measuring, "_OF_A_CPU", few)
    monkeypatch.setattr(measuring, "_PATIENCE", 0.0)  # each call is timed once
    cpu = jax.devices("cpu")[0]
    context = Context(cpu, cpu, ROOT, 4)
    parts = report.parts_of(["tiny"])[:3]
    results = [report.run_part(part, context) for part in parts]
    assert not report.with_verdict(results, "problem", "failed")
    report.write(tmp_path, context, results, parts=12)
    text = (tmp_path / "report.md").read_text("utf-8")
    for result in results:
        assert f"## {result.name}\n" in text and result.rows
    assert report.summary(results).startswith(f"{1 + _AGREEING['Single operations']} ok")
    speeds = [row.value for row in results[1].rows]
    assert len(speeds) == 7 and min(speeds) > 0.0


def test_parts_are_chosen_by_the_beginnings_of_their_headings():
    parts = report.parts_of(["tiny", "paper"])
    chosen = report.chosen(parts, ["memory", "Preset paper: t"])
    assert [part.name.partition(":")[0] for part in chosen] == ["Memory", *2 * ["Preset paper"]]
    assert report.chosen(parts, []) == parts
    for wrong in (["memry"], ["memory", ""]):
        with pytest.raises(
            ValueError, match=rf"no part begins with '{wrong[-1]}'\. There are: Env"
        ):
            report.chosen(parts, wrong)


def test_a_finished_part_is_told_with_verdicts_and_seconds():
    rows = (
        Row("rate", 2.5, "GB/s"),
        Row("rays", 1024, "", "ok"),
        Row("off", 0.1, "", "problem", "why"),
    )
    told = report.in_words(report.Result("Memory", 2.4, rows))
    assert told == "  rate: 2.5 GB/s\n  rays: 1,024  ok\n  off: 0.1  problem (why)\n  in 2 s"


def test_a_gradient_with_one_wrong_array_is_found():
    right = {"grid": np.full(300, 0.1), "network": {"bias": np.ones(1), "kernel": np.zeros(9)}}
    wrong = {"grid": np.full(300, 0.1), "network": {"bias": np.full(1, 1.2), "kernel": np.zeros(9)}}
    assert comparisons.relative_distance(right, right) == 0.0
    assert comparisons.relative_distance(wrong, right) == pytest.approx(0.1)
    name, apart = comparisons.most_different(wrong, right)
    assert name == "network/bias" and apart == pytest.approx(0.2)
    assert comparisons.limited("gradient", 0.1, 0.02).verdict == "problem"


def _broken(context):
    yield Row("before", 1.0)
    raise MemoryError("no more\nthan this")


def test_a_part_that_fails_is_a_line_of_the_report(tmp_path):
    cpu = jax.devices("cpu")[0]
    context = Context(cpu, cpu, ROOT, 4)
    result = report.run_part(report.Part("Broken", _broken), context)
    assert [row.verdict for row in result.rows] == ["-", "failed"]
    assert report.with_verdict([result], "failed") == [
        "failed: Broken: error: MemoryError: no more than this"
    ]
    report.write(tmp_path, context, [result], parts=1)
    assert "| error | MemoryError: no more than this |" in (tmp_path / "report.md").read_text()
    assert json.loads((tmp_path / "report.json").read_text())["parts"][0]["name"] == "Broken"


def test_values_that_are_not_finite_are_written_and_are_problems(tmp_path):
    row = comparisons.limited("off", float("nan"), 1.0)
    assert row.verdict == "problem"
    cpu = jax.devices("cpu")[0]
    report.write(
        tmp_path, Context(cpu, cpu, ROOT, 4), [report.Result("Part", 0.0, (row,))], parts=1
    )
    (part,) = json.loads((tmp_path / "report.json").read_text())["parts"]
    assert part["rows"][0]["value"] == "nan"
