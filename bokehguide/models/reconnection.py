"""Reconnection of a camera ray to the primary hit of another pixel's ray (Zhang et al. 2024, Area ReSTIR).

A ray from lens point l through focus point x_F has the primary hit x₁. The reconnection is the lens point l' on the line from x₁
through another focus point x_F'. Lengths are in metres, in the camera frame.
"""

from __future__ import annotations

from torch import Tensor

from bokehguide.models.projection import FAR_OUTSIDE


def reconnect(lens_points: Tensor, focus_shift: Tensor, depth: Tensor, focus_distance: float | Tensor) -> Tensor:
    """Lens points l' `[2, N]` whose rays through x_F' meet the primary hits of rays from l `[2, N]` through x_F.

    l' = l + (x_F' - x_F) z / (z - d_F), because l = x₁ + (x_F - x₁) z / (z - d_F) and l' is the same function of x_F'.

    focus_shift: x_F' - x_F, `[2, N]`. depth: z of the primary hit, `[N]`; very large for a hit at infinity. All rays through a
    focus point meet at z = d_F, so that l' does not exist for a hit in focus. The result is then FAR_OUTSIDE.
    """
    points = lens_points + focus_shift * (depth / (depth - focus_distance))
    return points.nan_to_num(FAR_OUTSIDE, FAR_OUTSIDE, -FAR_OUTSIDE)


def reconnection_jacobian(plane: Tensor, lens_points: Tensor, new_lens_points: Tensor) -> Tensor:
    """|∂l' / ∂l| `[N]` of `reconnect`: distance of l' from the plane of the primary hit, over distance of l from this plane.

    A small area on the surface subtends a cone at each lens point. This gives |∂l' / ∂l| = |ω'·n₁| |ω·n₀| / (|ω'·n₀| |ω·n₁|),
    where ω and ω' are the directions of the two rays, n₁ is the surface normal and n₀ is the lens normal. The depth z = |x₁ - l|
    ω·n₀ is equal for both rays and cancels.

    plane: (n_x, n_y, n·x₁) of the geometric normal n, `[3, N]`; (0, 0, 1) for a hit at infinity. lens_points, new_lens_points:
    `[2, N]`.
    """
    return _distance(plane, new_lens_points) / _distance(plane, lens_points).clamp(min=1e-20)  # 0 for a ray in the plane


def _distance(plane: Tensor, lens_points: Tensor) -> Tensor:
    """Distance `[N]` of lens points `[2, N]` from planes `[3, N]`."""
    return (plane[2] - plane[0] * lens_points[0] - plane[1] * lens_points[1]).abs()
