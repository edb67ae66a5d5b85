"""Finds out what is inside a vessel of revolution, from photographs of light refracted by it.

Descent can not turn solid glass into a bottle of water: what is seen through it moves by tens of
degrees. So `search` looks at many hypotheses through a blurred backdrop, where a rough one is
already better than none; tints come first, because they remove most of the error, and are found
without tracing light again. The best hypotheses of each kind are improved by Gauss-Newton steps,
first of their few numbers, then of all unknowns. The simplest one that explains held-out pixels not
significantly worse than the best is kept.

The outer surface must come from masks: fitting it to light first would dent it.

Source: ours.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np
import scipy.sparse
from jaxtyping import Float

from refref_jax.reconstruct import ReconstructionError, gauss_newton, photometry
from refref_jax.reconstruct.families import Revolution
from refref_jax.reconstruct.gauss_newton import Candidate, Matrix, Model, Rows, Steps
from refref_jax.reconstruct.interiors import COARSE, FINE, Contents, Detail, Interior, Vessel
from refref_jax.reconstruct.photometry import Backdrop, Photographs

# Errors above this multiple of what the backdrop leaves unexplained are those of a wrong interior.
_UNEXPLAINED = 2.5

# Errors of a channel beyond this, in sRGB, do not grow while a tint is found.
_CAP = 0.15

# Logarithms of the tints tried, and the one that counts the crossings.
_LOG_TINTS = np.linspace(0.05, -2.5, 103)
_COUNTING = np.log(0.5)

# Standard errors by which a hypothesis must be worse than the best to lose.
_WORSE = 2.0


@dataclasses.dataclass(frozen=True)
class SearchSettings:
    """Settings of a search.

    Attributes:
      walls: thicknesses of the wall, as shares of the diameter.
      levels: number of heights of the liquid's surface.
      gaps: heights of the glass between liquid and air, as shares of the diameter.
      indices: indices of refraction of the liquid.
      mouths: whether vessels may be closed, open, or both.
      stained: whether the glass may have a tint.
      blur: halvings of the backdrop's resolution in looks.
      pixels: number of pixels of a look.
      finalists: number of hypotheses of each kind that are improved.
      few: blurs of the steps of the few numbers of a hypothesis.
      all: blurs of the steps of all unknowns.
      rays: number of pixels of a step.
      rivals: hypotheses whose error is above that of the best by more than this factor are left
        out before all unknowns are fitted.
      seed: seed of the draws.
    """

    walls: tuple[float, ...] = (0.025, 0.05, 0.1, 0.15)
    levels: int = 10
    gaps: tuple[float, ...] = (0.004, 0.04)
    indices: tuple[float, ...] = (1.36, 1.333, 1.47)
    mouths: tuple[bool, ...] = (False, True)
    stained: bool = False
    blur: int = 3
    pixels: int = 1500
    finalists: int = 2
    few: tuple[int, ...] = (3, 3, 3, 2, 2, 2, 1, 1, 1)
    all: tuple[int, ...] = (2, 1, 1, 0, 0, 0, 0, 0, 0, 0)
    rays: int = 8192
    rivals: float = 1.25
    seed: int = 0


class Look(NamedTuple):
    """A hypothesis and its error.

    Attributes:
      interior: the hypothesis, with the tint that suits it best.
      error: mean robust error of the pixels in sRGB.
    """

    interior: Interior
    error: float


class Finding(NamedTuple):
    """A hypothesis after it was fitted.

    Attributes:
      vessel: its model.
      x: its unknowns.
      covariance: their covariance.
      error: mean robust error of the held-out pixels in sRGB.
    """

    vessel: Vessel
    x: Float[np.ndarray, " unknowns"]
    covariance: Float[np.ndarray, "n n"]
    error: float


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
      directions: how they change with each of the few.
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
        return Candidate(parts, found.interfaces, found.by_indices @ few, found.by_tints @ few)

    def prior(self, x: Float[np.ndarray, " few"]) -> tuple[Matrix, Float[np.ndarray, " few"]]:
        """Returns the prior of the model."""
        precision, gradient = self.model.prior(self.whole(x))
        return self.directions.T @ precision @ self.directions, self.directions.T @ gradient

    def scales(self) -> Float[np.ndarray, " few"]:
        """Returns the largest change of each."""
        ratios = np.abs(self.directions) / self.model.scales()[:, None]
        return 1.0 / np.max(ratios, axis=0)


def unexplained(error: float, floor: float) -> bool:
    """Returns whether the error of the best single body calls for a search of what is inside.

    Args:
      error: mean robust error of pixels through the body (`gauss_newton.errors_of`).
      floor: mean robust error of pixels beside it, which see the backdrop directly.
    """
    return error > _UNEXPLAINED * floor


def hypotheses(body: Revolution, settings: SearchSettings = SearchSettings()) -> list[Interior]:
    """Returns what may be inside a body, the simplest first.

    Indices other than the first, and open vessels, are tried later, for the best of these.
    """
    size, low = _extent(body)
    kinds: tuple[Contents, ...] = ("none", "air", "liquid", "liquid and air")
    found = []
    for contents in kinds:
        for wall in settings.walls if contents != "none" else settings.walls[:1]:
            at = Interior(
                contents,
                wall=wall * size,
                gap=settings.gaps[-1] * size,
                liquid=settings.indices[0],
                stained=settings.stained,
            )
            if not at.level_unknown:
                found.append(at)
                continue
            inside = (1.0 - 2.0 * wall) * size
            steps = (np.arange(settings.levels) + 0.5) / settings.levels
            levels = low + wall * size + inside * steps
            found += [dataclasses.replace(at, level=float(level)) for level in levels]
    return found


def _extent(body: Revolution) -> tuple[float, float]:
    """Returns the height of a body and its lower end."""
    heights = body.points[:, 1]
    return float(heights.max() - heights.min()), float(heights.min())


def look(
    body: Revolution,
    interior: Interior,
    surface: Backdrop,
    pixels: Photographs,
    detail: Detail = COARSE,
) -> Look:
    """Predicts some pixels for a hypothesis, with the tint that suits it best.

    Light that crosses tinted surfaces n times fades with the nth power of the tint. Prediction with
    another tint gives n, a mean over the light of the pixel, and the tint follows without tracing.

    Raises:
      ReconstructionError: if the wall leaves no space inside.
    """
    solid = interior.contents == "none"
    # Solid glass is looked at as if it had an inside of glass: one compiled program serves all.
    seen = dataclasses.replace(interior, contents="liquid", liquid=interior.glass)
    vessel = Vessel(body, seen if solid else interior, detail)
    x, layout = vessel.start(), vessel.layout
    where = layout.tint if interior.filled else layout.glass_tint
    scene = gauss_newton.body_of(vessel.pose(x))
    clear = photometry.predict(scene, surface, pixels.rays)
    linear = clear.linear
    if where.stop > where.start:
        darker = x.copy()
        darker[where] += _COUNTING
        interfaces = jax.device_put(vessel.pose(darker).interfaces)
        scene = scene._replace(scene=scene.scene._replace(interfaces=interfaces))
        dark = photometry.predict(scene, surface, pixels.rays)
        crossings = np.log(np.maximum(dark.linear, 1e-9) / np.maximum(linear, 1e-9)) / _COUNTING
        change = _best_tint(linear, np.maximum(crossings, 0.0), pixels.rgb)
        x[where] += change
        linear = linear * np.exp(change * crossings)
    found = vessel.interior(x)
    if solid:
        found = dataclasses.replace(found, contents="none", liquid=interior.liquid)
    return Look(
        found, float(gauss_newton.robust_errors(clear._replace(linear=linear), pixels.rgb).mean())
    )


def _best_tint(
    linear: Float[np.ndarray, "rays 3"],
    crossings: Float[np.ndarray, "rays 3"],
    rgb: Float[np.ndarray, "rays 3"],
) -> Float[np.ndarray, "3"]:
    """Returns the logarithm of the tint of least robust error, by channel."""
    errors = [
        np.minimum(np.abs(photometry.residuals(linear * np.exp(t * crossings), rgb)), _CAP).mean(0)
        for t in _LOG_TINTS
    ]
    return _LOG_TINTS[np.argmin(np.stack(errors), axis=0)]


def search(
    body: Revolution,
    surface: Backdrop,
    pixels: Photographs,
    judges: Photographs,
    *,
    settings: SearchSettings = SearchSettings(),
    detail: Detail = FINE,
    outlines: Callable[[Candidate], Rows] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Found:
    """Finds what is inside a vessel.

    Args:
      body: the outer surface, fitted to masks only.
      surface: backdrop.
      pixels: pixels that see the vessel, of photographs to fit to.
      judges: pixels of other photographs, which decide between hypotheses.
      settings: settings of the search.
      detail: resolution of the meshes of the last fit.
      outlines: equations of the masks' outlines, for the last fit.
      progress: called with a line about each fit.

    Raises:
      ReconstructionError: if there are no pixels, or the body is a ring.
    """
    if not len(pixels.views) or not len(judges.views):
        raise ReconstructionError("No pixel sees the object. Check the masks and the cameras.")
    say = progress or (lambda line: None)
    looks = _looks(body, surface, pixels, settings)
    say(f"{len(looks)} looks; best: {looks[0].interior.name}, error {looks[0].error:.4f}")
    rough = []
    for each in _finalists(looks, settings):
        finding = _few_fitted(body, each.interior, surface, pixels, judges, settings)
        say(f"{each.interior.name}: looked {each.error:.4f}, error {finding.error:.4f}")
        rough.append(finding)
    rough = _best_of_kinds(rough, settings)
    findings = []
    for each in rough:
        vessel = Vessel(body, _with_wall(each), detail)
        finding = _fitted(vessel, vessel.start(), surface, pixels, judges, settings, outlines)
        say(f"{each.vessel.interior_at_start.name}: all unknowns, error {finding.error:.4f}")
        findings.append(finding)
    return Found(select(findings, surface, judges), findings, looks)


def _looks(
    body: Revolution, surface: Backdrop, pixels: Photographs, settings: SearchSettings
) -> list[Look]:
    """Returns the looks at all hypotheses, the best first."""
    generator = np.random.default_rng(settings.seed)
    some = pixels.chosen(_some(generator, len(pixels.views), settings.pixels))
    blurred = photometry.blurred(surface, settings.blur)

    def tried(interiors: Iterator[Interior] | Sequence[Interior]) -> list[Look]:
        found = []
        for interior in interiors:
            try:
                found.append(look(body, interior, blurred, some))
            except ReconstructionError:
                continue
        return found

    looks = tried(hypotheses(body, settings))
    for variants in (_other_gaps, _other_indices, _other_mouths):
        best = _best_looks(looks, settings)
        looks += tried(other for each in best for other in variants(each.interior, body, settings))
    return sorted(looks, key=lambda each: each.error)


def _some(generator: np.random.Generator, every: int, count: int) -> np.ndarray:
    return generator.choice(every, min(count, every), replace=False)


def _other_gaps(at: Interior, body: Revolution, settings: SearchSettings) -> list[Interior]:
    """Returns the same with other gaps, whose middle stays where it is."""
    size = _extent(body)[0]
    if not at.level_unknown:
        return []
    gaps = [gap * size for gap in settings.gaps]
    return [
        dataclasses.replace(at, gap=gap, level=at.level + 0.5 * (at.gap - gap))
        for gap in gaps
        if gap != at.gap
    ]


def _other_indices(at: Interior, body: Revolution, settings: SearchSettings) -> list[Interior]:
    """Returns the same with other liquids."""
    del body
    others = [index for index in settings.indices if index != at.liquid]
    return [dataclasses.replace(at, liquid=index) for index in others if at.filled]


def _other_mouths(at: Interior, body: Revolution, settings: SearchSettings) -> list[Interior]:
    """Returns the same with an open mouth."""
    del body
    fits = at.contents in ("air", "liquid and air") and True in settings.mouths
    return [dataclasses.replace(at, mouth=True)] if fits else []


def _best_looks(looks: Sequence[Look], settings: SearchSettings) -> list[Look]:
    """Returns the best looks of each kind."""
    names = sorted({each.interior.name for each in looks})
    ordered = sorted(looks, key=lambda each: each.error)
    kinds = [[each for each in ordered if each.interior.name == name] for name in names]
    return [each for kind in kinds for each in kind[: settings.finalists]]


def _finalists(looks: Sequence[Look], settings: SearchSettings) -> list[Look]:
    """Returns the best looks of each kind, without those that are far worse than the best."""
    best = min(each.error for each in looks)
    return [each for each in _best_looks(looks, settings) if each.error < settings.rivals * best]


def _few_fitted(
    body: Revolution,
    interior: Interior,
    surface: Backdrop,
    pixels: Photographs,
    judges: Photographs,
    settings: SearchSettings,
) -> Finding:
    """Returns a hypothesis after steps of its few numbers and of the thickness of its wall."""
    vessel = Vessel(body, interior, COARSE)
    x, layout = vessel.start(), vessel.layout
    one = np.eye(len(x))
    columns = [one[:, layout.outer].sum(axis=1)]
    if layout.inner.stop > layout.inner.start:
        columns.append(one[:, layout.inner].sum(axis=1))
    columns += list(one[:, layout.inner.stop :].T)
    few = Few(vessel, x, np.stack(columns, axis=1))
    steps = Steps(settings.few, settings.rays, min(settings.rays, 8192), seed=settings.seed)
    fit = gauss_newton.fit(few, few.start(), surface, pixels, settings=steps)
    return _finding(vessel, few.whole(fit.x), fit.covariance, surface, judges)


def _fitted(
    vessel: Vessel,
    x: Float[np.ndarray, " unknowns"],
    surface: Backdrop,
    pixels: Photographs,
    judges: Photographs,
    settings: SearchSettings,
    outlines: Callable[[Candidate], Rows] | None,
) -> Finding:
    """Returns a hypothesis after steps of all unknowns."""
    steps = Steps(settings.all, settings.rays, min(settings.rays, 8192), seed=settings.seed)
    fit = gauss_newton.fit(vessel, x, surface, pixels, settings=steps, outlines=outlines)
    return _finding(vessel, fit.x, fit.covariance, surface, judges)


def _finding(
    vessel: Vessel,
    x: Float[np.ndarray, " unknowns"],
    covariance: Float[np.ndarray, "few few"],
    surface: Backdrop,
    judges: Photographs,
) -> Finding:
    errors = gauss_newton.errors_of(vessel.pose(x), surface, judges)
    return Finding(vessel, x, covariance, float(errors.mean()))


def _with_wall(finding: Finding) -> Interior:
    """Returns the interior of a finding, with its thickness as that of the wall at rest."""
    vessel, x = finding.vessel, finding.x
    interior, layout = vessel.interior(x), vessel.layout
    if layout.inner.stop == layout.inner.start:
        return interior
    wall = interior.wall - float(x[layout.inner].mean())
    return dataclasses.replace(interior, wall=max(wall, 0.5 * interior.wall))


def _best_of_kinds(findings: Sequence[Finding], settings: SearchSettings) -> list[Finding]:
    """Returns the best finding of each kind that is not far worse than the best, simple first."""
    found: dict[str, Finding] = {}
    for each in sorted(findings, key=lambda each: each.error):
        found.setdefault(each.vessel.interior_at_start.name, each)
    best = min(each.error for each in findings)
    kept = [each for each in found.values() if each.error < settings.rivals * best]
    return sorted(kept, key=lambda each: len(each.x))


def select(findings: Sequence[Finding], surface: Backdrop, judges: Photographs) -> Finding:
    """Returns the simplest finding whose error is not significantly above the least.

    It must not be worse than the best by more than two standard errors of the mean over views.

    Args:
      findings: findings, the simplest first.
      surface: backdrop.
      judges: pixels that none was fitted to.
    """
    errors = [
        gauss_newton.errors_of(each.vessel.pose(each.x), surface, judges) for each in findings
    ]
    best = errors[int(np.argmin([each.mean() for each in errors]))]
    _, view = np.unique(judges.views, return_inverse=True)
    counts = np.bincount(view)
    for finding, error in zip(findings, errors, strict=True):
        worse = np.bincount(view, error - best) / counts
        deviation = np.std(worse, ddof=1) / np.sqrt(len(counts)) if len(counts) > 1 else 0.0
        if worse.mean() <= _WORSE * deviation:
            return finding
    return findings[int(np.argmin([each.error for each in findings]))]
