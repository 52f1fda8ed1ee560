"""Which Gaussians can be seen through the lens by which pixel: a packed list.

The list is made by drawing one disc per Gaussian, so the work grows with the pixels
covered and never with pixels × Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bokehguide.models.gaussian_field import GaussianField
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.pixels import Pixels, take

MAX_CANDIDATES = 16
"""A pixel keeps this many of its strongest Gaussians."""
DRAWN_TOGETHER = 1 << 22
"""Pixels of discs that are held in memory at a time."""
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
            start = self.start[pixels.start : pixels.stop + 1]
            low, high = int(start[0]), int(start[-1])
            return start - low, self.gaussian[low:high].long()
        first = take(self.start[:-1], pixels)
        counts = take(self.start[1:], pixels) - first
        start = torch.cat((torch.zeros_like(counts[:1]), counts.cumsum(0)))
        owner = torch.repeat_interleave(counts)
        place = torch.arange(len(owner), device=owner.device) + (first - start[:-1]).index_select(0, owner)
        return start, self.gaussian.index_select(0, place).long()

    def counts(self) -> Tensor:
        """Number of candidates of each pixel, int64 `[pixels]`."""
        return self.start[1:] - self.start[:-1]


def draw_candidates(
    field: GaussianField, camera: ThinLensCamera, slack: float = 0.0, without: Tensor | None = None
) -> CandidateList:
    """List the Gaussians that each pixel may see, by drawing their discs on the raster.

    slack: by how many σ the means may still move (polynomial offsets). without: pixels to
    leave out, bool `[pixels]`.
    """
    center, radius = field.footprints(camera)
    lens = camera.lens
    extra = slack * field.sigma / (field.mean[2] * camera.pixel_slope)
    strength = field.lens_weights(lens.focus_distance)
    order = strength.argsort(descending=True)
    center, radius = center[:, order], (radius + extra + PIXEL_MARGIN)[order]
    full = torch.zeros(camera.width * camera.height, dtype=torch.int64, device=center.device)
    if without is not None:
        full[without] = MAX_CANDIDATES
    pixel, drawn = _draw(center, radius, camera.width, camera.height, full)
    pixel, by_pixel = torch.sort(pixel, stable=True)  # keeps the strongest first
    numbers = torch.arange(camera.width * camera.height + 1, device=pixel.device, dtype=pixel.dtype)
    start = torch.searchsorted(pixel, numbers)
    rank = torch.arange(len(pixel), device=pixel.device) - start[pixel.long()]
    kept = (rank < MAX_CANDIDATES).nonzero()[:, 0]
    counts = (start[1:] - start[:-1]).clamp(max=MAX_CANDIDATES)
    start = torch.cat((torch.zeros_like(counts[:1]), counts.cumsum(0)))
    return CandidateList(start, order[drawn[by_pixel[kept]].long()].int())


def _draw(center: Tensor, radius: Tensor, width: int, height: int, full: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels and numbers of discs, int32 `[M]`, in the discs' order; few beyond MAX_CANDIDATES for a pixel.

    full: int64 `[pixels]`, how many candidates each pixel has already; it is counted on.
    Discs are drawn DRAWN_TOGETHER pixels at a time, and not where pixels are full already,
    so memory is bounded however many discs lie over one another.
    """
    area = (4.0 * (radius + 1.0).square()).clamp(max=float(width * height))
    part = (area.double().cumsum(0) / DRAWN_TOGETHER).long()
    pieces = []
    for first, last in _runs(part):
        pixel, disc = _fill_discs(center[:, first:last], radius[first:last], width, height)
        space = (full[pixel.long()] < MAX_CANDIDATES).nonzero()[:, 0]
        pieces.append((pixel[space], disc[space] + first))
        full += torch.bincount(pieces[-1][0], minlength=width * height)
    pixels, discs = zip(*pieces)
    return torch.cat(pixels), torch.cat(discs)


def _runs(values: Tensor) -> list[tuple[int, int]]:
    """First and past-the-last index of each run of equal values."""
    counts = torch.unique_consecutive(values, return_counts=True)[1].tolist()
    ends = torch.tensor(counts).cumsum(0).tolist()
    return [(end - count, end) for end, count in zip(ends, counts)]


def _fill_discs(center: Tensor, radius: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Pixels whose centres lie in each disc: int32 pixel and disc numbers `[M]`, disc by disc."""
    top = (center[1] - radius - 0.5).ceil().clamp(0, height).long()
    bottom = ((center[1] + radius - 0.5).floor() + 1.0).clamp(0, height).long()
    disc, row = _expand(top, bottom)
    dy = row + 0.5 - center[1, disc]
    half = (radius[disc].square() - dy.square()).clamp(min=0.0).sqrt()
    left = (center[0, disc] - half - 0.5).ceil().clamp(0, width).long()
    right = ((center[0, disc] + half - 0.5).floor() + 1.0).clamp(0, width).long()
    span, column = _expand(left, right)
    return (row[span] * width + column).int(), disc[span].int()


def _expand(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """All (i, v) with low[i] ≤ v < high[i], in order: int64 `[M]` each."""
    counts = (high - low).clamp(min=0)
    owner = torch.repeat_interleave(counts)
    first = counts.cumsum(0) - counts
    return owner, torch.arange(len(owner), device=low.device) - first[owner] + low[owner]
