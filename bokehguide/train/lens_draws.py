"""The lens points that a mode draws, checked: the mode may be another author's."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from bokehguide.errors import BokehguideError
from bokehguide.guiding.protocols import LensPoints, LensQuery


def draw(mode: str, query: object, focus: Tensor) -> LensPoints:
    """The lens points of a query. mode: its name, for errors. focus: focus points of the pixels, `[3, N]`.

    A point that is not finite gets the weight NaN, so that the film counts and reports the sample as a bad one. Raises
    BokehguideError if `query` is no `LensQuery`, and for points or weights of another type, shape or device.
    """
    if not isinstance(query, LensQuery):
        raise BokehguideError(f"mode: {mode}: query(batch) returned a {type(query).__name__}; return a LensQuery")
    drawn, source = query.sample(), f"mode: {mode}: {type(query).__name__}.sample() returned"
    if not isinstance(drawn, LensPoints):
        raise BokehguideError(f"{source} a {type(drawn).__name__}; return LensPoints(points, weight)")
    count, device = focus.shape[1], focus.device
    for name, tensor, shape in (("points", drawn.points, [2, count]), ("weight", drawn.weight, [count])):
        found = _kind(tensor.dtype, tensor.shape, tensor.device) if isinstance(tensor, Tensor) else f"a {type(tensor).__name__}"
        wanted = _kind(torch.float32, shape, device)
        if found != wanted:
            raise BokehguideError(f"{source} {name}: {found}; return {wanted} for {count} pixels")
    return drawn._replace(weight=torch.where(drawn.points.isfinite().all(0), drawn.weight, torch.nan))


def _kind(dtype: torch.dtype, shape: Sequence[int], device: torch.device) -> str:
    """Type and shape of a tensor, and its device unless this is the CPU, such as `float32 [2, 64]`."""
    return f"{str(dtype).removeprefix('torch.')} {list(shape)}" + (f" on {device}" if device.type != "cpu" else "")
