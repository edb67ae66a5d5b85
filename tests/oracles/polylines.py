"""Distances from polylines."""

import numpy as np


def distances(points, curve):
    """Returns the distance of points from a polyline, edge by edge."""
    start, way = curve[:-1], np.diff(curve, axis=0)
    off = points[:, None] - start
    along = np.clip(np.sum(off * way, -1) / np.sum(way**2, -1), 0.0, 1.0)
    return np.linalg.norm(off - along[..., None] * way, axis=-1).min(axis=1)
