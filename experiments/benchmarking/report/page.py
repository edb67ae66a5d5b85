"""Writes the report of a benchmark as one self-contained HTML file.

It needs neither a server nor a network: the style, the script and all images are embedded, and its
content security policy forbids loading anything. The first page has scenes, tables, failure cases
and settings. The page of a scene has its numbers, its curves, and its views with a slider between
any two. Pages are selected by the fragment of the address, as in #scene/NAME/VIEW.
"""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from urllib.parse import quote

from experiments.benchmarking import paper_tables, plan
from experiments.benchmarking.report import charts, data, images, markup
from experiments.benchmarking.report.data import Case, Contents, Scene
from experiments.benchmarking.report.images import (
    ERROR,
    IMAGE,
    NOT_HERE,
    TRUTH,
    Places,
    Shown,
    title,
)
from experiments.benchmarking.report.markup import Html, join, tag
from experiments.benchmarking.results import Record
from experiments.benchmarking.tables import MAIN, PSNR, PSNR_MASKED, Quantity, value
from experiments.cli.progress import ProgressBar
from experiments.figures.style import COLOURS
from refref_jax import atomic_files

_WHAT = (
    "Error: mean over the channels of the absolute difference from the reference. Distance: for "
    "the reference, to the first surface; for methods, the median of the field's weights along the "
    "path, which clear glass does not stop; for external methods, the given one. Grey: no distance."
)

# Number of failure cases per method.
_MOST_CASES = 10

_COSTS = {
    "steps": ("steps", 0),
    "seconds_per_step": ("s per step, median", 3),
    "train_seconds": ("s of training", 0),
    "startup_seconds": ("s of startup", 0),
    "seconds_per_image": ("s per image", 2),
    "peak_host_mib": ("peak MiB of the host", 0),
    "peak_device_mib": ("peak MiB of the device", 0),
}

_NOISY = (
    "Times are those of the machines that ran the jobs, including their other load: they are "
    "noisy, so tables omit them."
)

FILE = "report.html"

# Largest number of images in a report, at least one view per scene: at about 5 KiB each with 200
# pixels they take 20 MiB.
_MOST_PICTURES = 3000

_NOTHING_FROM_OUTSIDE = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
)

_ASSETS = Path(__file__).parent


def address(scene: str, view: str | None = None) -> str:
    """Returns the link to a scene's page, optionally to a view."""
    words = [scene] if view is None else [scene, view]
    return "#scene/" + "/".join(quote(word, safe="") for word in words)


def show_scene(out: Path, scene: Scene, views: Sequence[str], *, edge: int, prefix: str) -> Shown:
    """Returns the page of a scene.

    Args:
      out: folder of the benchmark.
      scene: scene with its results.
      views: names of the views to show.
      edge: longest edge of an image, pixels.
      prefix: prefix of the identifiers of its images, unique among the scenes.
    """
    places: Places = {}
    articles = []
    for i, name in enumerate(views):
        view = data.read_view(out, scene, name)
        shown = images.show(view, scene, edge, f"{prefix}v{i}")
        articles.append(shown.html)
        places |= shown.places
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
        else tag("p", "No view has been rendered.", class_="note"),
        tag("h3", "Training"),
        charts.training_charts(scene.results),
        class_="scene",
        data_scene=scene.name,
    )
    return Shown(page, places)


def thumbnail(places: Places, view: str, method: str, kind: str) -> Html | None:
    """Returns a small copy of an image of the page, which the script fills in."""
    place = places.get((view, method, kind))
    return None if place is None else tag("img", data_copy=place, alt="", class_="thumb")


def _numbers(scene: Scene) -> Html:
    """Returns all means of a scene, and its other results."""
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
    """Returns the slider between two images, which the script of the page fills and moves."""
    last = charts.families(methods)[0][-1]  # of the main methods, if any

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
        aria_label="Share of the left image",
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


def show_overview(contents: Contents, introduction: str, places: Mapping[str, Places]) -> Html:
    """Returns the first page.

    Args:
      contents: data of the benchmark.
      introduction: text at the top.
      places: identifiers of the images of each scene.
    """
    parts = {
        "scenes": ("Scenes", _scenes(contents, places)),
        "tables": ("Tables", join(map(markup.show, contents.tables))),
        "failures": ("Failure cases", _failures(contents.scenes, places)),
        "jobs": ("Unfinished jobs", _not_done(contents)),
        "settings": ("Settings and costs", _settings(contents)),
    }
    links = [tag("a", title, href=f"#{name}") for name, (title, _) in parts.items()]
    sections = [
        tag("section", tag("h2", title), body, id=name) for name, (title, body) in parts.items()
    ]
    parts_of_it = tag("nav", *links, aria_label="Parts")
    return tag("div", tag("p", introduction), parts_of_it, *sections, id="overview")


def _scenes(contents: Contents, places: Mapping[str, Places]) -> Html:
    """Returns a table of all scenes, with each method's masked PSNR, or that of the image."""
    if not contents.scenes:
        return tag("p", "No job is finished yet.", class_="note")
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
        "PSNR inside the object's mask in dB, mean over a scene's images; of the full image where "
        "there are no masks. The best is bold. Click a scene to see its views."
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
    """Returns the worst views of each method, with a filter that the page's script applies."""
    found = data.failures(scenes, _MOST_CASES)
    if not found:
        return tag("p", "No view has been measured.", class_="note")
    methods = list(dict.fromkeys(case.method for case in found))
    options = [
        tag("option", "all methods", value=""),
        *(tag("option", n, value=n) for n in methods),
    ]
    rows = [_case(case, places[case.scene]) for case in found]
    note = (
        f"The {_MOST_CASES} views of each method with the lowest PSNR inside the mask, the worst "
        "first; views without it come last, by the PSNR of the image. Images: ground truth, "
        "render, error."
    )
    choice = tag("label", "Method: ", tag("select", *options, id="failing"), hidden=True)
    return join([tag("p", note, class_="note"), choice, tag("ol", *rows, class_="cases")])


def _case(case: Case, places: Places) -> Html:
    """Returns a line of the failures, with images if the report has the view."""
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
    left_out = [[f"skipped: {each.name}", each.reason] for each in contents.skipped]
    missing = [[f"unfinished: {name}", "it has no result yet"] for name in contents.missing]
    if not (found := [*failed, *left_out, *missing]):
        return tag("p", "All requested jobs are finished.", class_="note")
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
        given = dict(next(record.options for record in everything if record.method == name))
        given.pop(plan.PROPERTIES, None)  # of that scene alone
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


def write(out: Path, *, views: int, edge: int) -> Path:
    """Writes the report of a benchmark atomically.

    Args:
      out: folder of the benchmark, with its results.json.
      views: number of views per scene to show.
      edge: longest edge of an image in pixels; smaller ones are unchanged.

    Returns:
      Path of the file.

    Raises:
      ValueError: if there are no results, or they are broken.
    """
    everything = data.read(out)
    count = shown_views(everything.scenes, views)
    pages: dict[str, Shown] = {}
    with ProgressBar("report", len(everything.scenes)) as bar:
        for i, scene in enumerate(everything.scenes):
            chosen = data.choose_views(scene, count)
            pages[scene.name] = show_scene(out, scene, chosen, edge=edge, prefix=f"s{i}")
            bar.show(i + 1, scene.name)
    body = [
        tag("h1", "Benchmark"),
        show_overview(
            everything,
            _introduction(everything, count, edge),
            {name: page.places for name, page in pages.items()},
        ),
        *(page.html for page in pages.values()),
    ]
    path = out / FILE
    with atomic_files.written_file(path) as draft:
        draft.write_text(_document("Benchmark", join(body)), encoding="utf-8")
    return path


def shown_views(scenes: tuple[Scene, ...], asked: int) -> int:
    """Returns the number of views per scene in a report of limited size."""
    of_one = sum(3 * (len(scene.results) + 1) for scene in scenes)
    return max(1, min(asked, _MOST_PICTURES // max(1, of_one)))


def _introduction(everything: Contents, count: int, edge: int) -> str:
    results = sum(len(scene.results) for scene in everything.scenes)
    views = max((len(data.view_names(scene)) for scene in everything.scenes), default=0)
    preset, steps = everything.settings.preset, everything.settings.steps
    return (
        f"Results: {results}, scenes: {len(everything.scenes)}; preset {preset}, {steps} steps. "
        f"Images: {min(count, views)} of at most {views} test views per scene, three in five where "
        "methods fail most and the others spread evenly. They are compressed, and downsampled if "
        f"they have more than {edge} pixels per edge; all numbers are those of the originals."
    )


def _document(title: str, body: Html) -> str:
    colours = ";".join(f"--c{i}:{colour}" for i, colour in enumerate(COLOURS))
    style = f":root{{{colours}}}\n{(_ASSETS / 'report.css').read_text('utf-8')}"
    script = (_ASSETS / "report.js").read_text("utf-8")
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=_NOTHING_FROM_OUTSIDE),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="color-scheme", content="light dark"),
        tag("title", title),
        tag("style", Html(style)),
    )
    page = tag("body", tag("main", body), tag("script", Html(script)))
    return f"<!doctype html>\n{tag('html', head, page, lang='en')}\n"
