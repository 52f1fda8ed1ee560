"""The aperture on the lens plane: transmission, and uniform sampling of lens points."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from bokehguide.limits import FARTHEST_FOCUS
from bokehguide.render.aperture import RIM, Iris, Mask
from bokehguide.runtime import native
from bokehguide.scene import types


@dataclass(frozen=True)
class Lens:
    """A thin lens with a round aperture.

    Lens points are `[2, N]`, metres, in the camera frame. Densities are per unit lens area (1/m²).

    radius: of the circle about the centre that contains the aperture, metres; focus_distance: metres along the optical axis.
    """

    radius: float
    focus_distance: float

    @property
    def is_disc(self) -> bool:
        """Whether W is 1 within `radius`, for all focus points."""
        return True

    @property
    def vignettes(self) -> bool:
        """Whether the aperture shrinks towards the edge of the frame."""
        return False

    @property
    def area(self) -> float:
        """A, area of the aperture as seen from the axis, m²."""
        return math.pi * self.radius**2

    def contains(self, points: Tensor) -> Tensor:
        """Whether lens points `[2, N]` lie in the aperture as seen from the axis, bool `[N]`."""
        return self.transmission(points) > 0.0

    def sample(self, uniforms: Tensor) -> Tensor:
        """Points `[2, N]` with the density W / A from uniform numbers `[2, N]`. Rounding moves no point outside the rim."""
        core = native.core_on(uniforms.device)
        if core is not None and uniforms.dtype == torch.float32:
            points = torch.empty(2, uniforms.shape[1])
            core.sample_disc(self.radius * RIM, uniforms.contiguous(), points)
            return points
        radius = self.radius * RIM * uniforms[0].sqrt()
        angle = 2.0 * math.pi * uniforms[1]
        return torch.stack((radius * angle.cos(), radius * angle.sin()))

    def transmission(self, points: Tensor) -> Tensor:
        """W of Eq. 6 on the axis at lens points `[2, N]`, with the mean 1 over the aperture, `[N]`. W / A is the density of
        `sample`."""
        x, y = points
        return (x * x + y * y <= self.radius**2).to(torch.float32)

    def unblocked(self, points: Tensor, focus: Tensor) -> Tensor:
        """Share of W that vignetting leaves for rays from lens points `[2, N]` to focus points `[3, N]`, `[N]`."""
        return torch.ones_like(points[0])

    def passing(self, points: Tensor, focus: Tensor) -> Tensor:
        """W / A, 1/m², at lens points `[2, N]` towards focus points `[3, N]`, `[N]`."""
        return self.transmission(points) * self.unblocked(points, focus) / self.area


@dataclass(frozen=True, eq=False)
class ShapedLens(Lens):
    """A thin lens with an aperture of any shape.

    pupil: shape with the radius 1. scale: radius in metres. turn: rotation of the pupil, radians anticlockwise. ratio: divisor of
    the width of the pupil after the rotation. cat_eye: shift of the lens barrel's disc against the pupil, in radii, for a pixel
    in the corner of the frame; 0 without a barrel. Light passes only through the intersection of disc and pupil. The disc has the
    radius of the pupil's circle, and `ratio` squeezes both. corner: half the frame's diagonal at unit distance.
    """

    pupil: Iris | Mask
    scale: float
    turn: float
    ratio: float
    cat_eye: float
    corner: float

    @property
    def is_disc(self) -> bool:
        return False

    @property
    def vignettes(self) -> bool:
        return self.cat_eye > 0.0

    @property
    def area(self) -> float:
        return self.pupil.area * self.scale**2 / self.ratio

    def sample(self, uniforms: Tensor) -> Tensor:
        """See `Lens`."""
        x, y = _turned(self.scale * self.pupil.sample(uniforms), self.turn)
        return torch.stack((x / self.ratio, y))

    def transmission(self, points: Tensor) -> Tensor:
        """See `Lens`."""
        return self.pupil.transmission(_turned(self._widened(points), -self.turn))

    def unblocked(self, points: Tensor, focus: Tensor) -> Tensor:
        """See `Lens`: 1 within the disc of the lens barrel, else 0. The disc is shifted towards the frame's centre."""
        if not self.vignettes:
            return torch.ones_like(points[0])
        shift = focus[:2] / (focus[2] * self.corner) * (self.cat_eye * self.pupil.reach)
        x, y = (self._widened(points) + shift).unbind(0)
        return (x * x + y * y <= self.pupil.reach**2).to(torch.float32)

    def _widened(self, points: Tensor) -> Tensor:
        """Lens points in units of the pupil's radius, without the division of the width."""
        return torch.stack((points[0] * self.ratio, points[1])) / self.scale


def make_lens(camera: types.Camera, corner: float, device: torch.device | str) -> Lens:
    """Lens of a camera; corner: half the frame's diagonal at unit distance."""
    shape = camera.aperture
    focus_distance = min(camera.focus_distance, FARTHEST_FOCUS)
    if shape is None or camera.aperture_radius == 0.0:
        return Lens(camera.aperture_radius, focus_distance)
    image = shape.image
    pupil = Iris(shape.blades, shape.curvature, shape.edge) if image is None else Mask(image, device)
    radius = camera.aperture_radius * pupil.reach * max(1.0, 1.0 / shape.ratio)
    turn = math.radians(shape.rotation)
    unit = camera.aperture_radius
    return ShapedLens(radius, focus_distance, pupil, unit, turn, shape.ratio, shape.cat_eye, corner)


def _turned(points: Tensor, angle: float) -> Tensor:
    """Points `[2, N]` rotated anticlockwise by an angle in radians."""
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.stack((cos * points[0] - sin * points[1], sin * points[0] + cos * points[1]))
