"""The part of an environment map that the lens sees through a focus point: a range of rows, and an interval on each row.

The directions from the lens circle through x_F form a cone. Spherical trigonometry gives a circle on the sphere of directions
that encloses the cone. Newton's method then moves the ends of the circle's rows to the cone. Near the poles, and for wide or
oblique cones, the code uses the circle instead of the cone.
docs/explanation/lens-densities.md derives the formulas.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.models.projection import LENS_MARGIN
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.lights.equirectangular import Equirectangular
from bokehguide.render.vector import dot, normalize, polar_angle, to_world
from bokehguide.runtime.device import to_device

ANGLE_ERROR = 1e-6
"""Bound on the rounding error of a direction, radians. The cone is widened by this angle."""
MAX_CONE_ANGLE, MIN_POLE_DISTANCE, MIN_COSINE = 0.3, 3.0, 0.6
"""Limits of Newton's method: largest angular radius, least distance to a pole in angular radii, and least cosine to the optical
axis. Beyond a limit, the enclosing circle replaces the cone."""
STEPS = 3
"""Number of iterations of Newton's method and of the search for the extreme rows."""
TINY = 1e-300
"""Least divisor, for sines and lengths that may be 0."""


class LensCone(NamedTuple):
    """Cones of directions from the lens circle through N focus points, float64.

    focus: x_F, `[3, N]`, camera frame. column: column of the enclosing circle's centre, texels, `[N]`. theta: polar angle of this
    centre from the map's top, radians, `[N]`. reach: angular radius of the circle, radians, `[N]`. axes: axes of the camera in
    world coordinates, `[3, 3]`. radius: lens radius times LENS_MARGIN, `[]`.
    """

    focus: Tensor
    column: Tensor
    theta: Tensor
    reach: Tensor
    axes: Tensor
    radius: Tensor

    def select(self, index: Tensor) -> LensCone:
        """The cones at `index`, int64 `[K]`."""
        focus, column, theta, reach = (part.index_select(-1, index) for part in self[:4])
        return LensCone(focus, column, theta, reach, self.axes, self.radius)

    def rim_radius(self) -> Tensor:
        """Radius of the lens circle, widened by ANGLE_ERROR at x_F, `[N]`."""
        return self.radius + ANGLE_ERROR * self.focus[2]


def lens_cone(layout: Equirectangular, camera: ThinLensCamera, focus: Tensor) -> LensCone:
    """Cones of directions on a map through x_F `[3, N]`."""
    focus, axes = focus.double(), camera.axes.double()
    radius = to_device(LENS_MARGIN * camera.lens.radius, focus.device, torch.float64)
    column, theta, reach = _enclosing_circle(layout, focus, axes, radius)
    return LensCone(focus, column, theta, reach, axes, radius)


def _enclosing_circle(layout: Equirectangular, focus: Tensor, axes: Tensor, radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Column, polar angle and angular radius, `[N]` each, of the circle about the direction from the lens centre to x_F.

    The circle contains the directions from all lens points to x_F. The largest angle to the centre belongs to a tangent of the
    ball around the lens. If x_F lies in front of the lens disc, no such tangent meets the disc. The largest angle then belongs to
    the rim.
    """
    squared = dot(focus, focus)
    distance = squared.sqrt()
    column, row = layout.place(_world(axes, focus / distance))
    off_axis = (focus[0] * focus[0] + focus[1] * focus[1]).sqrt()
    tangent = torch.asin((radius / distance).clamp(max=1.0))
    rim = polar_angle(radius * focus[2], squared - radius * off_axis)
    return column, math.pi / layout.height * row, torch.where(off_axis < radius, rim, tangent) + ANGLE_ERROR


def _world(axes: Tensor, local: Tensor) -> Tensor:
    """World coordinates `[3, N]` of vectors in the camera frame."""
    right, up, ahead = (axis[:, None] for axis in axes.T)
    return to_world(local, right, up, ahead)


def _uses_circle(cone: LensCone) -> Tensor:
    """Whether the enclosing circle replaces the cone, bool `[N]`."""
    oblique = dot(cone.focus, cone.focus) * MIN_COSINE**2 > cone.focus[2] * cone.focus[2]
    return oblique | (cone.reach > MAX_CONE_ANGLE) | (cone.theta.sin() < MIN_POLE_DISTANCE * cone.reach.sin())


def row_range(layout: Equirectangular, cone: LensCone, middle: Tensor, half: Tensor) -> Tensor:
    """First and last row at which cones contain columns up to `half` texels from `middle`, `[N]` both.

    Rows are in texels below the map's top, `[2, N]`; both are equal where cones contain no such column.
    """
    # If the gap between the columns is narrower than the circle, the cone sees both sides of the gap: use all columns.
    circle = torch.asin((cone.reach.sin() / cone.theta.sin().clamp(min=TINY)).clamp(max=1.0)) * (layout.width / math.pi)
    half = torch.where(layout.width - 2.0 * half < circle, 0.5 * layout.width, half)
    top = _extreme_row(layout, cone, middle, half, -1.0)
    bottom = _extreme_row(layout, cone, middle, half, 1.0)
    return torch.stack((top, torch.maximum(top, bottom)))


def _extreme_row(layout: Equirectangular, cone: LensCone, middle: Tensor, half: Tensor, sign: float) -> Tensor:
    """The first (sign -1) or last (sign 1) row of cones within `half` columns of `middle`, `[N]`.

    If the extreme point of the cone lies outside these columns, the extreme row is on the meridian of the nearest column.
    """
    column, row = layout.place(_world(cone.axes, normalize(_extreme_direction(cone, sign))))
    offset = (column - middle) / layout.width
    offset = (offset - (offset + 0.5).floor()) * layout.width
    nearest = torch.minimum(torch.maximum(offset, -half), half)
    first, last = _meridian_rows(layout, cone, middle + nearest)
    row = torch.where(nearest == offset, row, torch.minimum(first, last) if sign < 0.0 else torch.maximum(first, last))
    circle = layout.height / math.pi * (cone.theta + sign * cone.reach).clamp(0.0, math.pi)
    return torch.where(_uses_circle(cone), circle, row)


def _extreme_direction(cone: LensCone, sign: float) -> Tensor:
    """Vectors `[3, N]`, camera frame, from the rim of the lens through x_F to the cone's highest (-1) or lowest (1) row.

    At the extreme row, the rim's normal in the lens plane is parallel to the projection of the local north direction.
    """
    direction, up, radius = cone.focus, cone.axes[1][:, None], cone.rim_radius()
    for _ in range(STEPS):
        direction = normalize(direction)
        north = up - dot(up, direction) * direction
        in_plane = (north[0] * north[0] + north[1] * north[1]).sqrt().clamp(min=TINY)
        reach = sign * radius / in_plane
        direction = torch.stack((cone.focus[0] - reach * north[0], cone.focus[1] - reach * north[1], cone.focus[2]))
    return direction


def _meridian_rows(layout: Equirectangular, cone: LensCone, column: Tensor) -> tuple[Tensor, Tensor]:
    """The two rows, texels below the map's top, at which the meridians of columns `[N]` cross the cones, `[N]` both.

    Let s be the normal of the meridian's plane. The lens points l that see the meridian satisfy s·(x_F - l) = 0, a line on the
    lens plane. The ends of the line's chord in the lens circle give the two rows.
    """
    normal = layout.directions(column + 0.25 * layout.width, torch.full_like(column, 0.5 * layout.height))
    x, y, z = (dot(normal, axis[:, None]) for axis in cone.axes.T)
    squared = (x * x + y * y).clamp(min=TINY)
    nearest = (x * cone.focus[0] + y * cone.focus[1] + z * cone.focus[2]) / squared
    radius = cone.rim_radius()
    half_chord = ((radius * radius / squared - nearest * nearest).clamp(min=0.0)).sqrt()
    rows = []
    for end in (-half_chord, half_chord):
        seen = torch.stack((cone.focus[0] - nearest * x - end * y, cone.focus[1] - nearest * y + end * x, cone.focus[2]))
        rows.append(layout.place(normalize(_world(cone.axes, seen)))[1])
    return rows[0], rows[1]


def row_interval(layout: Equirectangular, cone: LensCone, y: Tensor) -> tuple[Tensor, Tensor]:
    """First and last column that cones contain `y` texels below the map's top, `[N]` both.

    Columns are in texels from `cone.column`; the last is not below the first.
    """
    half = _circle_half_angle(cone, math.pi / layout.height * y)
    start = layout.directions(cone.column, y)
    # A rotation by φ about the pole changes the direction to polar + cos φ forward + sin φ sideways, camera frame.
    polar = start[1] * cone.axes[1][:, None]
    forward = cone.axes[0][:, None] * start[0] + cone.axes[2][:, None] * start[2]
    sideways = cone.axes[2][:, None] * start[0] - cone.axes[0][:, None] * start[2]
    circle = _uses_circle(cone)
    first = torch.where(circle, -half, _rim_angle(cone, half, polar, forward, sideways, -1.0))
    last = torch.where(circle, half, _rim_angle(cone, half, polar, forward, sideways, 1.0))
    texels = 0.5 * layout.width / math.pi
    return texels * first, texels * torch.maximum(first, last)


def _circle_half_angle(cone: LensCone, theta: Tensor) -> Tensor:
    """Half the range of azimuths that the circles cover at polar angles `theta`, radians, `[N]`, by the haversine formula."""
    radius, apart = (0.5 * cone.reach).sin(), (0.5 * (theta - cone.theta)).sin()
    squared = (radius * radius - apart * apart) / (theta.sin() * cone.theta.sin()).clamp(min=TINY)
    return 2.0 * torch.asin(squared.clamp(0.0, 1.0).sqrt())


def _rim_angle(cone: LensCone, half: Tensor, polar: Tensor, forward: Tensor, sideways: Tensor, sign: float) -> Tensor:
    """The azimuth, in -half … half, at which the row leaves the cone in the direction `sign`, radians, `[N]`.

    A direction d meets the rim where |x_F,xy d_z - d_xy x_F,z|² = r² d_z². Newton's method starts at the circle and moves
    inwards.
    """
    radius, angle = cone.rim_radius(), sign * half
    for _ in range(STEPS):
        now = polar + angle.cos() * forward + angle.sin() * sideways
        change = angle.cos() * sideways - angle.sin() * forward
        x, y = (cone.focus[axis] * now[2] - now[axis] * cone.focus[2] for axis in (0, 1))
        dx, dy = (cone.focus[axis] * change[2] - change[axis] * cone.focus[2] for axis in (0, 1))
        outside = x * x + y * y - radius * radius * now[2] * now[2]
        slope = sign * (x * dx + y * dy - radius * radius * now[2] * change[2])  # half the derivative
        step = (0.5 * outside / slope.clamp(min=TINY)).clamp(min=0.0)
        angle = sign * torch.maximum(sign * angle - step, -half)
    return angle
