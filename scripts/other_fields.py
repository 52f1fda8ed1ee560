"""Other ways for the field to learn, for `ablations.py` to compare with its own."""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.models.lens_distribution import GuidedLensDistribution, LensDensity
from bokehguide.models.projection import project_to_lens
from bokehguide.render.camera import ThinLensCamera
from bokehguide.train import fitting
from bokehguide.train.guide import BatchLesson, GuidedBatch, LensGuide
from bokehguide.train.rank_sums import RankSums
from bokehguide.train.ranks import Ranks
from bokehguide.train.record_buffer import RecordBuffer

LAYERS = 8
FIELD_RATE = 0.03
"""Learning rate of σ and of weights, as logarithms."""
LARGEST = 2.0
"""Most that they change by."""
WHOLE_PATCHES = fitting.label_patches


class LayeredRecord(RecordBuffer):
    """A record buffer whose cells are as many as LAYERS each, by defocus: highlights that share a texel stay apart.

    A layer's radiance is what it adds to its texel's, as the rays that pass it by count.
    """

    def __init__(self, camera: ThinLensCamera, ranks: Ranks | None = None):
        super().__init__(camera, ranks)
        RankSums.__init__(self, torch.zeros(5, LAYERS * self.width * self.height), ranks)
        self._focus = camera.lens.focus_distance

    def cells(self, camera: ThinLensCamera, points: Tensor) -> Tensor:
        cell = super().cells(camera, points)
        defocus = (1.0 - self._focus / points[2].clamp(min=1e-9)).clamp(-1.0, 1.0)  # 1 at infinity, negative before the focal plane
        layer = (0.5 * LAYERS * (1.0 + defocus)).long().clamp(max=LAYERS - 1)
        return torch.where(cell >= 0, cell + layer * (self.width * self.height), -1)

    def add(self, cells: Tensor, points: Tensor, luminance: Tensor) -> None:
        super().add(cells, points, luminance)
        kept, size = cells[cells >= 0], self.width * self.height
        for further in range(1, LAYERS):
            others = (kept + further * size) % (LAYERS * size)
            self.mine[0].index_add_(0, others, torch.ones_like(others, dtype=torch.float32))

    def radiance(self) -> Tensor:
        return (self.sums[1] / self.sums[0].clamp(min=1.0)).reshape(LAYERS * self.height, self.width)


def layered_patches(record: LayeredRecord, cells: Tensor, depth: Tensor, width: Tensor) -> Tensor:
    """As `label_patches`: cells of any layers that touch on the raster, split where their depths leap."""
    return WHOLE_PATCHES(record, cells % (record.width * record.height), depth, width)


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


def field_gradient(mixture: GuidedLensDistribution, ratio: Tensor, at: LensDensity) -> Tensor:
    """∂ loss / ∂ (log σ, log weight) of each candidate, `[2, M]`, with the loss of `models/kl.py` and `lens_density`'s p.

    ∂ log p / ∂ log σ = 2 σ² / (σ² + a²) - 2 + s² / σ².
    """
    owner, variance = mixture.owner, mixture.sigma.square()
    focus, points = mixture.focus[:, owner], at.points[:, owner]
    ray = torch.cat((points - focus[:2], -focus[2:3]))
    omega = ray / ray.square().sum(0).sqrt()
    e = mixture.mean - focus
    a = (e * omega).sum(0)
    # s by how far on the lens the mean is from the point; |e|² - a² would lose its digits.
    aside = project_to_lens(mixture.mean, focus) - points
    across = torch.cat((aside, torch.zeros_like(aside[:1]))) * ((focus[2] - mixture.mean[2]) / focus[2])
    s_squared = (across.square().sum(0) - (across * omega).sum(0).square()).clamp(min=0.0)
    scale = -(ratio * mixture.beta / at.density.clamp(min=1e-37))[owner]
    part = mixture.weight * at.components
    of_sigma = part * (2.0 * variance / (variance + a * a) - 2.0 + s_squared / variance)
    of_weight = part - mixture.weight * at.mixture[owner]
    return (scale * torch.stack((of_sigma, of_weight))).nan_to_num(0.0, 0.0, 0.0)
