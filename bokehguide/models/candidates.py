"""Which Gaussians can be seen through the lens by which pixel: a packed list.

The list is made by drawing one disc per Gaussian, so the work grows with the pixels
covered and never with pixels × Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from bokehguide.models.gaussian_field import GaussianField
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.pixels import Pixels, indices, take

MAX_CANDIDATES = 16
"""A pixel keeps this many of its strongest Gaussians."""
BAND, DRAWN_TOGETHER = 1 << 18, 1 << 21
"""Pixels, and pixels of discs over one another, that are held in memory at a time."""
PIXEL_MARGIN = 0.7072
"""Half a pixel's diagonal: discs are tested at pixel centres."""


@dataclass
class CandidateList:
    """Candidates of pixel i: `gaussian[start[i] : start[i + 1]]`, the strongest first.

    start: int64 `[pixels + 1]`; gaussian: int32 `[M]`.
    """

    start: Tensor
    gaussian: Tensor

    def batch(self, pixels: Pixels) -> tuple[Tensor, Tensor]:
        """Starts `[N + 1]` from 0 and Gaussians int64 of N pixels."""
        if isinstance(pixels, slice):
            low, high = self._on_host[[pixels.start, pixels.stop]].tolist()
            return self.start[pixels.start : pixels.stop + 1] - low, self.gaussian[low:high].long()
        first = take(self.start[:-1], pixels)
        counts = take(self.start[1:], pixels) - first
        start = torch.cat((torch.zeros_like(counts[:1]), counts.cumsum(0)))
        owner = torch.repeat_interleave(counts)
        place = torch.arange(len(owner), device=owner.device) + (first - start[:-1]).index_select(0, owner)
        return start, self.gaussian.index_select(0, place).long()

    @cached_property
    def _on_host(self) -> np.ndarray:
        """`start`, for which no batch is to wait."""
        return self.start.cpu().numpy()

    def counts(self) -> Tensor:
        """Number of candidates of each pixel, int64 `[pixels]`."""
        return self.start[1:] - self.start[:-1]


def draw_candidates(
    field: GaussianField, camera: ThinLensCamera, slack: float = 0.0, without: Tensor | None = None
) -> CandidateList:
    """List the Gaussians that each pixel may see, by drawing their discs on the raster.

    slack: by how many σ discs may be larger, or means may still move (polynomial offsets). without: pixels to
    leave out, bool `[pixels]`.
    """
    center, radius = field.footprints(camera)
    lens = camera.lens
    extra = slack * field.sigma / (field.mean[2] * camera.pixel_slope)
    strength = field.lens_weights(lens.focus_distance)
    order = strength.argsort(descending=True)
    center, radius = center[:, order], (radius + extra + PIXEL_MARGIN)[order]
    rows, parts = max(BAND // camera.width, 1), []
    for top in range(0, camera.height, rows):
        full = torch.zeros(min(rows, camera.height - top), camera.width, dtype=torch.int32, device=center.device)
        if without is not None:
            full.view(-1)[without[top * camera.width :][: full.numel()]] = MAX_CANDIDATES
        near = (center[1] + radius > top) & (center[1] - radius < top + len(full))
        near = indices(near)
        counts, drawn = _draw(center[:, near], radius[near], top, full)
        parts.append((counts, order[near].int().index_select(0, drawn)))
    counts, gaussian = (torch.cat(part) for part in zip(*parts))
    return CandidateList(torch.cat((torch.zeros_like(counts[:1]), counts.cumsum(0))), gaussian)


def _draw(center: Tensor, radius: Tensor, top: int, full: Tensor) -> tuple[Tensor, Tensor]:
    """How many discs each pixel of a band of rows from `top` on keeps, int64 `[pixels]`, and which, int64 `[M]`, pixel by pixel,
    in the discs' order.

    full: int32 `[rows, width]`, how many each pixel has already; it is counted on. Discs are drawn DRAWN_TOGETHER pixels at
    a time, and hardly where pixels are full already: memory is bounded however many lie over one another.
    """
    part = (2.0 * radius.double() + 2.0).clamp(max=full.shape[1]) * (2.0 * radius + 2.0).clamp(max=len(full))
    part = (part.cumsum(0) / DRAWN_TOGETHER).long()
    pixels, discs = [torch.zeros(0, dtype=torch.int32, device=radius.device)], [radius[:0].long()]
    for first, last in _runs(part):
        pixel, disc = _fill_discs(center[:, first:last], radius[first:last], top, full)
        space = indices(full.view(-1).index_select(0, pixel) < MAX_CANDIDATES)
        pixels.append(pixel.index_select(0, space).int())
        discs.append(disc.index_select(0, space) + first)
        full.view(-1).add_(torch.bincount(pixels[-1], minlength=full.numel()))
    pixel, by_pixel = torch.sort(torch.cat(pixels), stable=True)  # keeps the strongest first
    counts = torch.bincount(pixel, minlength=full.numel())
    rank = torch.arange(len(pixel), device=pixel.device) - (counts.cumsum(0) - counts).index_select(0, pixel)
    kept = indices(rank < MAX_CANDIDATES)
    return counts.clamp(max=MAX_CANDIDATES), torch.cat(discs).index_select(0, by_pixel.index_select(0, kept))


def _runs(values: Tensor) -> list[tuple[int, int]]:
    """First and past-the-last index of each run of equal values."""
    counts = torch.unique_consecutive(values, return_counts=True)[1].tolist()
    ends = torch.tensor(counts).cumsum(0).tolist()
    return [(end - count, end) for end, count in zip(ends, counts)]


def _fill_discs(center: Tensor, radius: Tensor, top: int, full: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels of a band of rows whose centres lie in each disc: pixel and disc numbers, int64 `[M]` both, disc by disc, without the
    disc's rows that lie in full pixels alone (see `_draw`)."""
    height, width = full.shape
    first = (center[1] - radius - 0.5).ceil().clamp(top, top + height).long()
    end = ((center[1] + radius - 0.5).floor() + 1.0).clamp(top, top + height).long()
    disc, row = _expand(first, end)
    x, y, radius = (values.index_select(0, disc) for values in (*center, radius))
    half = (radius.square() - (row + 0.5 - y).square()).clamp(min=0.0).sqrt()
    left = (x - half - 0.5).ceil().clamp(0, width).long()
    right = ((x + half - 0.5).floor() + 1.0).clamp(0, width).long()
    open_before = pad((full < MAX_CANDIDATES).int().cumsum(1, dtype=torch.int32), (1, 0)).view(-1)
    line = (row - top) * (width + 1)
    right = torch.where(open_before[line + right.clamp(min=0)] > open_before[line + left], right, left)
    span, column = _expand(left, right)
    return ((row - top) * width).index_select(0, span) + column, disc.index_select(0, span)


def _expand(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """All (i, v) with low[i] ≤ v < high[i], in order: int64 `[M]` each."""
    counts = (high - low).clamp(min=0)
    owner = torch.repeat_interleave(counts)
    first = counts.cumsum(0) - counts
    return owner, torch.arange(len(owner), device=low.device) + (low - first).index_select(0, owner)
