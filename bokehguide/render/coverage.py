"""Coverage: the share of each pixel's samples whose primary hits are on one object, for the few objects that cover the most."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.render.features import MeanFeatures
from bokehguide.runtime import native
from bokehguide.runtime.indexing import Pixels, core_pixels, gather_pixels, indices, pixel_numbers

SLOTS = 8
"""Number of objects that a pixel keeps."""


class Covered(NamedTuple):
    """numbers: of objects, from 1, 0 for none, int32 `[S, pixels]`, each at most once in a pixel. share: their coverage, float64
    `[S, pixels]`, 0 for none."""

    numbers: Tensor
    share: Tensor

    def mean(self, other: Covered) -> Covered:
        """The mean of two independent pictures, with the objects of both, `[2 S, pixels]`."""
        numbers, shares = list(self.numbers), [0.5 * share for share in self.share]
        for number, share in zip(other.numbers, other.share):
            found = torch.zeros_like(number, dtype=torch.bool)
            for slot in range(len(self.numbers)):
                same = (numbers[slot] == number) & (number > 0)
                shares[slot] = shares[slot] + 0.5 * share * same
                found |= same
            numbers.append(torch.where(found, 0, number))
            shares.append(torch.where(found, 0.0, 0.5 * share))
        return Covered(torch.stack(numbers), torch.stack(shares))

    def ranked(self, ranks: int) -> Covered:
        """The `ranks` objects of the largest coverage, in descending order.

        Noise can make the coverage negative, or the sum of a pixel larger than 1. Negative coverage becomes 0, and a sum above 1
        becomes 1.
        """
        share = self.share.clamp(min=0.0)
        share = share / share.sum(0).clamp(min=1.0)
        order = self.numbers.sort(dim=0, stable=True).indices  # objects of equal coverage stand by their numbers
        order = order.gather(0, share.gather(0, order).sort(dim=0, descending=True, stable=True).indices)[:ranks]
        share = share.gather(0, order)
        return Covered(self.numbers.gather(0, order) * (share > 0.0), share)


class Coverage:
    """The objects that each pixel sees, and their coverage. Threads may add batches of different pixels concurrently.

    An object is any set of triangles, such as those with one material. A pixel keeps SLOTS objects. A further object replaces the
    object of the least coverage so far, whose samples are lost. The coverage has the estimator of alpha, so that it is unbiased,
    and the coverage of all objects of a pixel adds up to its share of primary hits.

    objects: number of the object of each triangle, from 1, int32 `[T]`. features: class of the estimator, as of `Film`.
    """

    def __init__(self, objects: Tensor, pixels: int, features: type[MeanFeatures], device: torch.device | str = "cpu"):
        self._objects = objects.to(device)
        self._numbers = torch.zeros(SLOTS, pixels, dtype=torch.int32, device=device)
        self._features = features(pixels, device, SLOTS)

    def sums(self) -> dict[str, Tensor]:
        """Objects, int32 `[SLOTS, pixels]`, and running sums as of `MeanFeatures`, by name. A film saves these tensors."""
        return {"objects": self._numbers, **self._features.sums()}

    def check(self, numbers: Tensor) -> None:
        """Raise ValueError if the objects `[SLOTS, pixels]` of another state name an object that the scene has not."""
        if numbers.numel() and int(numbers.max()) > int(self._objects.max()):
            raise ValueError("the coverage has an object that the scene has not")

    def add(self, pixels: Pixels, triangle: Tensor, weight: Tensor, kept: Tensor, recenter: bool) -> None:
        """Add one sample to each of N different pixels.

        triangle: of the primary hit, int32 `[N]`, -1 without a hit; weight, kept, recenter: as `MeanFeatures.add` and `Film.add`
        take them.
        """
        core = native.core_on(triangle.device)
        if core is not None:
            first, places = core_pixels(pixels)
            samples = triangle.contiguous(), weight.contiguous(), kept.contiguous()
            core.cover(self.sums(), self._objects, places, first, *samples, recenter)
            return
        seen = self._seen(pixels, triangle, kept)
        if recenter:
            self._features.recenter(pixels)
        self._features.add(pixels, seen, weight, kept)

    def initialise(self, pixels: Pixels, triangle: Tensor) -> None:
        """Initialise the estimator with samples of weight 1 that are not in the picture. triangle: as in `add`, `[N]`."""
        self._features.initialise(pixels, self._seen(pixels, triangle, torch.ones_like(triangle)))

    def covered(self, count: Tensor) -> Covered:
        """The objects of each pixel in any order; count: number of samples in the picture, at least 1, `[pixels]`."""
        return Covered(self._numbers, self._features.means(count) * (self._numbers > 0))

    def _seen(self, pixels: Pixels, triangle: Tensor, kept: Tensor) -> Tensor:
        """1 in the slot of the object that each sample sees, else 0, float32 `[SLOTS, N]`.

        New objects get a slot. Only `kept` samples take the slot of another object, which may be in the picture.
        """
        found = self._objects.index_select(0, triangle.clamp(min=0))
        found = torch.where(triangle >= 0, found, -1)
        same = gather_pixels(self._numbers, pixels) == found
        space = gather_pixels(self._numbers[-1], pixels) == 0  # a pixel fills its slots in order
        new = indices((found > 0) & (space | (kept > 0)) & ~same.any(0))
        if len(new) > 0:
            places = pixel_numbers(pixels, found.device).index_select(0, new)
            slot = self._least(places)
            self._features.forget(slot, places)
            self._numbers[slot, places] = found.index_select(0, new)
            same[slot, new] = True
        return same.to(torch.float32)

    def _least(self, places: Tensor) -> Tensor:
        """The first empty slot of each pixel, or the slot of the least coverage, int64 `[K]`."""
        total = self._features.sums()["features"].index_select(1, places)
        empty = self._numbers.index_select(1, places) == 0
        return torch.where(empty, -torch.inf, total).argmin(0)
