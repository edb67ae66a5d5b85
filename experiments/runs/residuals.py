"""Finds out which wrong input residuals of renderings look like: cameras, background or object.

A photograph that is shifted by a displacement `d` against the rendering differs from it by
`-gradient . d` to first order, so that least squares over pixels find `d`. Beside the object, where
light is straight, wrong cameras shift an image, and a background of the wrong size makes it grow.
Inside the outline, the refracted image grows with errors of index and size, and moves with errors
of the object's place, direction and shape. Residuals along the outline alone indicate a wrong
silhouette. `docs/captures.md` has what each wrong input looks like, measured.

Source: Lucas and Kanade, An Iterative Image Registration Technique (1981), one step.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_dilation, binary_erosion, gaussian_filter

# Deviation of the blur before differences are taken, pixels, and distance from the outline of
# pixels that count as inside or beside.
_BLUR = 1.0
_APART = 3

# Fewest pixels that say something, and condition of their normal matrix above which they do not, as
# in front of plain walls or of stripes.
_FEWEST = 200
_SINGULAR = 1e8

# Least displacements that lead to a warning, pixels: a tenth of a pixel costs about a decibel. They
# must be larger than this many standard deviations, too.
_SHIFTED, _GROWN, _MOVED = 0.05, 0.1, 0.1
_CERTAIN = 5.0

# Least share of the squared residuals that a displacement must explain: of the blur of a field that
# is not trained yet it explains less.
_EXPLAINED = 0.05

# Share of the larger of growth and shift below which the other one is left out.
_LESSER = 0.25

# Least residual along the outline that leads to a warning, sRGB, and its ratio to that inside.
_ROUGH, _ROUGHER = 0.1, 2.0


class Motion(NamedTuple):
    """Displacement of an image that explains its residuals best, by least squares.

    Attributes:
      shift: displacement of the photograph against the rendering, pixels: right and down.
      growth: magnification less 1 about the centre of the pixels.
      deviation: standard deviation of the shift if residuals were independent, pixels.
      reach: root mean square distance of the pixels from their centre.
      explained: share of the squared residuals that the motion explains beyond gains.
    """

    shift: Float[np.ndarray, "2"]
    growth: float
    deviation: float
    reach: float
    explained: float = 1.0

    @property
    def length(self) -> float:
        """Length of the shift, pixels."""
        return float(np.hypot(*self.shift))


class Residuals(NamedTuple):
    """Residuals of one view; `None` where there are too few pixels.

    Attributes:
      beside: motion of the pixels beside the object.
      inside: motion of the pixels inside its outline.
      rim: root mean square residual near the outline, sRGB.
      interior: the same well inside.
    """

    beside: Motion | None
    inside: Motion | None
    rim: float | None
    interior: float | None


def of_view(
    rendered: Float[np.ndarray, "h w 3"],
    target: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"] | None,
) -> Residuals:
    """Returns the residuals of a rendering.

    Args:
      rendered: sRGB image in `[0, 1]`.
      target: photograph, likewise.
      mask: mask of the object; without one, nobody knows where light is straight.
    """
    if mask is None:
        return Residuals(None, None, None, None)
    square = np.ones((2 * _APART + 1, 2 * _APART + 1), bool)
    inner, outer = binary_erosion(mask, square), ~binary_dilation(mask, square)
    near = ~inner & ~outer
    error = np.sqrt(np.mean(np.square(target - rendered), axis=-1))
    return Residuals(
        motion(rendered, target, outer),
        motion(rendered, target, inner),
        _rms(error[near]),
        _rms(error[inner]),
    )


def motion(
    rendered: Float[np.ndarray, "h w 3"],
    target: Float[np.ndarray, "h w 3"],
    among: Bool[np.ndarray, "h w"],
) -> Motion | None:
    """Returns the motion that explains the residuals of some pixels; `None` if it is not known.

    Args:
      rendered: sRGB image in `[0, 1]`.
      target: photograph, likewise.
      among: the pixels.
    """
    if np.count_nonzero(among) < _FEWEST:
        return None
    blur = (_BLUR, _BLUR, 0.0)
    ours, theirs = gaussian_filter(rendered, blur), gaussian_filter(target, blur)
    slopes = np.stack(np.gradient(0.5 * (ours + theirs), axis=(1, 0)), axis=-1)[among]
    row, column = np.nonzero(among)
    offsets = np.stack([column - column.mean(), row - row.mean()], axis=-1)[:, None]
    growing = np.sum(slopes * offsets, axis=-1, keepdims=True)
    # Exposure and white balance are no displacement.
    gains = ours[among][:, :, None] * np.eye(3)
    design = np.concatenate([slopes, growing, gains], axis=-1).reshape(-1, 6)
    # The photograph has at a pixel what the rendering has at the pixel less the displacement.
    wanted = (ours - theirs)[among].reshape(-1)
    normal = design.T @ design
    if not np.linalg.cond(normal) < _SINGULAR:
        return None
    found = np.linalg.solve(normal, design.T @ wanted)
    left = wanted - design @ found
    gain = np.linalg.lstsq(design[:, 3:], wanted, rcond=None)[0]
    alone = float(np.sum(np.square(wanted - design[:, 3:] @ gain)))
    explained = 1.0 - float(np.sum(np.square(left))) / alone if alone > 0.0 else 0.0
    covariance = np.linalg.inv(normal) * np.mean(np.square(left))
    reach = float(np.sqrt(np.mean(np.sum(np.square(offsets), axis=-1))))
    deviation = float(np.sqrt(np.trace(covariance[:2, :2])))
    return Motion(found[:2], float(found[2]), deviation, reach, explained)


def _rms(errors: Float[np.ndarray, " n"]) -> float | None:
    return float(np.sqrt(np.mean(np.square(errors)))) if errors.size >= _FEWEST else None


def warnings(views: Sequence[Residuals]) -> tuple[str, ...]:
    """Returns what residuals look like, a sentence each; nothing if they look like noise.

    Cameras are wrong each in its own way, so that lengths of shifts count; everything else is the
    same in all views. Wrong cameras and backgrounds also shift what is inside the outline, so that
    no warning of the object joins theirs.

    Args:
      views: residuals of several views.
    """
    beside = [view.beside for view in views if view.beside is not None]
    inside = [view.inside for view in views if view.inside is not None]
    found = []
    shift, grown = _typical(beside, _shift), _typical(beside, _growth)
    if shift > max(_SHIFTED, _LESSER * abs(grown)):
        found.append(
            f"beside the object, images are shifted by {shift:.2f} pixels: cameras are a little "
            "off. Refine them, or do not trust differences of less than a decibel."
        )
    if abs(grown) > max(_GROWN, _LESSER * shift):
        found.append(
            f"beside the object, images are {'larger' if grown > 0.0 else 'smaller'} than they are "
            f"rendered, by {abs(grown):.2f} pixels: check size and centre of the background, and "
            "the focal length."
        )
    if found:
        return tuple(found)
    grown, moved = _typical(inside, _growth), _typical(inside, _shift)
    if abs(grown) > max(_SHIFTED, _LESSER * moved):
        found.append(
            f"inside the outline, what is refracted is {'larger' if grown > 0.0 else 'smaller'} "
            f"than it is rendered, by {abs(grown):.2f} pixels: index of refraction or size of the "
            "object. Find them with experiments.reconstruct or experiments.align."
        )
    if moved > max(_MOVED, _LESSER * abs(grown)):
        found.append(
            f"inside the outline, what is refracted is shifted by {moved:.2f} pixels: place, "
            "direction or shape of the object. Align its mesh with experiments.align."
        )
    return tuple(found) or _outline_warnings(views)


def _outline_warnings(views: Sequence[Residuals]) -> tuple[str, ...]:
    pairs = [(v.rim, v.interior) for v in views if v.rim is not None and v.interior is not None]
    if not pairs:
        return ()
    rim, interior = np.median(np.array(pairs), axis=0)
    if rim < max(_ROUGH, _ROUGHER * interior):
        return ()
    return (
        f"residuals concentrate at the outline ({rim:.2f}, inside {interior:.2f}, sRGB): the "
        "silhouette of the object is off. Check masks and mesh, or use more rays per pixel.",
    )


def _shift(motion: Motion) -> float:
    return motion.length


def _growth(motion: Motion) -> float:
    """Returns the displacement by growth at the reach of the pixels."""
    return motion.growth * motion.reach


def _typical(motions: Sequence[Motion], amount: Callable[[Motion], float]) -> float:
    """Returns the median of an amount, 0 if there is none, or it may be noise or blur."""
    if not motions or np.median([motion.explained for motion in motions]) < _EXPLAINED:
        return 0.0
    found = float(np.median([amount(motion) for motion in motions]))
    noise = float(np.median([motion.deviation for motion in motions]))
    return found if abs(found) > _CERTAIN * noise else 0.0
