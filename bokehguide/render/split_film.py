"""A film in two halves: the samples of even steps and those of odd steps make two pictures."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from bokehguide.metrics import EPSILON
from bokehguide.render.film import Film, FilmSamples
from bokehguide.runtime.indexing import Pixels, scatter_add

POOLED = 5
"""Side, in pixels, of the square around a pixel whose mean estimates the radiance of the pixel."""


def relative_error(first: Tensor, second: Tensor) -> Tensor:
    """Estimated error of the mean of two pictures `[C, H, W]`, relative to the truth (plus 0.01), `[C, H, W]`.

    Half of the difference of two pictures with uncorrelated noise has the magnitude of the error of their mean. The noise of
    halves is negatively correlated (see `SplitFilm`), so that the estimate is too large. The denominator uses the mean of both
    pictures in the pixel or around the pixel, whichever is less. A rare highlight makes a single pixel too bright, but not its
    neighbours. Features that both pictures missed go undetected.
    """
    mean = (0.5 * (first + second)).clamp(min=0.0)
    about = avg_pool2d(mean[None], POOLED, 1, POOLED // 2, count_include_pad=False)[0]
    return 0.5 * (first - second).abs() / (torch.minimum(mean, about) + EPSILON)


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
    """As `Film`, and the radiance and emission of the even steps once more.

    Each step is unbiased, whatever the earlier steps were. With independent random numbers, the noise of two steps would
    therefore be uncorrelated. Steps of an epoch share a Sobol' sequence, which makes their correlation slightly negative. The
    mean of the halves then has less error than their difference shows.
    """

    def __init__(self, width: int, height: int, *args: Any, **keywords: Any):
        super().__init__(width, height, *args, **keywords)
        self._even = torch.zeros_like(self._radiance)
        self._even_emission = torch.zeros_like(self._emission)
        self._even_count = torch.zeros_like(self._count)

    def _sums(self) -> dict[str, Tensor]:
        even = {"even": self._even, "even_emission": self._even_emission, "even_count": self._even_count}
        return super()._sums() | even

    def add(
        self, pixels: Pixels, samples: FilmSamples, step: int, recenter: bool = True, counted: Tensor | None = None
    ) -> Tensor:
        """As `Film.add`."""
        good = super().add(pixels, samples, step, recenter, counted)
        if step % 2 == 0:
            kept = good if counted is None else good & counted
            scatter_add(self._even, pixels, torch.where(kept, samples.value(), 0.0))
            scatter_add(self._even_emission, pixels, torch.where(kept, samples.emission * samples.weight, 0.0))
            scatter_add(self._even_count, pixels, kept.to(torch.float32))
        return good

    def halves(self) -> Halves:
        """The means of odd and of even steps."""
        odd_count = self._count - self._even_count
        share = odd_count / self._count.clamp(min=1.0)

        def means(sums: Tensor, even: Tensor) -> tuple[Tensor, Tensor]:
            first, second = (
                (total / count.clamp(min=1.0)).float().T.reshape(self.height, self.width, 3)
                for total, count in ((sums - even, odd_count), (even, self._even_count))
            )
            return first, second

        emission = means(self._emission, self._even_emission)
        return Halves(*means(self._radiance, self._even), share.reshape(self.height, self.width), *emission)
