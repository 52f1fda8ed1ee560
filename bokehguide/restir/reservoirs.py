"""What is kept of a frame's samples for other pixels to use."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass
class Reservoirs:
    """One sample for each of N pixels: a point of u × lens × random numbers, and what it is worth.

    The random numbers are those of the pixel at the step, and not stored. Lengths are in
    metres, in the camera frame.

    subpixel: u `[2, N]`, from the pixel's top left corner. lens_points: `[2, N]`. Of the
    first surface: depth along the axis `[N]`, NO_DEPTH where there is none; plane `[3, N]`:
    (n_x, n_y, n · x₁) of its geometric normal n, (0, 0, 1) where there is none; triangle:
    int32 `[N]`, -1 where there is none. target: p̂ `[N]`, the luminance that arrives,
    times the lens's transmission, 0 outside the aperture; weight: 1 / (A q) `[N]`.
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
        """Samples that are worth nothing."""
        two, three, one = (torch.zeros(*shape, count, device=device) for shape in ((2,), (3,), ()))
        triangle = torch.full((count,), -1, dtype=torch.int32, device=device)
        return cls(two, two.clone(), one, three, triangle, one.clone(), one.clone())

    def select(self, pixels: Tensor) -> Reservoirs:
        """The samples of `pixels`, int64 `[M]`."""
        return Reservoirs(*(getattr(self, name).index_select(-1, pixels) for name in self.__dataclass_fields__))

    def put(self, first: int, samples: Reservoirs) -> None:
        """Replace those of the pixels from `first` on."""
        for name in self.__dataclass_fields__:
            values = getattr(samples, name)
            getattr(self, name)[..., first : first + values.shape[-1]] = values
