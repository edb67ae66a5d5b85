"""The page of a scene: its numbers, its curves, and its views with a slider between any two."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

from experiments.benchmarking.report import charts, data, images, markup
from experiments.benchmarking.report.data import Scene
from experiments.benchmarking.report.images import NOT_HERE, TRUTH, Places, title
from experiments.benchmarking.report.markup import Html, join, tag
from experiments.benchmarking.tables import MAIN, Quantity, value

_WHAT = (
    "Error: mean over the channels of the absolute difference from the ground truth. Distance: of "
    "the ground truth, to the first surface; of methods, the median of the field's weights along "
    "the light's path, which clear glass does not stop. Grey: none."
)


class Page(NamedTuple):
    """The page of a scene.

    Attributes:
      html: the page.
      places: identifiers of its pictures.
    """

    html: Html
    places: Places


def address(scene: str, view: str | None = None) -> str:
    """Returns the link to a scene's page, at a view."""
    words = [scene] if view is None else [scene, view]
    return "#scene/" + "/".join(quote(word, safe="") for word in words)


def show(out: Path, scene: Scene, views: Sequence[str], *, edge: int, prefix: str) -> Page:
    """Returns the page of a scene.

    Args:
      out: folder of the benchmark.
      scene: with its results.
      views: names of those to show.
      edge: longest edge of a picture.
      prefix: of the identifiers of its pictures; no other scene may have it.
    """
    places: Places = {}
    articles = []
    for i, name in enumerate(views):
        view = data.read_view(out, scene, name)
        figures = images.show(view, scene, edge, f"{prefix}v{i}")
        articles.append(figures.html)
        places |= figures.places
    methods = [result.record.method for result in scene.results]
    chosen = [
        tag("a", thumbnail(places, name, TRUTH, "image"), name, href=address(scene.name, name))
        for name in views
    ]
    page = tag(
        "section",
        tag("p", tag("a", "All scenes", href="#scenes")),
        tag("h2", scene.name),
        _numbers(scene),
        tag("h3", "Views"),
        tag("p", _WHAT, class_="note"),
        tag("nav", *chosen, class_="views", aria_label="Views"),
        tag("div", _slider(methods), *articles, class_="pictures")
        if views
        else tag("p", "No view was rendered.", class_="note"),
        tag("h3", "Training"),
        charts.training_charts(scene.results),
        class_="scene",
        data_scene=scene.name,
    )
    return Page(page, places)


def thumbnail(places: Places, view: str, method: str, kind: str) -> Html | None:
    """Returns a small copy of a picture of the page, which its script fills in."""
    place = places.get((view, method, kind))
    return None if place is None else tag("img", data_copy=place, alt="", class_="thumb")


def _numbers(scene: Scene) -> Html:
    """Returns all means of a scene, and what was found besides."""
    means = {
        result.record.method: [value(q, result.record.metrics, scene.background) for q in MAIN]
        for result in scene.results
    }
    kept = [j for j in range(len(MAIN)) if any(row[j] is not None for row in means.values())]
    head = ["method", *(_heading(MAIN[j]) for j in kept)]
    rows = [
        [name, *(markup.number(row[j], MAIN[j].digits) for j in kept)]
        for name, row in means.items()
    ]
    facts = [
        tag("p", f"{result.record.method}: ", tag("code", json.dumps(result.record.facts)))
        for result in scene.results
        if result.record.facts
    ]
    return join([markup.grid(head, rows), *facts])


def _heading(quantity: Quantity) -> str:
    return f"{quantity.label}, dB" if quantity.label.endswith("PSNR") else quantity.label


def _slider(methods: Sequence[str]) -> Html:
    """Returns the slider between two pictures; the script of the page fills and moves it."""
    last = charts.families(methods)[0][-1]  # of the main methods, if there are any

    def choice(side: str, chosen: str) -> Html:
        options = [
            tag("option", title(name), value=name, selected=name == chosen)
            for name in (TRUTH, *methods)
        ]
        return tag("label", f"{side} ", tag("select", *options, class_=side))

    handle = tag(
        "input",
        type="range",
        min="0",
        max="100",
        value="50",
        aria_label="Share of the left picture",
    )
    wipe = tag(
        "div",
        tag("img", class_="under", alt="", draggable="false"),
        tag("img", class_="over", alt="", draggable="false"),
        tag("span", class_="bar"),
        tag("p", NOT_HERE, class_="absent", hidden=True),
        class_="wipe",
    )
    choices = tag("div", choice("left", TRUTH), choice("right", last), class_="choices")
    return tag("div", choices, wipe, handle, class_="slider", hidden=True)
