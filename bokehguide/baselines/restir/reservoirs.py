"""Reservoirs: the samples of a frame, stored for reuse by other pixels."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bokehguide.runtime.indexing import Pixels, gather_pixels, scatter


@dataclass
class Reservoirs:
    """One sample for each of N pixels, with its target value and its weight.

    A sample consists of a sub-pixel position u, a lens point, and the random numbers of the path. The pixel and the step
    determine the random numbers, so that a reservoir does not store them. Lengths are in metres, in the camera frame.

    subpixel: u, from the pixel's top left corner, `[2, N]`. lens_points: `[2, N]`.
    depth: of the primary hit along the axis, NO_DEPTH for a miss, `[N]`. plane: (n_x, n_y, n·x₁) of the geometric normal n at the
    primary hit x₁, (0, 0, 1) for a miss, `[3, N]`. triangle: of the primary hit, -1 for a miss, int32 `[N]`.
    target: p̂, luminance · transmission of the lens, 0 outside the aperture, `[N]`. weight: 1 / (A q), `[N]`.
    """

    subpixel: Tensor
    lens_points: Tensor
    depth: Tensor
    plane: Tensor
    triangle: Tensor
    target: Tensor
    weight: Tensor

    @classmethod
    def empty(cls, count: int, device: torch.device | str = "cpu") -> Reservoirs:
        """Black samples."""
        two, three, one = (torch.zeros(*shape, count, device=device) for shape in ((2,), (3,), ()))
        triangle = torch.full((count,), -1, dtype=torch.int32, device=device)
        return cls(two, two.clone(), one, three, triangle, one.clone(), one.clone())

    def select(self, pixels: Pixels) -> Reservoirs:
        """The samples of M pixels, views if `pixels` is a slice."""
        return Reservoirs(*(gather_pixels(getattr(self, name), pixels) for name in self.__dataclass_fields__))

    def store(self, span: slice, samples: Reservoirs) -> None:
        """Replace the samples of a span of pixels."""
        for name in self.__dataclass_fields__:
            scatter(getattr(self, name), span, getattr(samples, name))
