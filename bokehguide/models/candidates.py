"""Candidates of each pixel: the Gaussians that the pixel may see through the lens, in one packed list.

The code rasterises a disc for each Gaussian, so that the cost grows with the number of covered pixels.
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
from bokehguide.runtime.indexing import Pixels, gather_pixels, indices

MAX_CANDIDATES = 16
"""Largest number of candidates of a pixel. A pixel keeps the Gaussians with the largest weights."""
STRIP_PIXELS, CHUNK_PIXELS = 1 << 18, 1 << 21
"""Bounds on memory: pixels in a strip of rows, and covered pixels of all discs in one chunk."""
PIXEL_MARGIN = 0.7072
"""Half the diagonal of a pixel. Discs are enlarged by this length, because the test uses pixel centres."""


@dataclass
class CandidateList:
    """Candidates of pixel i are `gaussian[start[i] : start[i + 1]]`, the strongest first.

    start: int64 `[pixels + 1]`; gaussian: int32 `[M]`.
    """

    start: Tensor
    gaussian: Tensor

    def batch(self, pixels: Pixels) -> tuple[Tensor, Tensor]:
        """Starts int64 `[N + 1]`, from 0, and Gaussians int64 `[M]` of N pixels."""
        if isinstance(pixels, slice):
            low, high = self._on_host[[pixels.start, pixels.stop]].tolist()
            return self.start[pixels.start : pixels.stop + 1] - low, self.gaussian[low:high].long()
        first = gather_pixels(self.start[:-1], pixels)
        counts = gather_pixels(self.start[1:], pixels) - first
        start = torch.cat((torch.zeros_like(counts[:1]), counts.cumsum(0)))
        owner = torch.repeat_interleave(counts)
        place = torch.arange(len(owner), device=owner.device) + (first - start[:-1]).index_select(0, owner)
        return start, self.gaussian.index_select(0, place).long()

    @cached_property
    def _on_host(self) -> np.ndarray:
        """`start` on the host, so that no batch waits for the device."""
        return self.start.cpu().numpy()

    def counts(self) -> Tensor:
        """Number of candidates of each pixel, int64 `[pixels]`."""
        return self.start[1:] - self.start[:-1]


def draw_candidates(
    field: GaussianField, camera: ThinLensCamera, slack: float = 0.0, excluded: Tensor | None = None
) -> CandidateList:
    """List the candidates of each pixel: the Gaussians whose disc of Eq. 22 on the raster covers the pixel.

    slack: enlargement of the discs in units of σ, because polynomial offsets move the means. excluded: pixels that get no
    candidates, bool `[pixels]`.
    """
    center, radius = field.footprints(camera)
    lens = camera.lens
    extra = slack * field.sigma / (field.mean[2] * camera.pixel_slope)
    strength = field.lens_weights(lens.focus_distance)
    order = strength.argsort(descending=True)
    center, radius = center[:, order], (radius + extra + PIXEL_MARGIN)[order]
    rows, parts = max(STRIP_PIXELS // camera.width, 1), []
    for top in range(0, camera.height, rows):
        counts = torch.zeros(min(rows, camera.height - top), camera.width, dtype=torch.int32, device=center.device)
        if excluded is not None:
            counts.view(-1)[excluded[top * camera.width :][: counts.numel()]] = MAX_CANDIDATES
        near = (center[1] + radius > top) & (center[1] - radius < top + len(counts))
        near = indices(near)
        kept, discs = _rasterise(center[:, near], radius[near], top, counts)
        parts.append((kept, order[near].int().index_select(0, discs)))
    counts, gaussian = (torch.cat(part) for part in zip(*parts))
    start = torch.zeros(len(counts) + 1, dtype=torch.int64, device=counts.device)
    torch.cumsum(counts, 0, out=start[1:])
    return CandidateList(start, gaussian)


def _rasterise(center: Tensor, radius: Tensor, top: int, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Discs that cover the pixels of a strip of rows: the number of discs of each pixel, int64 `[pixels]`, and the discs, int64
    `[M]`.

    Discs are in the order of pixels, and within a pixel in the order of the arguments. The code works in chunks, and skips most
    pixels that already have MAX_CANDIDATES, so that memory is bounded for any number of overlapping discs.

    top: first row of the strip. counts: number of discs of each pixel so far, int32 `[rows, width]`; this function updates the
    numbers.
    """
    area = (2.0 * radius.double() + 2.0).clamp(max=counts.shape[1]) * (2.0 * radius + 2.0).clamp(max=len(counts))
    chunk = (area.cumsum(0) / CHUNK_PIXELS).long()
    pixels, discs = [torch.zeros(0, dtype=torch.int32, device=radius.device)], [radius[:0].long()]
    for first, last in _runs(chunk):
        pixel, disc = _covered_pixels(center[:, first:last], radius[first:last], top, counts)
        space = indices(counts.view(-1).index_select(0, pixel) < MAX_CANDIDATES)
        pixels.append(pixel.index_select(0, space).int())
        discs.append(disc.index_select(0, space) + first)
        counts.view(-1).add_(torch.bincount(pixels[-1], minlength=counts.numel()))
    pixel, by_pixel = torch.sort(torch.cat(pixels), stable=True)  # keeps the strongest first
    covered = torch.bincount(pixel, minlength=counts.numel())
    rank = torch.arange(len(pixel), device=pixel.device) - (covered.cumsum(0) - covered).index_select(0, pixel)
    kept = indices(rank < MAX_CANDIDATES)
    return covered.clamp(max=MAX_CANDIDATES), torch.cat(discs).index_select(0, by_pixel.index_select(0, kept))


def _runs(values: Tensor) -> list[tuple[int, int]]:
    """First index of each run of equal values, and the index after the run."""
    counts = torch.unique_consecutive(values, return_counts=True)[1].tolist()
    ends = torch.tensor(counts).cumsum(0).tolist()
    return [(end - count, end) for end, count in zip(ends, counts)]


def _covered_pixels(center: Tensor, radius: Tensor, top: int, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels of a strip whose centres lie in discs, and the disc of each pixel, int64 `[M]` each, in the order of discs.

    The result omits a row of a disc if all pixels of the row have MAX_CANDIDATES (see `_rasterise`).
    """
    height, width = counts.shape
    first = (center[1] - radius - 0.5).ceil().clamp(top, top + height).long()
    end = ((center[1] + radius - 0.5).floor() + 1.0).clamp(top, top + height).long()
    disc, row = _expand(first, end)
    x, y, radius = (values.index_select(0, disc) for values in (*center, radius))
    half = (radius.square() - (row + 0.5 - y).square()).clamp(min=0.0).sqrt()
    left = (x - half - 0.5).ceil().clamp(0, width).long()
    right = ((x + half - 0.5).floor() + 1.0).clamp(0, width).long()
    open_before = pad((counts < MAX_CANDIDATES).int().cumsum(1, dtype=torch.int32), (1, 0)).view(-1)
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
