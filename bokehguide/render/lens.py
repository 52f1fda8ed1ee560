"""The aperture on the lens plane: where light passes, and how lens points are drawn over it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from bokehguide.limits import FARTHEST_FOCUS
from bokehguide.render.aperture import Iris, Mask
from bokehguide.render.kernels import kernel
from bokehguide.render.transfers import sent
from bokehguide.scene import types


@dataclass(frozen=True)
class Lens:
    """A thin lens with a round aperture.

    Lens points are `[2, N]`, metres, in the camera frame (x right, y up) with the lens
    centre at the origin. Densities are per unit lens area (1/m²).

    radius: of the circle about the centre that holds the aperture, metres.
    focus_distance: metres along the optical axis.
    """

    radius: float
    focus_distance: float

    @property
    def vignettes(self) -> bool:
        """Whether the aperture is smaller towards the frame's edge than on the axis."""
        return False

    @property
    def area(self) -> float:
        """A, the aperture's area in m² as it is seen from the axis."""
        return math.pi * self.radius**2

    def contains(self, points: Tensor) -> Tensor:
        """Whether lens points `[2, N]` lie in the aperture as it is seen from the axis, bool `[N]`."""
        return self.transmission(points) > 0.0

    def sample(self, uniforms: Tensor) -> Tensor:
        """Points `[2, N]` with density 1/A from uniform numbers `[2, N]`; rounding never leaves the rim."""
        radius = self.radius * (1.0 - 1e-6) * uniforms[0].sqrt()
        angle = 2.0 * math.pi * uniforms[1]
        return torch.stack((radius * angle.cos(), radius * angle.sin()))

    def transmission(self, points: Tensor) -> Tensor:
        """W of Eq. 6 on the axis, of mean 1 over the aperture, `[N]`: W / A is the density of `sample`."""
        return _within(points, sent(self.radius**2, points.device, points.dtype))

    def unblocked(self, points: Tensor, focus: Tensor) -> Tensor:
        """The share of W that is left off the axis, at lens points `[2, N]` towards focus points `[3, N]`, `[N]`."""
        return torch.ones_like(points[0])


@dataclass(frozen=True, eq=False)
class ShapedLens(Lens):
    """A thin lens with an aperture of any shape.

    pupil: the shape, for a radius of 1. scale: metres of that radius. turn: radians, by which the
    pupil is turned, anticlockwise. ratio: by which it is then divided in width.
    cat_eye: how far a disc as large as the pupil's circle, squeezed with it, has moved against it
    where a pixel lies in the frame's corner, in its radii; no light passes beyond that disc. corner:
    half the frame's diagonal at unit distance.
    """

    pupil: Iris | Mask
    scale: float
    turn: float
    ratio: float
    cat_eye: float
    corner: float

    @property
    def vignettes(self) -> bool:
        return self.cat_eye > 0.0

    @property
    def area(self) -> float:
        return self.pupil.area * self.scale**2 / self.ratio

    def sample(self, uniforms: Tensor) -> Tensor:
        """Points `[2, N]` with density W / A from uniform numbers `[2, N]`."""
        x, y = _turned(self.scale * self.pupil.sample(uniforms), self.turn)
        return torch.stack((x / self.ratio, y))

    def transmission(self, points: Tensor) -> Tensor:
        return self.pupil.transmission(_turned(self._widened(points), -self.turn))

    def unblocked(self, points: Tensor, focus: Tensor) -> Tensor:
        """1 within the second disc, which lies towards the frame's centre, as a lens barrel's front rim does; else 0."""
        if not self.vignettes:
            return torch.ones_like(points[0])
        shift = focus[:2] / (focus[2] * self.corner) * (self.cat_eye * self.pupil.reach)
        x, y = (self._widened(points) + shift).unbind(0)
        return (x * x + y * y <= self.pupil.reach**2).to(torch.float32)

    def _widened(self, points: Tensor) -> Tensor:
        """Lens points in the pupil's units, and not squeezed."""
        return torch.stack((points[0] * self.ratio, points[1])) / self.scale


def make_lens(camera: types.Camera, corner: float, device: torch.device | str) -> Lens:
    """The lens of `camera`; corner: half the frame's diagonal at unit distance."""
    shape = camera.aperture
    focus_distance = min(camera.focus_distance, FARTHEST_FOCUS)
    if shape is None or camera.aperture_radius == 0.0:
        return Lens(camera.aperture_radius, focus_distance)
    if shape.image is None:
        pupil = Iris(shape.blades, shape.curvature, shape.edge)
    else:
        pupil = Mask(shape.image, device)
    radius = camera.aperture_radius * pupil.reach * max(1.0, 1.0 / shape.ratio)
    turn = math.radians(shape.rotation)
    unit = camera.aperture_radius
    return ShapedLens(radius, focus_distance, pupil, unit, turn, shape.ratio, shape.cat_eye, corner)


@kernel
def _within(points: Tensor, squared: Tensor) -> Tensor:
    """1 for points `[2, N]` within the circle of this squared radius, 0 for others, float32 `[N]`."""
    x, y = points
    return (x * x + y * y <= squared).to(torch.float32)


def _turned(points: Tensor, angle: float) -> Tensor:
    """Points `[2, N]`, turned anticlockwise by an angle in radians."""
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.stack((cos * points[0] - sin * points[1], sin * points[0] + cos * points[1]))
