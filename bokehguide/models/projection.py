"""The bipolar-cone projection: 3D Gaussians as densities on the lens (Eq. 16, 17 and 21).

All points are in the camera frame: the origin is the lens centre, z is along the optical axis. Lens points are `[2, N]`, in
metres, on the plane z = 0.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bokehguide.render.vector import cross, dot

FAR_OUTSIDE = 1e15
"""Coordinates, in metres, of the lens point that stands for a failed draw: far outside any aperture."""
LENS_MARGIN = 1.001
"""Factor of the radius of the lens circle for clipping, so that rounding moves no point of the lens beyond the clip."""


def lens_magnification(depth: Tensor, focus_distance: float) -> Tensor:
    """k = d_F / (d_F - Z) `[N]`: a length at depth Z, projected through x_F, is |k| times as long on the lens plane.

    k has a pole at the focal plane, so that the guides exclude points in focus.
    """
    return focus_distance / (focus_distance - depth)


def project_to_lens(points: Tensor, focus: Tensor) -> Tensor:
    """Lens points `[2, N]` where the lines from `points` through `focus` (both `[3, N]`) meet the lens plane.

    For a distant focus, the form x_F + k (p - x_F) loses digits by cancellation. The code uses k p - (Z / d_F) k x_F.
    """
    k = focus[2] / (focus[2] - points[2])
    return points[:2] * k - focus[:2] * (points[2] / (focus[2] - points[2]))


def lens_density(lens_points: Tensor, focus: Tensor, mean: Tensor, sigma: Tensor) -> Tensor:
    """Density `[N]` per unit area of the lens plane of an isotropic 3D Gaussian seen through x_F (Eq. 16, 17 and 21).

    The directions ω and -ω from x_F belong to the same lens point. The error functions of Eq. 21 cancel in F(ω) + F(-ω), and the
    density is (σ² + a²) / (2πσ²) · exp(-s² / 2σ²) · cosθ / |x_F - x_l|², with a = e·ω, s = |e × ω| and e = μ - x_F.
    The integral over the whole plane is 1.

    lens_points: `[2, N]`; focus, mean: `[3, N]`; sigma: `[N]`.
    """
    a, s_squared, distance = _ray_coordinates(lens_points, focus, mean)
    variance = sigma * sigma
    along, across = a / distance, sigma / distance
    peak = (across * across + along * along) / (2.0 * math.pi * variance)
    return peak * torch.exp(-0.5 * s_squared / variance) * (focus[2] / distance)


def log_density_gradient(lens_points: Tensor, focus: Tensor, mean: Tensor, sigma: Tensor) -> Tensor:
    """∂ log p / ∂μ `[3, N]` of `lens_density`: 2a / (σ² + a²) ω - (e - aω) / σ²."""
    omega = torch.cat((lens_points - focus[:2], -focus[2:3]))
    omega = omega * dot(omega, omega).rsqrt()
    a = dot(mean - focus, omega)
    offset = torch.cat((mean[:2] - lens_points, mean[2:3]))  # e plus a multiple of ω
    variance = sigma * sigma
    return (2.0 * a / (variance + a * a) + dot(offset, omega) / variance) * omega - offset / variance


def _ray_coordinates(lens_points: Tensor, focus: Tensor, mean: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """a = e·ω, s² = |e × ω|² and |x_F - x_l| for the lines from x_F through the lens points.

    s is computed from a cross product, because |e|² - a² loses all digits for a small, distant Gaussian. The cross product uses
    the vector from the lens point to μ, because the vector from x_F to μ may be very long.
    """
    e = mean - focus
    ray = torch.cat((lens_points - focus[:2], -focus[2:3]))
    distance = dot(ray, ray).sqrt()
    omega = ray / distance
    perpendicular = cross(torch.cat((mean[:2] - lens_points, mean[2:3])), omega)
    return dot(e, omega), dot(perpendicular, perpendicular), distance
