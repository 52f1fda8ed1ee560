"""Defects of the estimator, each of which the statistical tests must detect."""

from __future__ import annotations

import math
import os
from collections.abc import Callable

import torch
from torch import Tensor

from bokehguide.models import gaussian_mixture
from bokehguide.render import mis
from bokehguide.render.film import Film
from bokehguide.runtime import native
from bokehguide.runtime.indexing import Pixels


def drop_zero(add: Callable) -> Callable:
    """Leave draws outside the aperture out of N: the film skips samples that are not finite."""

    def mutated(film: Film, pixels: Pixels, samples, *rest):
        samples.radiance[:, samples.weight == 0.0] = math.nan
        return add(film, pixels, samples, *rest)

    return mutated


def drop_weight(add: Callable) -> Callable:
    """Omit the weight 1 / (A q)."""

    def mutated(film: Film, pixels: Pixels, samples, *rest):
        samples.weight = (samples.weight > 0.0).float()
        return add(film, pixels, samples, *rest)

    return mutated


def drop_cosine(density: Callable) -> Callable:
    """Omit cosθ in the density on the lens."""

    def mutated(lens_points: Tensor, focus: Tensor, mean: Tensor, sigma: Tensor) -> Tensor:
        ray = torch.cat((lens_points - focus[:2], -focus[2:3]))
        return density(lens_points, focus, mean, sigma) * ray.square().sum(0).sqrt() / focus[2]

    return mutated


def drop_mis(heuristic: Callable) -> Callable:
    """Count light that both techniques find twice: weight 1 in MIS."""
    return lambda pdf, other: torch.ones_like(heuristic(pdf, other))


MUTATIONS = {
    "drop-zero": (Film, "add", drop_zero),
    "drop-weight": (Film, "add", drop_weight),
    "drop-cosine": (gaussian_mixture, "lens_density", drop_cosine),
    "drop-mis": (mis, "power_heuristic", drop_mis),
}


class Mutation:
    """A context in which one function of the renderer is replaced by its broken variant; without a name nothing is."""

    def __init__(self, name: str | None):
        self.name = name

    def __enter__(self) -> None:
        if self.name:
            owner, attribute, mutate = MUTATIONS[self.name]
            self.switch = os.environ.get(native.SWITCH, "1")
            os.environ[native.SWITCH] = "0"  # the native core has functions of its own
            self.original = getattr(owner, attribute)
            setattr(owner, attribute, mutate(self.original))

    def __exit__(self, *_: object) -> None:
        if self.name:
            owner, attribute, _ = MUTATIONS[self.name]
            setattr(owner, attribute, self.original)
            os.environ[native.SWITCH] = self.switch
