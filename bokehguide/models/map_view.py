"""What of an environment map the lens sees through a focus point: from which row to which, and on each from where to where.

Through x_F the lens's circle is a cone. A circle of the map about it is found by spherical trigonometry, and holds a little
more. Its ends are moved to the cone itself, but near the map's poles and where the cone is wide or aslant.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.equirectangular import Equirectangular
from bokehguide.render.kernels import kernel
from bokehguide.render.transfers import sent
from bokehguide.render.vector import dot, normalize, polar_angle, to_world

BEYOND, ROUNDING = 1.001, 1e-6
"""The lens is taken to be so many times as wide, and so many focus distances wider: what rounding moves across the end of what is
drawn, it does not see."""
WIDEST, NEAREST, FLATTEST = 0.3, 3.0, 0.6
"""Of circles of a larger angular radius, of those that are not so many radii away from a pole, and where the cosine to the optical axis is
less, the ends are left where they are."""
STEPS = 3
"""Of Newton's method, and of the search for where the cone reaches highest: each has errors of the fourth power of an angle left."""


class View(NamedTuple):
    """What is seen through N points x_F, float64.

    focus: `[3, N]`, camera frame; column: of the circle's middle, in texels; theta: its angle from the top, radians; reach: the
    circle's angular radius, `[N]` each; axes: `[3, 3]`, the camera's, of world coordinates; radius: the lens's, `[]`.
    """

    focus: Tensor
    column: Tensor
    theta: Tensor
    reach: Tensor
    axes: Tensor
    radius: Tensor

    def select(self, index: Tensor) -> View:
        """Those at `index`, int64 `[K]`."""
        return View(*(part.index_select(-1, index) for part in self[:4]), self.axes, self.radius)


def lens_view(layout: Equirectangular, camera: ThinLensCamera, focus: Tensor) -> View:
    """What the lens sees of a map through x_F `[3, N]`."""
    focus, axes = focus.double(), camera.axes.double()
    radius = sent(BEYOND * camera.lens.radius, focus.device, torch.float64)
    return View(focus, *_circle(layout, focus, axes, radius), axes, radius)


@kernel
def _circle(layout: Equirectangular, focus: Tensor, axes: Tensor, radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    squared = dot(focus, focus)
    distance = squared.sqrt()
    column, row = layout.place(_turned(axes, focus / distance))
    # The way to x_F turns most along tangents of the ball about the lens; from before the lens, it does towards the rim.
    aside = (focus[0] * focus[0] + focus[1] * focus[1]).sqrt()
    tangent = torch.asin((radius / distance).clamp(max=1.0))
    rim = polar_angle(radius * focus[2], squared - radius * aside)
    return column, math.pi / layout.height * row, torch.where(aside < radius, rim, tangent) + ROUNDING


def _turned(axes: Tensor, local: Tensor) -> Tensor:
    """World coordinates `[3, N]` of local ones."""
    return to_world(local, *(axis[:, None] for axis in axes.T))


def _is_wide(view: View) -> Tensor:
    steep = dot(view.focus, view.focus) * FLATTEST**2 > view.focus[2] * view.focus[2]
    return steep | (view.reach > WIDEST) | (view.theta.sin() < NEAREST * view.reach.sin())


@kernel
def heights(layout: Equirectangular, view: View, middle: Tensor, half: Tensor) -> Tensor:
    """From where to where views show columns up to `half` texels beside `middle`, `[N]` both: texels below the map's top,
    `[2, N]`, equal for nowhere."""
    ends = []
    # What leaves out fewer columns than the circle has, is seen on both sides of them.
    widest = torch.asin((view.reach.sin() / view.theta.sin().clamp(min=1e-300)).clamp(max=1.0)) * (layout.width / math.pi)
    half = torch.where(layout.width - 2.0 * half < widest, 0.5 * layout.width, half)
    for end, sign in ((view.theta - view.reach, -1.0), (view.theta + view.reach, 1.0)):
        seen, up = view.focus, view.axes[1][:, None]
        for _ in range(STEPS):  # the rim is highest where it runs level
            seen = normalize(seen)
            north = up - dot(up, seen) * seen
            flat = (north[0] * north[0] + north[1] * north[1]).sqrt().clamp(min=1e-300)
            reach = sign * (view.radius + ROUNDING * view.focus[2]) / flat
            seen = torch.stack((view.focus[0] - reach * north[0], view.focus[1] - reach * north[1], view.focus[2]))
        column, row = layout.place(_turned(view.axes, normalize(seen)))
        aside = (column - middle) / layout.width
        aside = (aside - (aside + 0.5).floor()) * layout.width
        beside = torch.minimum(torch.maximum(aside, -half), half)
        first, last = _meridian(layout, view, middle + beside)
        row = torch.where(beside == aside, row, torch.minimum(first, last) if sign < 0.0 else torch.maximum(first, last))
        circle = layout.height / math.pi * end.clamp(0.0, math.pi)
        ends.append(torch.where(_is_wide(view), circle, row))
    return torch.stack((ends[0], torch.maximum(*ends)))


def _meridian(layout: Equirectangular, view: View, column: Tensor) -> tuple[Tensor, Tensor]:
    """The rows, in texels below the map's top, between which columns `[N]` of the map cross the cone, `[N]` both. A meridian is a line on the lens."""
    side = layout.directions(column + 0.25 * layout.width, torch.full_like(column, 0.5 * layout.height))
    x, y, z = (dot(side, axis[:, None]) for axis in view.axes.T)
    squared = (x * x + y * y).clamp(min=1e-300)
    away = (x * view.focus[0] + y * view.focus[1] + z * view.focus[2]) / squared
    radius = view.radius + ROUNDING * view.focus[2]
    half = ((radius * radius / squared - away * away).clamp(min=0.0)).sqrt()
    rows = []
    for end in (-half, half):
        seen = torch.stack((view.focus[0] - away * x - end * y, view.focus[1] - away * y + end * x, view.focus[2]))
        rows.append(layout.place(normalize(_turned(view.axes, seen)))[1])
    return rows[0], rows[1]


@kernel
def chord(layout: Equirectangular, view: View, y: Tensor) -> tuple[Tensor, Tensor]:
    """From where to where views show lines `y` `[N]` texels below the map's top: columns, in texels, beside `view.column`, the second
    not below the first, `[N]` both."""
    theta = math.pi / layout.height * y
    beyond, apart = (0.5 * view.reach).sin(), (0.5 * (theta - view.theta)).sin()
    squared = (beyond * beyond - apart * apart) / (theta.sin() * view.theta.sin()).clamp(min=1e-300)
    half = 2.0 * torch.asin(squared.clamp(0.0, 1.0).sqrt())  # the haversine formula
    start = layout.directions(view.column, y)
    radius, ends = view.radius + ROUNDING * view.focus[2], []
    # Turned about the pole, directions are parts of `level`, `ahead` and `beside` by the angle's cosine and sine.
    level = start[1] * view.axes[1][:, None]
    ahead = view.axes[0][:, None] * start[0] + view.axes[2][:, None] * start[2]
    beside = view.axes[2][:, None] * start[0] - view.axes[0][:, None] * start[2]
    for sign in (-1.0, 1.0):
        angle = sign * half
        for _ in range(STEPS):
            now, change = level + angle.cos() * ahead + angle.sin() * beside, angle.cos() * beside - angle.sin() * ahead
            x, y_ = (view.focus[axis] * now[2] - now[axis] * view.focus[2] for axis in (0, 1))
            dx, dy = (view.focus[axis] * change[2] - change[axis] * view.focus[2] for axis in (0, 1))
            outside = x * x + y_ * y_ - radius * radius * now[2] * now[2]
            slope = sign * (x * dx + y_ * dy - radius * radius * now[2] * change[2])
            step = (0.5 * outside / slope.clamp(min=1e-300)).clamp(min=0.0)
            angle = sign * torch.maximum(sign * angle - step, -half)
        ends.append(torch.where(_is_wide(view), sign * half, angle))
    texels = 0.5 * layout.width / math.pi
    return texels * ends[0], texels * torch.maximum(*ends)
