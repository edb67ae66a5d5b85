"""The numbers that the paper prints, as they were transcribed."""

import pytest

from experiments.benchmarking import published
from experiments.benchmarking.methods import METHODS
from refref_jax.data import scene_names

_METHODS_THERE = [
    "NeuS",
    "Splatfacto",
    "Zip-NeRF",
    "TNSR",
    "MS-NeRF",
    "RayDef",
    "RoseNeRF",
    "R3F",
    "Oracle",
]


def test_the_papers_main_table_is_whole():
    for category in (*scene_names.CATEGORIES, published.ALL):
        for background in (*scene_names.BACKGROUNDS, published.ALL):
            rows = published.rows(published.MAIN, category, background)
            assert [row.method for row in rows] == _METHODS_THERE
            for row in rows:
                missing = {name for name, number in row.numbers.items() if number is None}
                expected = {"drmse"}
                if row.method == "RoseNeRF":
                    expected |= {"dmae"}
                if row.method in ("NeuS", "TNSR") and background == "env":
                    expected = set(published.NUMBERS)
                assert missing == expected, row
    lines = [row.line for row in published.read()]
    assert lines == sorted(lines) and len(published.read()) == 16 * 9 + 5 + 5


@pytest.mark.parametrize(
    ("table", "category", "background", "method", "numbers"),
    [
        ("result_quantitative", "smcvx", "cube", "Oracle", (31.64, 25.37, 0.96, 0.03, 0.04)),
        ("result_quantitative", "smcvx", "env", "Zip-NeRF", (33.04, 26.52, 0.94, 0.10, 0.08)),
        ("result_quantitative", "smncvx", "sphere", "R3F", (23.27, 15.03, 0.88, 0.11, 0.25)),
        ("result_quantitative", "mmncvx", "all", "RoseNeRF", (22.78, 18.27, 0.75, 0.30, None)),
        ("result_quantitative", "mmncvx", "cube", "Splatfacto", (24.70, 17.72, 0.86, 0.10, 11.03)),
        ("result_quantitative", "all", "sphere", "TNSR", (18.51, 11.28, 0.82, 0.18, 1.87)),
        ("result_quantitative", "all", "all", "Oracle", (29.34, 21.75, 0.93, 0.08, 0.07)),
        ("ablation", "smcvx", "cube", "w/o TIR", (25.85, 19.27, 0.9084, 0.0838, 0.1586)),
        ("ablation", "smcvx", "cube", "w/o Zip-NeRF", (24.68, 21.45, 0.8779, 0.1163, 0.2742)),
        ("top5", "all", "all", "RayDef", (19.99, 16.28, 0.72, 0.38, None)),
    ],
)
def test_numbers_of_the_paper(table, category, background, method, numbers):
    (row,) = [row for row in published.rows(table, category, background) if row.method == method]
    names = ("psnr", "psnr_masked", "ssim", "lpips", "dmae")
    found = tuple(row.numbers[name] for name in names)
    assert tuple(None if text is None else float(text) for text in found) == numbers


def test_the_papers_ablations_and_top_views_are_whole():
    ablated = published.rows(published.ABLATION, "smcvx", "cube")
    named = {m.published for m in METHODS.values() if m.group == "ablation of the oracle"}
    assert {row.method for row in ablated} == (named - {None}) | {"Oracle"}
    top = published.rows(published.TOP_VIEWS, published.ALL, published.ALL)
    assert [(row.method, float(row.numbers["drmse"])) for row in top] == [
        ("Zip-NeRF", 1.21),
        ("MS-NeRF", 0.94),
        ("RayDef", 1.98),
        ("R3F", 0.88),
        ("Oracle", 0.0),
    ]
    for row in (*ablated, *top):
        assert None not in [row.numbers[name] for name in ("psnr", "psnr_masked", "ssim", "lpips")]
    assert {m.published for m in METHODS.values() if m.group == "main"} - {None} <= set(
        _METHODS_THERE
    )
