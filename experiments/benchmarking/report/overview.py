"""The first page of a report: scenes, tables, failure cases, and how it was measured."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

from experiments.benchmarking import paper_tables
from experiments.benchmarking.report import charts, data, markup
from experiments.benchmarking.report.data import Case, Contents, Scene
from experiments.benchmarking.report.images import ERROR, IMAGE, TRUTH, Places
from experiments.benchmarking.report.markup import Html, join, tag
from experiments.benchmarking.report.scene_pages import address, thumbnail
from experiments.benchmarking.results import Record
from experiments.benchmarking.tables import PSNR, PSNR_MASKED

# Failure cases of each method.
_MOST_CASES = 10

_COSTS = {
    "steps": ("steps", 0),
    "seconds_per_step": ("s a step, median", 3),
    "train_seconds": ("s of training", 0),
    "startup_seconds": ("s to start", 0),
    "seconds_per_image": ("s an image", 2),
    "peak_host_mib": ("MiB of the host, most", 0),
    "peak_device_mib": ("MiB of the device, most", 0),
}

_NOISY = (
    "Times are those of the machines that did the jobs, whatever else these were doing: they are "
    "noisy, and tables leave them out."
)


def show(contents: Contents, introduction: str, places: Mapping[str, Places]) -> Html:
    """Returns the first page.

    Args:
      contents: the benchmark.
      introduction: what is said at its top.
      places: identifiers of the pictures of each scene.
    """
    parts = {
        "scenes": ("Scenes", _scenes(contents, places)),
        "tables": ("Tables", join(map(markup.show, contents.tables))),
        "failures": ("Failure cases", _failures(contents.scenes, places)),
        "jobs": ("Jobs not done", _not_done(contents)),
        "settings": ("Settings and costs", _settings(contents)),
    }
    links = [tag("a", title, href=f"#{name}") for name, (title, _) in parts.items()]
    sections = [
        tag("section", tag("h2", title), body, id=name) for name, (title, body) in parts.items()
    ]
    parts_of_it = tag("nav", *links, aria_label="Parts")
    return tag("div", tag("p", introduction), parts_of_it, *sections, id="overview")


def _scenes(contents: Contents, places: Mapping[str, Places]) -> Html:
    """Returns a table of all scenes, with each method's PSNR in the mask, or of the image."""
    if not contents.scenes:
        return tag("p", "No job is done yet.", class_="note")
    methods = [name for name in contents.labels if _has_results(contents, name)]
    methods += sorted({r.record.method for s in contents.scenes for r in s.results} - set(methods))
    rows = [
        [
            tag("a", _first_picture(places[scene.name]), scene.name, href=address(scene.name)),
            *_scores(scene, methods),
            paper_tables.CATEGORIES.get(scene.category, scene.category),
            paper_tables.BACKGROUNDS.get(scene.background, scene.background),
        ]
        for scene in contents.scenes
    ]
    labels = [contents.labels.get(name, name) for name in methods]
    heads = ["scene", *labels, "category", "background"]
    note = (
        "PSNR inside the object's mask in dB, mean over a scene's images; of the whole image "
        "where there are no masks. The best is bold. A scene leads to its views."
    )
    return join([markup.grid(heads, rows), tag("p", note, class_="note")])


def _has_results(contents: Contents, method: str) -> bool:
    return any(r.record.method == method for scene in contents.scenes for r in scene.results)


def _scores(scene: Scene, methods: Sequence[str]) -> list[str]:
    found = {result.record.method: result.record.metrics for result in scene.results}
    masked = any(metrics.get(PSNR_MASKED.key) is not None for metrics in found.values())
    quantity = PSNR_MASKED if masked else PSNR
    numbers = {name: metrics.get(quantity.key) for name, metrics in found.items()}
    shown = {name: markup.number(value, quantity.digits) for name, value in numbers.items()}
    known = [value for value in numbers.values() if value is not None and not math.isnan(value)]
    best = markup.number(max(known), quantity.digits) if len(known) > 1 else None
    cells = [shown.get(name, "-") for name in methods]
    return [tag("strong", cell) if cell == best else cell for cell in cells]


def _first_picture(places: Places) -> Html | None:
    views = [view for view, method, kind in places if (method, kind) == (TRUTH, IMAGE)]
    return thumbnail(places, views[0], TRUTH, IMAGE) if views else None


def _failures(scenes: Sequence[Scene], places: Mapping[str, Places]) -> Html:
    """Returns where each method fails most, with a filter that the page's script serves."""
    found = data.failures(scenes, _MOST_CASES)
    if not found:
        return tag("p", "No view was measured.", class_="note")
    methods = list(dict.fromkeys(case.method for case in found))
    options = [
        tag("option", "all methods", value=""),
        *(tag("option", n, value=n) for n in methods),
    ]
    rows = [_case(case, places[case.scene]) for case in found]
    note = (
        f"The {_MOST_CASES} views of each method with the lowest PSNR inside the mask, the worst "
        "first; views without it come last, by the PSNR of the image. Pictures: ground truth, "
        "rendered, error."
    )
    choice = tag("label", "Of ", tag("select", *options, id="failing"), hidden=True)
    return join([tag("p", note, class_="note"), choice, tag("ol", *rows, class_="cases")])


def _case(case: Case, places: Places) -> Html:
    """Returns a line of the failures, with pictures where the report has the view."""
    is_shown = any(view == case.view for view, _, _ in places)
    link = address(case.scene, case.view if is_shown else None)
    pictures = [
        thumbnail(places, case.view, TRUTH, IMAGE),
        thumbnail(places, case.view, case.method, IMAGE),
        thumbnail(places, case.view, case.method, ERROR),
    ]
    return tag(
        "li",
        tag("a", join(pictures), f"{case.scene}, {case.view}", href=link),
        tag("span", charts.swatch(case.method), " ", case.method),
        tag(
            "span",
            f"{markup.number(case.psnr_masked, 1)} dB in mask, {markup.number(case.psnr, 1)} dB",
        ),
        None if is_shown else tag("small", "not among the views of this report"),
        data_method=case.method,
    )


def _not_done(contents: Contents) -> Html:
    failed = [[f"failed: {name}", reason] for name, reason in contents.failed.items()]
    left_out = [[f"left out: {each.name}", each.reason] for each in contents.skipped]
    missing = [[f"not done: {name}", "it has no result yet"] for name in contents.missing]
    if not (found := [*failed, *left_out, *missing]):
        return tag("p", "All jobs that were asked for are done.", class_="note")
    return markup.grid(["job", "reason"], found)


def _settings(contents: Contents) -> Html:
    own = [result.record for scene in contents.scenes for result in scene.results]
    everything = [*own, *contents.reconstructions]
    settings = [
        [name, "not set" if value is None else str(value)]
        for name, value in dataclasses.asdict(contents.settings).items()
    ]
    versions = dict.fromkeys(
        ", ".join(f"{name} {version}" for name, version in record.versions.items())
        for record in everything
    )
    settings += [["versions", text] for text in versions if text]
    methods = []
    for name in dict.fromkeys(record.method for record in everything):
        given = next(record.options for record in everything if record.method == name)
        line = tag("span", charts.swatch(name), " ", name) if name in contents.labels else name
        methods.append([line, contents.labels.get(name, "-"), markup.options(given)])
    return join(
        [
            tag(
                "div",
                markup.grid(["setting", "value"], settings),
                tag("h3", "Methods"),
                markup.grid(["method", "label", "options"], methods),
                id="configuration",
            ),
            tag("h3", "Costs"),
            tag("p", _NOISY, class_="note"),
            _costs(own),
        ]
    )


def _costs(found: Sequence[Record]) -> Html:
    kept = [key for key in _COSTS if any(getattr(r.costs, key) is not None for r in found)]
    rows = [
        [
            f"{record.scene}/{record.method}",
            *(markup.number(getattr(record.costs, key), _COSTS[key][1]) for key in kept),
        ]
        for record in found
    ]
    return markup.grid(["job", *(_COSTS[key][0] for key in kept)], rows)
