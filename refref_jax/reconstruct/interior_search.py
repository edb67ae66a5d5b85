"""Finds out what is inside a vessel of revolution, from photographs of light refracted by it.

Descent cannot turn solid glass into a bottle of water: what is seen through it moves by tens of
degrees. So `search` looks at many hypotheses through a blurred backdrop, where a rough one is
already better than none; tints come first, because they remove most of the error, and are found
without tracing light again. The best hypotheses of each kind are improved by Gauss-Newton steps,
first of their few numbers, then of all unknowns. The simplest one that explains held-out pixels not
significantly worse than the best is kept.

The outer surface must come from masks: fitting it to light first would dent it.

Source: ours.
"""

import contextlib
import dataclasses
import functools
import itertools
import math
import operator
import threading
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
import scipy.sparse
from jaxtyping import Float

from refref_jax.compilation import at_once
from refref_jax.reconstruct import ReconstructionError, gauss_newton, photometry
from refref_jax.reconstruct.contents import COARSE, FINE, Detail, Interior
from refref_jax.reconstruct.families import Revolution
from refref_jax.reconstruct.gauss_newton import Candidate, Fit, Matrix, Model, Rows, Steps
from refref_jax.reconstruct.interior_looks import (
    Look,
    SearchSettings,
    extent,
    finalists,
    looks_at,
    looks_at_all,
)
from refref_jax.reconstruct.interiors import Vessel
from refref_jax.reconstruct.model_selection import Trial, choose, judged
from refref_jax.reconstruct.photometry import Backdrop, Photographs

# Share of the pixels of largest derivatives that a step leaves out: interiors have many surfaces.
_OUTLIERS = 0.02

# Levels, gaps, bases, lids and punts that are looked at again, as shares of the height, and the
# blur of these looks.
_SHIFTS = (0.03, -0.03, 0.05, -0.05, 0.08, -0.08, 0.12, -0.12)
_GAPS = (0.002, 0.008, 0.02, 0.04, 0.07, 0.1)
_BASES = (0.03, 0.05, 0.07, 0.1, 0.14, 0.2, 0.28, 0.36, 0.45, 0.55, 0.7, 0.85)
_LIDS = (0.03, 0.05, 0.08, 0.12, 0.17, 0.24, 0.33, 0.45)
_PUNTS = (0.006, 0.012, 0.02, 0.03, 0.045)
_BLUR = 2

# Shares of the work that are done after looks, rough fits, more looks, fits of all unknowns, and
# further steps.
_LOOKED, _ROUGH, _AGAIN, _ALL, _LAST = 0.1, 0.4, 0.6, 0.75, 0.85

_Start = TypeVar("_Start")


class Finding(NamedTuple):
    """A hypothesis after it was fitted.

    Attributes:
      vessel: model of the hypothesis.
      trial: result of its fit.
    """

    vessel: Vessel
    trial: Trial

    @property
    def name(self) -> str:
        """What is inside, in words."""
        return self.vessel.interior_at_start.name

    @property
    def x(self) -> Float[np.ndarray, " unknowns"]:
        """Unknowns of the vessel."""
        return self.trial.fit.x

    @property
    def error(self) -> float:
        """Mean robust error of the held-out pixels, sRGB."""
        return self.trial.error


class Found(NamedTuple):
    """Result of a search.

    Attributes:
      best: the simplest finding that is not significantly worse than the best.
      findings: all findings, in the order of their number of unknowns.
      looks: all hypotheses that were looked at, the best first.
    """

    best: Finding
    findings: list[Finding]
    looks: list[Look]


class Few:
    """A model of which only some combinations of the unknowns may change.

    Attributes:
      model: the model.
      origin: its unknowns at rest.
      directions: changes of the unknowns with each of the few.
    """

    def __init__(
        self,
        model: Model,
        origin: Float[np.ndarray, " unknowns"],
        directions: Float[np.ndarray, "unknowns few"],
    ) -> None:
        """Takes the model and the combinations."""
        self.model, self.origin, self.directions = model, origin, directions

    def start(self) -> Float[np.ndarray, " few"]:
        """Returns zeros."""
        return np.zeros(self.directions.shape[1])

    def whole(self, x: Float[np.ndarray, " few"]) -> Float[np.ndarray, " unknowns"]:
        """Returns the unknowns of the model."""
        return self.origin + self.directions @ x

    def pose(self, x: Float[np.ndarray, " few"]) -> Candidate:
        """Returns the scene."""
        found = self.model.pose(self.whole(x))
        parts = tuple(
            part._replace(
                by_vertices=np.asarray(part.by_vertices @ self.directions),
                by_normals=np.asarray(part.by_normals @ self.directions),
            )
            for part in found.parts
        )
        few = scipy.sparse.csr_array(self.directions)
        absorptions = found.by_absorptions
        return found._replace(
            parts=parts,
            by_indices=found.by_indices @ few,
            by_tints=found.by_tints @ few,
            by_absorptions=None if absorptions is None else absorptions @ few,
        )

    def prior(self, x: Float[np.ndarray, " few"]) -> tuple[Matrix, Float[np.ndarray, " few"]]:
        """Returns the prior of the model."""
        precision, gradient = self.model.prior(self.whole(x))
        return self.directions.T @ precision @ self.directions, self.directions.T @ gradient

    def scales(self) -> Float[np.ndarray, " few"]:
        """Returns the largest change of each."""
        ratios = np.abs(self.directions) / self.model.scales()[:, None]
        return 1.0 / np.max(ratios, axis=0)


def search(
    outer: Revolution,
    surface: Backdrop,
    pixels: Photographs,
    judges: Photographs,
    *,
    settings: SearchSettings | None = None,
    detail: Detail = FINE,
    outlines: Callable[[Candidate], Rows] | None = None,
    looks: list[Look] | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> Found:
    """Finds what is inside a vessel.

    Args:
      outer: the outer surface, fitted to masks only.
      surface: backdrop.
      pixels: pixels that see the vessel, of photographs to fit to.
      judges: pixels of other photographs, which decide between hypotheses.
      settings: settings of the search.
      detail: resolution of the meshes of the last fit.
      outlines: equations of the masks' outlines, for that fit.
      looks: looks at all hypotheses, if there are any yet (`looks_at_all`).
      progress: function called with the share of the work that is done, and a line of text; by one
        thread at a time, which may be another one.

    Raises:
      ReconstructionError: if there are no pixels, the object is a ring, or no wall fits into it.
    """
    settings, say = settings or SearchSettings(), progress or (lambda share, text: None)
    looks = looks or looks_at_all(outer, surface, pixels, settings)
    say(_LOOKED, f"{len(looks)} looks; best: {looks[0].interior.name}, error {looks[0].error:.4f}")
    few = finalists(looks, settings)
    report = _reporter(say, _LOOKED, _ROUGH, len(few))
    first = functools.partial(_few_fitted, outer, surface, pixels, judges, settings)
    rivals = _best_of_kinds(_fit_each(first, few, "first steps", report), settings)
    report = _reporter(say, _ROUGH, _AGAIN, len(_with_each_mouth(rivals, settings)))
    again = _looked_again(outer, rivals, surface, pixels, settings, report=report)
    again = again or [each.vessel.interior_at_start for each in rivals]
    fitted = functools.partial(_fitted, surface, pixels, judges, outlines)

    def fit_all(vessel: Vessel, limits: tuple[float, ...] = ()) -> Finding:
        return fitted(settings, vessel, vessel.start(), settings.all, limits=limits)

    report = _reporter(say, _AGAIN, _ALL, len(again) + len(settings.level_shifts))
    vessels = [Vessel(outer, interior, detail._replace(fine=False)) for interior in again]
    vessels.sort(key=lambda each: each.layout.count)
    findings = _fit_each(fit_all, vessels, "all unknowns", report)
    leading = min(findings, key=_error)
    steps = leading.trial.fit.steps
    limits = tuple(settings.close * min(step.before, step.after) for step in steps)
    fit_rival = functools.partial(fit_all, limits=limits)
    others = _with_other_levels(leading, settings)
    for moved in _fit_each(fit_rival, others, "another level", report):
        findings = [_better(moved, each) for each in findings]
    findings = _with_further_steps(findings, fitted, settings, say)
    best = _simplest(findings)
    if settings.finest and outer.is_fine:
        many = dataclasses.replace(
            settings, rays=2 * settings.rays, last_rays=2 * settings.last_rays
        )
        report = _reporter(say, _LAST, 1.0, len(settings.finest))
        finest = fitted(many, *refined(best.vessel, best.x, detail), settings.finest, report=report)
        findings = [finest if each is best else each for each in findings]
        best = finest
    return Found(best, findings, looks)


def _fit_each(
    fit: Callable[[_Start], Finding],
    starts: Sequence[_Start],
    what: str,
    report: Callable[[str], None],
) -> list[Finding]:
    """Returns the findings of fits, two of which run at once on a CPU; each is reported."""

    def reported(start: _Start) -> Finding:
        found = fit(start)
        report(f"{found.name}: {what}, error {found.error:.4f}")
        return found

    return at_once(reported, starts)


def _with_other_levels(finding: Finding, settings: SearchSettings) -> list[Vessel]:
    """Returns the vessel of a finding with other levels: its walls may have hidden a wrong one."""
    at, vessel, found = _with_wall(finding), finding.vessel, []
    for shift in settings.level_shifts if at.level_unknown else ():
        level = at.level + shift * extent(vessel.outer)[0]
        with contextlib.suppress(ReconstructionError):  # of a wall that leaves no space
            moved = dataclasses.replace(at, level=level)
            found.append(Vessel(vessel.outer, moved, vessel.detail))
    return found


def _better(finding: Finding, other: Finding) -> Finding:
    """Returns a finding if it has the kind of another one and a smaller error; else the other."""
    return finding if finding.name == other.name and finding.error < other.error else other


def _reporter(
    say: Callable[[float, str], None], begin: float, end: float, count: int
) -> Callable[[str], None]:
    """Returns a function that reports one more of some pieces of work between two shares."""
    done, lock = itertools.count(1), threading.Lock()

    def report(text: str) -> None:
        with lock:
            say(begin + (end - begin) * min(next(done) / max(count, 1), 1.0), text)

    return report


def refined(
    vessel: Vessel, x: Float[np.ndarray, " unknowns"], detail: Detail
) -> tuple[Vessel, Float[np.ndarray, " others"]]:
    """Returns a vessel with another detail, and the unknowns that give it the same shape.

    Args:
      vessel: model of a vessel.
      x: its unknowns.
      detail: detail of the other; its relief gets no offsets.
    """
    other = Vessel(vessel.outer, vessel.interior_at_start, detail)
    found, old, new = other.start(), vars(vessel.layout), vars(other.layout)
    for name, place in old.items():
        if isinstance(place, slice) and name not in ("outer", "relief"):
            found[new[name]] = x[place]
    wall = vessel.outer_wall
    offsets = wall.hats @ x[vessel.layout.outer]
    found[other.layout.outer] = np.interp(other.outer_wall.knots, wall.at, offsets)
    return other, found


def _with_further_steps(
    findings: Sequence[Finding],
    fitted: Callable[..., Finding],
    settings: SearchSettings,
    say: Callable[[float, str], None],
) -> list[Finding]:
    """Returns the findings, with further steps for those not clearly worse than the best."""
    least = min(each.error for each in findings)
    close = [each for each in findings if settings.last and each.error <= settings.close * least]
    last = _fit_each(
        lambda each: fitted(settings, each.vessel, each.x, settings.last),
        close,
        "further steps",
        _reporter(say, _ALL, _LAST, len(close)),
    )
    better = {id(each): found for each, found in zip(close, last, strict=True)}
    return [better.get(id(each), each) for each in findings]


def _few_fitted(
    outer: Revolution,
    surface: Backdrop,
    pixels: Photographs,
    judges: Photographs,
    settings: SearchSettings,
    found: Look,
) -> Finding:
    """Returns a hypothesis after steps of its few numbers and of the thickness of its wall."""
    vessel = Vessel(outer, found.interior, COARSE)
    x, layout = vessel.start(), vessel.layout
    one = np.eye(len(x))
    columns = [one[:, layout.outer].sum(axis=1)]
    if layout.inner.stop > layout.inner.start:
        columns.append(one[:, layout.inner].sum(axis=1))
    columns += list(one[:, layout.inner.stop :].T)
    few = Few(vessel, x, np.stack(columns, axis=1))
    half = settings.rays // 2
    steps = Steps(settings.few, half, half, _OUTLIERS, seed=settings.seed)
    fit = gauss_newton.fit(few, few.start(), surface, pixels, settings=steps)
    covariance = few.directions @ fit.covariance @ few.directions.T
    whole = Fit(few.whole(fit.x), covariance, fit.steps)
    return _finding(vessel, whole, surface, judges)


def _fitted(
    surface: Backdrop,
    pixels: Photographs,
    judges: Photographs,
    outlines: Callable[[Candidate], Rows] | None,
    settings: SearchSettings,
    vessel: Vessel,
    x: Float[np.ndarray, " unknowns"],
    blurs: tuple[int, ...],
    *,
    limits: tuple[float, ...] = (),
    report: Callable[[str], None] = lambda text: None,
) -> Finding:
    """Returns a hypothesis after steps of all unknowns, of which each is reported."""
    fit = gauss_newton.fit(
        vessel,
        x,
        surface,
        pixels,
        settings=Steps(
            blurs,
            settings.last_rays,
            settings.rays,
            _OUTLIERS,
            seed=settings.seed + len(blurs),
            limits=limits,
        ),
        outlines=outlines,
        progress=lambda number, facts: report(
            f"{vessel.interior_at_start.name}: error {min(facts.before, facts.after):.4f}"
        ),
    )
    return _finding(vessel, fit, surface, judges)


def _finding(vessel: Vessel, fit: Fit, surface: Backdrop, judges: Photographs) -> Finding:
    inside = vessel.interior_at_start
    name = "stained glass" if inside.contents == "none" else f"vessel: {inside.name}"
    return Finding(vessel, judged(name, vessel, fit, surface, judges))


def _with_wall(finding: Finding) -> Interior:
    """Returns the interior of a finding, with its thickness as that of the wall at rest."""
    vessel, x = finding.vessel, finding.x
    interior, layout = vessel.interior(x), vessel.layout
    if layout.inner.stop == layout.inner.start:
        return interior
    wall = interior.wall - float(x[layout.inner].mean())
    return dataclasses.replace(interior, wall=max(wall, 0.5 * interior.wall))


def _looked_again(
    outer: Revolution,
    findings: Sequence[Finding],
    surface: Backdrop,
    pixels: Photographs,
    settings: SearchSettings,
    *,
    report: Callable[[str], None] = lambda text: None,
) -> list[Interior]:
    """Returns the interiors of findings, with the level, gap, ends and punt that suit them best.

    Steps move a level by little, never open a mouth, and do not fill a stem with glass. So numbers
    around those of a finding are looked at, one kind after the other, with each mouth, which only
    the fit of all unknowns can tell apart.
    """
    some = pixels.drawn(np.random.default_rng(settings.seed + 1), settings.pixels)
    blurred, size = photometry.blurred(surface, _BLUR), extent(outer)[0]

    def look_again(at: Interior) -> Look:
        best = Look(at, math.inf)
        for variants in _VARIANTS:
            others = variants(best.interior, size)
            if others:
                again = [best.interior, *others]
                best = min(looks_at(again, outer, blurred, some), key=_error, default=best)
        if best.error < math.inf:  # otherwise there is no mouth at its top
            report(f"{best.interior.name}: looked again, error {best.error:.4f}")
        return best

    looks = [look_again(at) for at in _with_each_mouth(findings, settings)]
    least = min((each.error for each in looks), default=math.inf)
    kept = [each for each in looks if each.error <= settings.rivals * least < math.inf]
    return [each.interior for each in kept]


def _with_each_mouth(findings: Sequence[Finding], settings: SearchSettings) -> list[Interior]:
    """Returns the interiors of findings, closed and open if they may be.

    Of findings that differ in their mouth, only the better one counts.
    """
    found: dict[str, list[Interior]] = {}
    for finding in sorted(findings, key=_error):
        at = _with_wall(finding)
        may_be_open = at.contents in ("air", "liquid and air")
        mouths = sorted({at.mouth, *settings.mouths}) if may_be_open else [False]
        with_mouths = [dataclasses.replace(at, mouth=mouth) for mouth in mouths]
        found.setdefault(dataclasses.replace(at, mouth=False).name, with_mouths)
    return [each for group in found.values() for each in group]


_error = operator.attrgetter("error")


def _other_levels(at: Interior, size: float) -> list[Interior]:
    """Returns the same with levels around its own."""
    shifts = _SHIFTS if at.level_unknown else ()
    return [dataclasses.replace(at, level=at.level + shift * size) for shift in shifts]


def _other_gaps(at: Interior, size: float) -> list[Interior]:
    """Returns the same with other gaps.

    A thin gap does not show which way it should grow, so they begin at the level or end at the air.
    """
    return [
        dataclasses.replace(at, gap=gap * size, level=at.level + shift)
        for gap in (_GAPS if at.level_unknown else ())
        for shift in (0.0, at.gap - gap * size)
    ]


def _other_bases(at: Interior, size: float) -> list[Interior]:
    """Returns the same with thicker bases, such as the stem of a glass."""
    bases = [base * size for base in _BASES if base * size > at.wall and at.contents != "none"]
    return [dataclasses.replace(at, base=base) for base in bases]


def _other_punts(at: Interior, size: float) -> list[Interior]:
    """Returns the same with hollows under its bottom."""
    return [dataclasses.replace(at, punt=punt * size) for punt in _PUNTS]


def _other_lids(at: Interior, size: float) -> list[Interior]:
    """Returns the same with thicker lids, such as a stopper."""
    closed = at.contents != "none" and not at.mouth
    lids = [lid * size for lid in _LIDS if lid * size > at.wall and closed]
    return [dataclasses.replace(at, lid=lid) for lid in lids]


_VARIANTS = (_other_levels, _other_gaps, _other_bases, _other_lids, _other_punts)


def _best_of_kinds(findings: Sequence[Finding], settings: SearchSettings) -> list[Finding]:
    """Returns the best finding of each kind that is not far worse than the best, simple first."""
    found: dict[str, Finding] = {}
    for each in sorted(findings, key=lambda each: each.error):
        found.setdefault(each.name, each)
    best = min(each.error for each in findings)
    kept = [each for each in found.values() if each.error < settings.rivals * best]
    return sorted(kept, key=lambda each: len(each.x))


def _simplest(findings: Sequence[Finding]) -> Finding:
    """Returns the finding of the trial that `model_selection.choose` keeps."""
    chosen = choose([each.trial for each in findings])
    return next(each for each in findings if each.trial is chosen)
