"""Slow float64 oracles for sampling, fields and rendering, in NumPy.

Written from the papers' definitions, one sample and one bin at a time, with nothing taken from
the library. Conventions as there: `edges` are the ends of bins, `weights` their masses.
"""

import itertools
import math

import numpy as np
import scipy.special


def _wide(*arrays):
    """Returns arrays as float64, so that no step of an oracle is rounded to float32."""
    return tuple(np.asarray(array, np.float64) for array in arrays)


# --- points on a polyline ---


def walk_polyline(points, directions, tau, media, bends, t, *, skip_inside=False):
    """Walks a distance along a path and returns position, direction, arc length and outside.

    With `skip_inside`, only the way outside the objects is counted. A segment ends just before
    the next one starts.
    """
    points, directions, tau = _wide(points, directions, tau)
    left, arc = float(t), 0.0
    for i in range(bends + 1):
        outside = bool(media[i] == 0) or i == bends
        counted = outside or not skip_inside
        size = math.inf if i == bends else tau[i + 1] - tau[i]
        if counted and left < size:
            return points[i] + left * directions[i], directions[i], arc + left, outside
        left -= size if counted else 0.0
        arc += size
    raise AssertionError("the last segment of a path never ends")


# --- cones ---


def frustum_moments(radius, start, end):
    """Returns E[t], E[t^2] and the variance along one axis across a uniformly filled frustum.

    Straight from the integrals behind mip-NeRF's Eq 7 and 8: the cross-section grows like t^2,
    and a disc of radius `radius t` has variance `(radius t)^2 / 4` along each of its axes.
    """

    def power(n):
        # (end^n - start^n) / (end - start) without the cancellation.
        return sum(end**k * start ** (n - 1 - k) for k in range(n)) / n

    mean, square = power(4) / power(3), power(5) / power(3)
    return mean, square, radius**2 * square / 4.0


def hexagon_distances(start, end):
    """Returns the distances of Zip-NeRF's six multisamples (Eq 3)."""
    middle, half = (start + end) / 2.0, (end - start) / 2.0
    spread = math.sqrt((half**2 - middle**2) ** 2 + 4.0 * middle**4)
    return np.array(
        [
            start
            + half
            * (end**2 + 2.0 * middle**2 + 3.0 / math.sqrt(7.0) * (2.0 * j / 5.0 - 1.0) * spread)
            / (half**2 + 3.0 * middle**2)
            for j in range(6)
        ]
    )


HEXAGON_ANGLES = np.pi * np.array([0.0, 2.0 / 3.0, 4.0 / 3.0, 1.0, 5.0 / 3.0, 1.0 / 3.0])


# --- distance warps and contraction ---


def power_ladder(x, exponent=-1.5):
    """Returns Zip-NeRF's power transformation of a distance (section 4)."""
    base = abs(exponent - 1.0)
    return base / exponent * ((x / base + 1.0) ** exponent - 1.0)


def warped_distance(near, far, unit, t):
    """Returns the normalised coordinate of a distance: Zip-NeRF's curve of twice the distance."""
    low, high = (power_ladder(2.0 * end / unit) for end in (near, far))
    return (power_ladder(2.0 * _wide(t)[0] / unit) - low) / (high - low)


def contracted(x):
    """Returns Mip-NeRF 360's contraction of a point (Eq 10)."""
    (x,) = _wide(x)
    norm = math.sqrt(sum(c**2 for c in x))
    return x.copy() if norm <= 1.0 else (2.0 - 1.0 / norm) * (x / norm)


# --- step functions ---


def integrate_weights(weights):
    """Returns the normalised cumulative sum; uniform for weights that are all zero."""
    weights = [float(w) for w in weights]
    total = math.fsum(weights)
    if total == 0.0:
        weights, total = [1.0] * len(weights), float(len(weights))
    return np.array([math.fsum(weights[:i]) / total for i in range(len(weights) + 1)])


def invert_cdf(u, edges, cdf):
    """Returns where a piecewise linear cumulative function takes the value `u`.

    Where a whole interval does, its right end; at u = 1 the last such place of the last bin
    that rises, or the last bin's left end where it does not.
    """
    last = len(edges) - 2
    for i in range(last, -1, -1):
        if cdf[i] <= u or i == 0:
            rise = cdf[i + 1] - cdf[i]
            share = (u - cdf[i]) / rise if rise > 0.0 else 0.0
            return edges[i] + share * (edges[i + 1] - edges[i])
    raise AssertionError("a cumulative function has at least one bin")


def sample_intervals(u, edges, weights):
    """Returns the edges of intervals around the quantiles `u` of a step function."""
    (edges,) = _wide(edges)
    cdf = integrate_weights(weights)
    samples = [invert_cdf(float(x), edges, cdf) for x in u]
    inner = [0.5 * (a + b) for a, b in itertools.pairwise(samples)]
    first = max(2.0 * samples[0] - inner[0], edges[0])
    last = min(2.0 * samples[-1] - inner[-1], edges[-1])
    return np.array([first, *inner, last])


def dilated_height(x, edges, weights, amount):
    """Returns the greatest height of a bin within `amount` of a point."""
    edges, weights = _wide(edges, weights)
    tops = [0.0]
    for low, high, weight in zip(edges[:-1], edges[1:], weights, strict=True):
        if high > low and low - amount <= x < high + amount:
            tops.append(weight / (high - low))
    return max(tops)


def blurred_mass_below(x, edges, weights, radius):
    """Returns the mass below `x` of a step function convolved with a box, in closed form."""
    edges, weights = _wide(edges, weights)
    x = float(x)

    def ramp(z):
        """Integrates `clip(z, 0, 2 radius)` from 0."""
        held = min(max(z, 0.0), 2.0 * radius)
        return 0.5 * held**2 + 2.0 * radius * max(z - 2.0 * radius, 0.0)

    total = 0.0
    for low, high, weight in zip(edges[:-1], edges[1:], weights, strict=True):
        if high > low:
            share = ramp(x - low + radius) - ramp(x - high + radius)
            total += weight / (high - low) * share / (2.0 * radius)
    return total


# --- encodings and hash grids ---


def spherical_harmonics(direction):
    """Returns the real spherical harmonics of degree 0 to 3 from SciPy's complex ones.

    Real combination without the Condon-Shortley phase, which SciPy includes.
    """
    x, y, z = (float(c) for c in direction)
    polar, azimuth = math.acos(min(max(z, -1.0), 1.0)), math.atan2(y, x)
    values = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            complex_ = scipy.special.sph_harm_y(degree, abs(order), polar, azimuth)
            phase = (-1.0) ** order
            if order == 0:
                values.append(complex_.real)
            else:
                part = complex_.real if order > 0 else complex_.imag
                values.append(math.sqrt(2.0) * phase * part)
    return np.array(values)


def grid_resolutions(levels, coarsest, finest):
    """Returns cells a side that grow geometrically from the coarsest to the finest level."""
    if levels == 1:
        return [coarsest]
    ratio = math.log(finest / coarsest) / (levels - 1)
    return [round(coarsest * math.exp(ratio * level)) for level in range(levels)]


def vertex_entry(vertex, resolution, entries):
    """Returns the table entry of a vertex: dense if it fits, else Instant NGP's hash (Eq 4)."""
    x, y, z = (int(c) for c in vertex)
    side = resolution + 1
    if side**3 <= entries:
        return x + side * (y + side * z)
    return (x ^ (y * 2654435761 % 2**32) ^ (z * 805459861 % 2**32)) % entries


def touched_entries(position, resolution, entries):
    """Returns the table entries at the corners of a point's cell, with their weights."""
    cell, share = [], []
    for coordinate in position:
        scaled = float(coordinate) * resolution
        low = min(max(math.floor(scaled), 0), resolution - 1)
        cell.append(low)
        share.append(scaled - low)
    touched = []
    for corner in itertools.product((0, 1), repeat=3):
        weight = 1.0
        for fraction, upper in zip(share, corner, strict=True):
            weight *= fraction if upper else 1.0 - fraction
        vertex = [low + upper for low, upper in zip(cell, corner, strict=True)]
        touched.append((vertex_entry(vertex, resolution, entries), weight))
    return touched


def grid_fading(scale, resolution):
    """Returns Zip-NeRF's down-weighting of a level: `erf(1 / sqrt(8 scale^2 n^2))`."""
    if scale == 0.0:
        return 1.0
    return math.erf(1.0 / (math.sqrt(8.0) * scale * resolution))


def grid_features(tables, grid_shape, position, scale):
    """Returns the faded, interpolated features of all levels of a hash grid."""
    levels, coarsest, finest, entries = grid_shape
    features = []
    resolutions = grid_resolutions(levels, coarsest, finest)
    for table, resolution in zip(tables, resolutions, strict=True):
        table = np.asarray(table, np.float64)
        value = np.zeros(table.shape[1])
        for entry, weight in touched_entries(position, resolution, entries):
            value += weight * table[entry]
        features.append(value * grid_fading(float(scale), resolution))
    return np.concatenate(features)


# --- rendering ---


def linear_to_srgb(linear):
    """Returns the sRGB encoding of a linear value (IEC 61966-2-1)."""
    linear = float(linear)
    if linear <= 0.0031308:
        return 12.92 * linear
    return 1.055 * linear ** (1.0 / 2.4) - 0.055


def alpha_weights(density, lengths):
    """Returns the volume rendering weights, one sample after the other."""
    density, lengths = _wide(density, lengths)
    transmittance, weights = 1.0, []
    for sigma, size in zip(density, lengths, strict=True):
        weights.append(transmittance * -math.expm1(-sigma * size))
        transmittance *= math.exp(-sigma * size)
    return np.array(weights)


def median_distance(weights, edges):
    """Returns where the cumulated weight reaches one half, `inf` if it never does."""
    weights, edges = _wide(weights, edges)
    reached = 0.0
    for weight, low, high in zip(weights, edges[:-1], edges[1:], strict=True):
        if reached + weight >= 0.5:
            return low + (0.5 - reached) / weight * (high - low)
        reached += weight
    return math.inf


# --- losses ---


def interlevel(final_edges, final_weights, proposal_edges, proposal_weights, blur):
    """Returns Zip-NeRF's anti-aliased interlevel loss by its definition (section 3)."""
    proposal_edges, proposal_weights = _wide(proposal_edges, proposal_weights)
    below = [blurred_mass_below(x, final_edges, final_weights, blur) for x in proposal_edges]
    total = 0.0
    for low, high, bound in zip(below[:-1], below[1:], proposal_weights, strict=True):
        total += max(high - low - bound, 0.0) ** 2 / (bound + 1e-5)
    return total


def distortion(edges, weights, outside):
    """Returns the corrected distortion loss by its double sum (Mip-NeRF 360, Eq 15)."""
    edges, weights = _wide(edges, weights)
    total, count = 0.0, len(weights)
    for i in range(count):
        for j in range(count):
            if outside[i] and outside[j]:
                middle_i = 0.5 * (edges[i] + edges[i + 1])
                middle_j = 0.5 * (edges[j] + edges[j + 1])
                total += weights[i] * weights[j] * abs(middle_i - middle_j)
        if outside[i]:
            total += weights[i] ** 2 * (edges[i + 1] - edges[i]) / 3.0
    return total
