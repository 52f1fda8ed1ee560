"""Learned state that a render takes over from an earlier render of the same scene with another lens or camera.

Learned state chooses where samples go. The estimates are unbiased for any choice with a positive density, so a choice that no
longer fits costs noise alone. Estimates of radiance, such as control variates and recorded hits, are therefore not taken over.
The random numbers of both renders must differ: a choice that has learned from the same numbers would depend on its own draws.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.film import NO_DEPTH

KEPT_STEPS = 4.0
"""Number of steps that all earlier samples count for, at most, so that new samples soon outweigh those of another view."""
BEYOND = 1e5
"""Depth in metres of pixels without a surface, for a move of the camera."""


@dataclass(frozen=True)
class Learned:
    """What a render has learned, with its view.

    state: state dicts of the strategies by name. camera: of the render. depth: of its pixels through the lens, metres, NO_DEPTH
    without a surface, `[pixels]`. steps: number of steps. mean_luminance: of its frame.
    """

    state: Mapping[str, Mapping[str, Any]]
    camera: ThinLensCamera
    depth: Tensor
    steps: int
    mean_luminance: float

    @property
    def share(self) -> float:
        """Factor of the sums over earlier samples."""
        return min(1.0, KEPT_STEPS / max(self.steps, 1))

    def same_view(self, camera: ThinLensCamera) -> bool:
        """Whether a camera differs at most in its lens."""
        mine = self.camera
        same = torch.equal(mine.position, camera.position) and torch.equal(mine.axes, camera.axes)
        return same and mine.pixel_slope == camera.pixel_slope

    def seen_by(self, camera: ThinLensCamera, points: Tensor) -> Tensor:
        """Points `[3, N]` of the earlier camera frame in the frame of another camera."""
        return camera.axes.T @ (self.camera.axes @ points + self.camera.position - camera.position)

    def surfaces(self) -> Tensor:
        """Points on the surfaces that the pixels saw, earlier camera frame, `[3, pixels]`."""
        mine, number = self.camera, torch.arange(self.camera.width * self.camera.height)
        rows = number // mine.width
        slopes = mine.slopes(torch.stack((number - rows * mine.width, rows)) + 0.5)
        depth = torch.where(self.depth < 0.5 * NO_DEPTH, self.depth, BEYOND)
        return torch.cat((slopes * depth, depth[None]))

    def pixels(self, camera: ThinLensCamera) -> Tensor:
        """Pixel of another camera in which the surface of each earlier pixel lies, int64 `[pixels]`; -1 outside the frame."""
        points = self.seen_by(camera, self.surfaces())
        column, row = camera.raster(points).floor().nan_to_num(-1.0).clamp(-1.0, 1e6).long()
        inside = (points[2] > 0.0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        return torch.where(inside, row * camera.width + column, -1)


def moved(sums: Tensor, places: Tensor) -> Tensor:
    """Sums `[R, N]` at new places int64 `[N]`, -1 for those to drop; several sums at one place are averaged."""
    kept = places >= 0
    at, new = places[kept], torch.zeros_like(sums)
    count = torch.zeros(sums.shape[1], dtype=sums.dtype).index_add_(0, at, torch.ones(len(at), dtype=sums.dtype))
    return new.index_add_(1, at, sums[:, kept]) / count.clamp(min=1.0)
