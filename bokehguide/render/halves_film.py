"""The film of an adaptive render: two films of independent halves, and their mean."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.bad_samples import BadSample, earliest
from bokehguide.render.coverage import Covered
from bokehguide.render.film import NO_DEPTH, Film
from bokehguide.render.split_film import Halves, relative_error


class HalfFilm(Film):
    """The film of one half. It is the picture while the other half has no sample."""

    def halves(self) -> Halves:
        """All samples in the first picture and none in the second, as of `SplitFilm` after one step."""
        radiance, emission = self.radiance(), self.emission()
        share = torch.ones(radiance.shape[:2], device=radiance.device)
        return Halves(radiance, torch.zeros_like(radiance), share, emission, torch.zeros_like(emission))


class HalvesFilm:
    """The mean of two films, with the methods of `Film` that the output of a render needs."""

    def __init__(self, first: Film, second: Film):
        self._films = (first, second)
        self.width, self.height, self.corner = first.width, first.height, first.corner

    @property
    def bad_count(self) -> int:
        """As `Film`."""
        return sum(film.bad_count for film in self._films)

    @property
    def bad_samples(self) -> list[BadSample]:
        """As `Film`. The seed of a bad sample identifies the half."""
        return earliest([bad for film in self._films for bad in film.bad_samples])

    def radiance(self) -> Tensor:
        """Mean radiance so far, float32 `[H, W, 3]`."""
        first, second = (film.radiance() for film in self._films)
        return 0.5 * (first + second)

    def halves(self) -> Halves:
        """The mean radiance of each half."""
        first, second = (film.radiance() for film in self._films)
        share = torch.full(first.shape[:2], 0.5, device=first.device)
        return Halves(first, second, share, *(film.emission() for film in self._films))

    def samples(self) -> float:
        """Number of all samples."""
        return sum(film.samples() for film in self._films)

    def relative_noise(self) -> float:
        """Estimated MAPE of the mean: `relative_error` of the halves, averaged over the frame."""
        first, second = (film.radiance().permute(2, 0, 1) for film in self._films)
        return float(relative_error(first, second).mean())

    def covered(self) -> dict[str, Covered]:
        """As `Film.covered`: the means of both films."""
        first, second = (film.covered() for film in self._films)
        return {kind: first[kind].mean(second[kind]) for kind in first}

    def light_groups(self) -> dict[str, np.ndarray]:
        """As `Film.light_groups`: the means of both films."""
        first, second = (film.light_groups() for film in self._films)
        return {name: 0.5 * (first[name] + second[name]) for name in first}

    def layers(self) -> dict[str, np.ndarray]:
        """As `Film.layers`: the means of both films, the sum of the sample counts, and the variance of the mean."""
        first, second = (film.layers() for film in self._films)
        layers = {name: 0.5 * (first[name] + second[name]) for name in first}
        layers["sample_count"] *= 2.0
        layers["variance"] *= 0.5
        one, two = first["depth"], second["depth"]
        layers["depth"] = np.where(one >= NO_DEPTH, two, np.where(two >= NO_DEPTH, one, layers["depth"]))
        return layers
