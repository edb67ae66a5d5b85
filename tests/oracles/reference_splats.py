"""Gaussian splatting in plain NumPy and float64, one Gaussian after the other, without tiles.

Written from the equations of Kerbl et al. (2023) and Zwicker et al. (2002): matrices, a blend of
whole images, and the derivative from back to front.
"""

import numpy as np

BLUR, LEAST_ALPHA, MOST_ALPHA, OPAQUE = 0.3, 1.0 / 255.0, 0.999, 1e-4


def rotation(quaternion):
    """Returns the matrix of a quaternion `w, x, y, z`, by Rodrigues' formula."""
    w, *axis = quaternion / np.linalg.norm(quaternion)
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def project(mean, quaternion, scales, view, focal, width, height):
    """Returns centre, covariance with blur, covariance without it, and depth of one Gaussian.

    The view has the rotation from the world into the camera frame (x right, y down, z forward) and
    the camera's position.
    """
    turn, position = view
    x, y, z = turn @ (mean - position)
    spread = rotation(quaternion) @ np.diag(scales)
    limit = 1.3 * 0.5 * np.array([width, height]) / focal
    u, v = np.clip(x / z, -limit[0], limit[0]), np.clip(y / z, -limit[1], limit[1])
    jacobian = focal / z * np.array([[1.0, 0.0, -u], [0.0, 1.0, -v]])
    covariance = jacobian @ turn @ spread @ spread.T @ turn.T @ jacobian.T
    centre = focal * np.array([x, y]) / z + 0.5 * np.array([width, height])
    return centre, covariance + BLUR * np.eye(2), covariance, z


def _alphas(centre, conic, opacity, width, height):
    row, column = np.indices((height, width))
    along, across = column + 0.5 - centre[0], row + 0.5 - centre[1]
    power = 0.5 * (conic[0] * along**2 + conic[2] * across**2) + conic[1] * along * across
    falloff = np.exp(-power)
    raw = opacity * falloff
    alpha = np.where(raw < LEAST_ALPHA, 0.0, np.minimum(raw, MOST_ALPHA))
    return along, across, falloff, raw, alpha


def blend(centres, conics, opacities, colours, depths, width, height):
    """Returns image, transmittance, and what `slopes` needs; pixels end before they are opaque."""
    image, passing = np.zeros((height, width, 3)), np.ones((height, width))
    open_, visits = np.ones((height, width), bool), []
    for i in np.argsort(depths, kind="stable"):
        seen = _alphas(centres[i], conics[i], opacities[i], width, height)
        open_ = open_ & (passing * (1.0 - seen[-1]) > OPAQUE)
        alpha = np.where(open_, seen[-1], 0.0)
        visits.append((i, seen, alpha, passing))
        image = image + (alpha * passing)[..., None] * colours[i]
        passing = passing * (1.0 - alpha)
    return image, passing, visits


def slopes(conics, colours, visits, by_image, by_transmittance):
    """Returns the derivatives with respect to centres, conics, opacities and colours.

    From back to front: `behind` is the colour that a pixel has behind a Gaussian.
    """
    count = len(conics)
    by_centre, by_conic = np.zeros((count, 2)), np.zeros((count, 3))
    by_opacity, by_colour = np.zeros(count), np.zeros((count, 3))
    behind = np.zeros_like(by_image)
    last = visits[-1][3] * (1.0 - visits[-1][2]) if visits else None
    for i, (along, across, falloff, raw, _), alpha, passing in reversed(visits):
        by_colour[i] = np.einsum("hw,hwc->c", alpha * passing, by_image)
        by_alpha = passing * np.sum((colours[i] - behind) * by_image, axis=-1)
        by_alpha -= by_transmittance * last / (1.0 - alpha)
        by_alpha = np.where((alpha > 0.0) & (raw < MOST_ALPHA), by_alpha, 0.0)
        behind = alpha[..., None] * colours[i] + (1.0 - alpha)[..., None] * behind
        by_opacity[i] = np.sum(by_alpha * falloff)
        by_power = -by_alpha * raw
        a, b, c = conics[i]
        by_centre[i] = [
            -np.sum(by_power * (a * along + b * across)),
            -np.sum(by_power * (c * across + b * along)),
        ]
        by_conic[i] = [
            0.5 * np.sum(by_power * along**2),
            np.sum(by_power * along * across),
            0.5 * np.sum(by_power * across**2),
        ]
    return by_centre, by_conic, by_opacity, by_colour
