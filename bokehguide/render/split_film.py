"""A film in two halves: the samples of even epochs and those of odd epochs make two pictures."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from bokehguide.metrics import EPSILON
from bokehguide.render.epochs import epoch_number
from bokehguide.render.film import Film, FilmSamples
from bokehguide.runtime.indexing import Pixels, scatter_add

POOLED = 5
"""Side, in pixels, of the square around a pixel whose mean estimates the radiance of the pixel."""


def relative_error(first: Tensor, second: Tensor, share: Tensor | float = 0.5) -> Tensor:
    """Estimated error of the mean of two pictures `[C, H, W]`, relative to the truth (plus 0.01), `[C, H, W]`.

    share: weight of the first picture in the mean, which is its part of the samples, `[H, W]`. The noise of the pictures is taken
    to be uncorrelated, with variances inversely proportional to the samples. Their difference, times √(share (1 - share)), then
    has the magnitude of the error of their mean. The denominator uses the mean of both pictures in the pixel or around the pixel,
    whichever is less. A rare highlight makes a single pixel too bright, but not its neighbours. Features that both pictures
    missed go undetected.
    """
    share = torch.as_tensor(share)
    mean = (share * first + (1.0 - share) * second).clamp(min=0.0)
    about = avg_pool2d(mean[None], POOLED, 1, POOLED // 2, count_include_pad=False)[0]
    return (share * (1.0 - share)).sqrt() * (first - second).abs() / (torch.minimum(mean, about) + EPSILON)


class Halves(NamedTuple):
    """Two pictures whose mean is the picture.

    first, second: radiance, float32 `[H, W, 3]`; share: weight of the first in the mean, from 0 to 1, float32 `[H, W]`. Where
    `share` is 0 or 1, one of the halves has no sample and is black. first_emission, second_emission: the part of the radiance
    that is emission of primary hits, as in `Film.layers`, float32 `[H, W, 3]`.
    """

    first: Tensor
    second: Tensor
    share: Tensor
    first_emission: Tensor
    second_emission: Tensor


class SplitFilm(Film):
    """As `Film`, and the radiance and emission of the second half once more: of the epochs with odd numbers, counted from 0.

    Each step is unbiased, whatever the earlier steps were. Where epochs have independent random numbers, the noise of the halves
    is therefore uncorrelated. Steps of one epoch share a Sobol' sequence and have negatively correlated noise, so that a half
    contains whole epochs. In mode `uniform`, the sequence of lens points goes on over all epochs: the noise of the halves is
    negatively correlated, and their mean has less error than their difference shows.
    """

    def __init__(self, width: int, height: int, *args: Any, **keywords: Any):
        super().__init__(width, height, *args, **keywords)
        self._second = torch.zeros_like(self._radiance)
        self._second_emission = torch.zeros_like(self._emission)
        self._second_count = torch.zeros_like(self._count)

    def _sums(self) -> dict[str, Tensor]:
        second = ("second", "second_emission", "second_count")
        return super()._sums() | {name: getattr(self, f"_{name}") for name in second}

    def add(
        self, pixels: Pixels, samples: FilmSamples, step: int, recenter: bool = True, counted: Tensor | None = None
    ) -> Tensor:
        """As `Film.add`."""
        good = super().add(pixels, samples, step, recenter, counted)
        if epoch_number(step) % 2 == 1:
            kept = good if counted is None else good & counted
            scatter_add(self._second, pixels, torch.where(kept, samples.value(), 0.0))
            scatter_add(self._second_emission, pixels, torch.where(kept, samples.emission * samples.weight, 0.0))
            scatter_add(self._second_count, pixels, kept.to(torch.float32))
        return good

    def halves(self) -> Halves:
        """The means of both halves."""
        first_count = self._count - self._second_count
        share = first_count / self._count.clamp(min=1.0)

        def means(sums: Tensor, of_second: Tensor) -> tuple[Tensor, Tensor]:
            first, second = (
                (total / count.clamp(min=1.0)).float().T.reshape(self.height, self.width, 3)
                for total, count in ((sums - of_second, first_count), (of_second, self._second_count))
            )
            return first, second

        emission = means(self._emission, self._second_emission)
        return Halves(*means(self._radiance, self._second), share.reshape(self.height, self.width), *emission)
