"""Other ways for the field to learn, for `ablations.py` to compare with its own."""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.models.lens_distribution import GuidedLensDistribution, LensDensity, LensMixture
from bokehguide.models.projection import lens_density, log_density_gradient, project_to_lens
from bokehguide.render.pixels import indices
from bokehguide.train import fitting
from bokehguide.train.guide import FITS, BatchLesson, GuidedBatch, LensGuide
from bokehguide.train.spot_guide import SpotGuide

FIELD_RATE = 0.03
"""Learning rate of σ and of weights, as logarithms, and of means, in units of σ."""
LARGEST = 2.0
"""Most that they change by."""
DISC = fitting.AXES
"""Radius of a found disc by the σ of the Gaussian of least KL divergence from its light."""


class LearntField(LensGuide):
    """The guide of `lis-o`, but σ and weights of its frozen Gaussians descend the one-sample KL as their offsets do."""

    def freeze(self) -> None:
        super().freeze()
        self.changes = torch.nn.Parameter(torch.zeros(2, len(self.field)))
        self.optimizers["field"] = torch.optim.Adam([self.changes], lr=FIELD_RATE)
        self._fitted = torch.stack((self.field.sigma, self.field.energy))

    def study(self, batch: GuidedBatch, ratio: Tensor, at: LensDensity) -> BatchLesson:
        lesson = super().study(batch, ratio, at)
        if self.offsets is not None:
            gradient = torch.zeros_like(self.changes, dtype=torch.float64)
            gradient.index_add_(1, batch.gaussian, field_gradient(batch.distribution, ratio, at).double())
            lesson.field_gradient = gradient
        return lesson

    def update(self, step: int, lessons: list[BatchLesson], mean_luminance: float) -> None:
        frozen = self.offsets is not None
        super().update(step, lessons, mean_luminance)
        if frozen and lessons:
            self.changes.grad = sum(lesson.field_gradient for lesson in lessons).float()
            self.optimizers["field"].step()
            with torch.no_grad():
                self.field.sigma, self.field.energy = self._fitted * self.changes.clamp_(-LARGEST, LARGEST).exp()


class KeptSpots(SpotGuide):
    """The guide of `guided`, but the highlights that it has found after FITS steps are kept as they are."""

    rate = 0.0

    def refit(self, mean_luminance: float) -> None:
        if getattr(self, "changes", None) is None:
            super().refit(mean_luminance)
            if int(self.block) > FITS and len(self.field) > self._known:
                self._keep()
        else:
            self._adopt()

    @property
    def _known(self) -> int:
        return len(self._lamps.field)

    def _keep(self) -> None:
        self.changes = torch.nn.Parameter(torch.zeros(5, len(self.field) - self._known))
        self.optimizers["field"] = torch.optim.Adam([self.changes], lr=self.rate)
        self._mean, self._sigma = self.field.mean[:, self._known :], self.field.radius[self._known :] / DISC
        self._energy, self._outlines = self.field.energy[self._known :], self.outlines[:, self._known :]

    @torch.no_grad()
    def _adopt(self) -> None:
        """Draw from what has been learnt: at the ends of blocks, within which nothing may change."""
        mean, sigma = self._learnt()
        radius, energy = DISC * sigma, self._energy * self.changes[4].exp()
        outlines = self._outlines * (2.0 * self.changes[3]).exp()
        field, known = self.field, self._known
        self.outlines = torch.cat((self.outlines[:, :known], outlines), dim=1)
        radius, energy = torch.cat((field.radius[:known], radius)), torch.cat((field.energy[:known], energy))
        field.assign(torch.cat((field.mean[:, :known], mean), dim=1), radius, radius, energy)
        self.set_candidates()

    def _learnt(self) -> tuple[Tensor, Tensor]:
        """Means `[3, G]` and σ `[G]` as they are by now."""
        return self._mean + self._sigma * self.changes[:3], self._sigma * self.changes[3].exp()

    def study(self, batch: GuidedBatch, ratio: Tensor, at: LensDensity) -> BatchLesson:
        lesson = super().study(batch, ratio, at)
        lesson.field_gradient = None if getattr(self, "changes", None) is None else self._gradient(batch, ratio, at)
        return lesson

    @torch.no_grad()
    def _gradient(self, batch: GuidedBatch, ratio: Tensor, at: LensDensity) -> Tensor:
        """∂ loss / ∂ changes, float64 `[5, G]`: the loss's q has Gaussians in the place of found discs, which have no gradient."""
        mixture = batch.distribution
        mean, sigma = self._learnt()
        found = indices(batch.gaussian >= self._known)
        spot, owner = batch.gaussian.index_select(0, found) - self._known, mixture.owner.index_select(0, found)
        points, focus = at.points.index_select(1, owner), mixture.focus.index_select(1, owner)
        mean, sigma = mean.index_select(1, spot), sigma.index_select(0, spot)
        component, weight = at.components.clone(), mixture.weight.clone()
        component[found] = lens_density(points, focus, mean, sigma)
        weight[found] *= self.changes[4].exp().index_select(0, spot)
        weight /= _sums(weight, mixture).clamp(min=1e-30).index_select(0, mixture.owner)
        mixed = _sums(weight * component, mixture)
        density = mixture.blend(at.points, mixed).clamp(min=1e-37)
        scale = (-ratio * mixture.beta / density).index_select(0, owner)
        part, share = (weight * component).index_select(0, found), weight.index_select(0, found)
        of_field = torch.cat((self._sigma.index_select(0, spot) * log_density_gradient(points, focus, mean, sigma), sigma_slope(points, focus, mean, sigma)[None]))
        slopes = torch.cat((part * of_field, (part - share * mixed.index_select(0, owner))[None]))
        slopes = (scale * slopes).nan_to_num(0.0, 0.0, 0.0).double()
        return torch.zeros_like(self.changes, dtype=torch.float64).index_add_(1, spot, slopes)

    def update(self, step: int, lessons: list[BatchLesson], mean_luminance: float) -> None:
        gradients = [lesson.field_gradient for lesson in lessons if lesson.field_gradient is not None]
        if gradients:
            self.changes.grad = sum(gradients).float()
            self.optimizers["field"].step()
            with torch.no_grad():
                self.changes.clamp_(-LARGEST, LARGEST)
        super().update(step, lessons, mean_luminance)


def _sums(values: Tensor, mixture: LensMixture) -> Tensor:
    """Sums `[N]` over each pixel's candidates of `[M]`."""
    return torch.zeros_like(mixture.beta).index_add_(0, mixture.owner, values)


class LearntSpots(KeptSpots):
    """As KeptSpots, but their means, sizes and weights descend the one-sample KL, step by step, and are drawn from block by block."""

    rate = FIELD_RATE


def field_gradient(mixture: GuidedLensDistribution, ratio: Tensor, at: LensDensity) -> Tensor:
    """∂ loss / ∂ (log σ, log weight) of each candidate, `[2, M]`, with the loss of `models/kl.py`."""
    owner = mixture.owner
    of_sigma = sigma_slope(at.points[:, owner], mixture.focus[:, owner], mixture.mean, mixture.sigma)
    scale = -(ratio * mixture.beta / at.density.clamp(min=1e-37))[owner]
    part = mixture.weight * at.components
    of_weight = part - mixture.weight * at.mixture[owner]
    return (scale * torch.stack((part * of_sigma, of_weight))).nan_to_num(0.0, 0.0, 0.0)


def sigma_slope(points: Tensor, focus: Tensor, mean: Tensor, sigma: Tensor) -> Tensor:
    """∂ log p / ∂ log σ `[N]` of `lens_density`: 2 σ² / (σ² + a²) - 2 + s² / σ²."""
    variance = sigma.square()
    ray = torch.cat((points - focus[:2], -focus[2:3]))
    omega = ray / ray.square().sum(0).sqrt()
    a = ((mean - focus) * omega).sum(0)
    # s by how far on the lens the mean is from the point; |e|² - a² would lose its digits.
    aside = project_to_lens(mean, focus) - points
    across = torch.cat((aside, torch.zeros_like(aside[:1]))) * ((focus[2] - mean[2]) / focus[2])
    s_squared = (across.square().sum(0) - (across * omega).sum(0).square()).clamp(min=0.0)
    return 2.0 * variance / (variance + a * a) - 2.0 + s_squared / variance
