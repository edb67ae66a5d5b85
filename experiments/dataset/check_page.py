"""Writes the report of a check as one self-contained web page."""

import base64
import html
from collections.abc import Sequence
from typing import NamedTuple

import imageio.v3 as iio
import numpy as np
from jaxtyping import Float

from experiments.dataset.checks import View
from refref_jax.data import image_files

_ERROR_GAIN = 4.0

_LARGEST_THUMBNAIL = 200

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 76rem; color: #222;
  padding: 0 1rem; }
h1 { font-weight: 600; } h2 { margin: 0; font-size: 1.05rem; }
section { border-top: 1px solid #ddd; padding: 1rem 0; }
.bad h2::after { content: " failed"; color: #b3261e; font-weight: 400; }
.views { display: flex; flex-wrap: wrap; gap: 1rem; margin-top: .6rem; }
figure { margin: 0; } figcaption { font-size: .85rem; color: #555; }
img { width: 150px; image-rendering: auto; border-radius: 3px; }
ul { margin: .4rem 0; color: #b3261e; } .note { color: #777; }
td, th { padding: .15rem .9rem .15rem 0; text-align: right; } td:first-child, th:first-child
  { text-align: left; }
tr.bad td { color: #b3261e; }
"""


class SceneReport(NamedTuple):
    """Results of checking one scene.

    Attributes:
      name: name of the scene's folder.
      complaints: failed checks; empty if the scene may be used.
      notes: further remarks.
      views: compared views.
    """

    name: str
    complaints: list[str]
    notes: list[str]
    views: list[View]


def write_page(reports: Sequence[SceneReport], *, title: str) -> str:
    """Returns the page: a table of all scenes, then each scene with its views, failures first."""
    ordered = sorted(reports, key=lambda report: not report.complaints)
    failed = sum(bool(report.complaints) for report in reports)
    verdict = "all passed" if not failed else f"{failed} failed"
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{_STYLE}</style><h1>{html.escape(title)}</h1>"
        f"<p>{len(reports)} scenes, {verdict}. Each view: the image, our rendering of the same "
        f"scene along the path tree, and their difference times {_ERROR_GAIN:g}.</p>"
        f"{_table(reports)}{''.join(map(_section, ordered))}</html>\n"
    )


def mean(values: Sequence[float]) -> float:
    """Returns the mean of the values that are not NaN; NaN if there are none."""
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else np.nan


def _table(reports: Sequence[SceneReport]) -> str:
    titles = ("scene", "masked PSNR", "PSNR", "masks differ", "depths agree", "normals")
    head = "".join(f"<th>{title}</th>" for title in titles)
    return f"<table><tr>{head}</tr>{''.join(map(_row, reports))}</table>"


def _row(report: SceneReport) -> str:
    def over(field: str) -> float:
        return mean([getattr(view, field) for view in report.views])

    cells = (
        html.escape(report.name),
        f"{over('psnr_masked'):.1f} dB",
        f"{over('psnr'):.1f} dB",
        f"{over('mask_share'):.3%}",
        f"{over('depth_share'):.2%}",
        f"{over('normal_degrees'):.2f}°",
    )
    bad = ' class="bad"' if report.complaints else ""
    return f"<tr{bad}>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"


def _section(report: SceneReport) -> str:
    complaints = "".join(f"<li>{html.escape(each)}</li>" for each in report.complaints)
    notes = "".join(f'<p class="note">{html.escape(each)}</p>' for each in report.notes)
    return (
        f"<section{' class=bad' if report.complaints else ''}><h2>{html.escape(report.name)}</h2>"
        f"{f'<ul>{complaints}</ul>' if complaints else ''}{notes}"
        f'<div class="views">{"".join(map(_figure, report.views))}</div></section>'
    )


def _figure(view: View) -> str:
    error = np.clip(np.abs(view.rgb - view.target) * _ERROR_GAIN, 0.0, 1.0)
    pictures = (_picture(each) for each in (view.target, view.rgb, error))
    caption = f"{html.escape(view.name)}: {view.psnr_masked:.1f} dB masked PSNR"
    return f"<figure>{''.join(pictures)}<figcaption>{caption}</figcaption></figure>"


def _picture(rgb: Float[np.ndarray, "h w 3"]) -> str:
    stride = -(-max(rgb.shape[:2]) // _LARGEST_THUMBNAIL)
    pixels = image_files.to_bytes(rgb[::stride, ::stride])
    data = base64.b64encode(iio.imwrite("<bytes>", pixels, plugin="pillow", extension=".png"))
    return f'<img alt="" src="data:image/png;base64,{data.decode()}">'
