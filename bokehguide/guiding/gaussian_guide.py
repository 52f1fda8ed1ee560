"""The paper's guide: Gaussians fitted to a record of primary hits, learned β and polynomial offsets (sections 4.2, 5 and 6.1)."""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.guiding.config import GaussianConfig
from bokehguide.guiding.guide import Guide, GuideRecord, learned_of
from bokehguide.guiding.highlight_fitting import fit_gaussians
from bokehguide.guiding.lens_queries import MixtureQuery, UniformQuery
from bokehguide.guiding.protocols import BatchSamples, LensContext, LensQuery, PixelBatch, StepSummary
from bokehguide.guiding.record_buffer import RecordBuffer
from bokehguide.models.base import LensDensity, owners
from bokehguide.models.blend_weight import BlendWeightMap
from bokehguide.models.candidates import draw_candidates
from bokehguide.models.gaussian_mixture import GaussianMixture
from bokehguide.models.kl import blend_gradient, offset_gradient
from bokehguide.models.native_mixture import CoreGaussians, NativeGaussianMixture
from bokehguide.models.polynomial_offset import PolynomialOffset
from bokehguide.render import dimensions
from bokehguide.runtime import native
from bokehguide.runtime.indexing import Pixels, gather_pixels, scatter

AnyGaussianMixture = GaussianMixture | NativeGaussianMixture


class Gradients(NamedTuple):
    """Gradients of one batch's one-sample KL: blend, for the logits of the pixels' β, `[N]`; offsets, for the polynomials."""

    pixels: Pixels
    blend: Tensor | None
    offsets: Tensor | None


class GaussianGuide(Guide):
    """Mixture of projected Gaussians and the uniform lens.

    A step draws from the state at its start. If a pixel has no candidates at the start of an epoch, the pixel samples the lens
    uniformly until the epoch ends. The lens points of these pixels are stratified over the epoch (see `render/random.py`).

    learns_blend: whether β is learned (Eq. 26). learns_offsets: whether Gaussians are frozen after some fits, and polynomial
    offsets of their means are then learned (Eq. 27 to 29).
    """

    record_buffer: RecordBuffer
    uniform: Tensor

    def __init__(self, context: LensContext, config: GaussianConfig, learns_blend: bool, learns_offsets: bool):
        super().__init__(context)
        self.config, self.learns_blend, self.learns_offsets = config, learns_blend, learns_offsets
        pixels, device = self.camera.width * self.camera.height, self.camera.position.device
        self.blend = BlendWeightMap(pixels, config.blend)
        self.record_buffer = RecordBuffer(self.camera, self.ranks)
        self.offsets: PolynomialOffset | None = None
        self._core_field: tuple[PolynomialOffset | None, CoreGaussians] | None = None
        self.register_buffer("uniform", torch.zeros(pixels, dtype=torch.bool))
        """Pixels that stay uniform until the epoch ends, bool `[pixels]`."""
        self.to(device)
        self.epoch = self.epoch.cpu()
        self.optimizers["blend"] = torch.optim.Adam([self.blend.logit], lr=config.blend_rate, fused=True)

    @torch.no_grad()
    def query(self, batch: PixelBatch) -> LensQuery:
        """The mixture of a batch, or the uniform lens in the first step."""
        if batch.step == 1:
            return UniformQuery(self.camera.lens, batch.focus, batch.random.uniform(dimensions.LENS, 2))
        uniforms = batch.random.uniform(dimensions.LENS, dimensions.LENS_COUNT)  # independent, as learning uses the lens points
        self._stratify_uniform(batch, uniforms)
        if self.candidates is None:
            return UniformQuery(self.camera.lens, batch.focus, uniforms[2:4])
        start, gaussian = self.candidates.batch(batch.pixels)
        if len(gaussian) == 0:
            return UniformQuery(self.camera.lens, batch.focus, uniforms[2:4])
        return MixtureQuery(self.mixture(batch.pixels, batch.raster, batch.focus, start, gaussian), uniforms, gaussian)

    @torch.no_grad()
    def mixture(self, pixels: Pixels, raster: Tensor, focus: Tensor, start: Tensor, gaussian: Tensor) -> AnyGaussianMixture:
        """The mixture of N pixels at raster positions `[2, N]`; start, gaussian: candidates (see `CandidateList.batch`)."""
        lens, beta, core = self.camera.lens, self.blend(pixels), native.core_on(focus.device)
        if core is not None:
            return NativeGaussianMixture(lens, focus, beta, start, self._field_of(core), gaussian, raster)
        weight = self.field.lens_weights(lens.focus_distance)
        mean, sigma = self.field.mean.index_select(1, gaussian), self.field.sigma.index_select(0, gaussian)
        if self.offsets is not None:
            mean = mean + self.offsets(gaussian, raster.index_select(1, owners(start, len(gaussian))))
        return GaussianMixture(lens, focus, beta, start, mean, sigma, weight.index_select(0, gaussian))

    def _field_of(self, core: ModuleType) -> CoreGaussians:
        """The field in the native core, made for the first batch after a change."""
        made = self._core_field
        if made is None or made[0] is not self.offsets:
            weight = self.field.lens_weights(self.camera.lens.focus_distance)
            made = self._core_field = (self.offsets, CoreGaussians.of(core, self.field, weight, self.offsets))
        return made[1]

    def _stratify_uniform(self, batch: PixelBatch, uniforms: Tensor) -> None:
        """Replace two of the uniform numbers `[5, N]` by stratified numbers, in pixels that stay uniform until the epoch ends."""
        batch.random.stratify(uniforms[2:4], gather_pixels(self.uniform, batch.pixels), dimensions.LENS, int(self.epoch))

    @torch.no_grad()
    def learn_from(self, samples: BatchSamples, query: MixtureQuery[AnyGaussianMixture], ratio: Tensor) -> Gradients:
        """Gradients of the one-sample KL (Eq. 25) for one sample per pixel."""
        batch, at = samples.batch, samples.drawn.at
        assert at is not None
        blend = blend_gradient(query.mixture, ratio, at) if self.learns_blend else None
        return Gradients(batch.pixels, blend, self._offset_gradient(query, batch.raster, ratio, at))

    def _offset_gradient(
        self, query: MixtureQuery[AnyGaussianMixture], raster: Tensor, ratio: Tensor, at: LensDensity
    ) -> Tensor | None:
        mixture = query.mixture
        if self.offsets is None:
            return None
        if isinstance(mixture, NativeGaussianMixture):
            return mixture.offset_gradient(ratio, at)
        return offset_gradient(mixture, self.offsets, query.component, raster, ratio, at)

    def accumulate(self, records: Sequence[GuideRecord], summary: StepSummary) -> None:
        self.record_buffer.add([record.records for record in records], summary.threads)
        self._gradients: list[Gradients] = learned_of(records)

    def update(self, summary: StepSummary) -> None:
        """End a step: take one Adam step, and fit the Gaussians again unless they are frozen. Collective."""
        if self.learns_blend and self.ranks.any(bool(self._gradients))[0]:
            self.blend.logit.grad = torch.zeros_like(self.blend.logit)
            for gradients in self._gradients:
                assert gradients.blend is not None
                scatter(self.blend.logit.grad, gradients.pixels, gradients.blend)
            self.optimizers["blend"].step()
            self.optimizers["blend"].zero_grad()
        if self.offsets is None:
            self._fit(summary)
        else:
            found = [gradients.offsets for gradients in self._gradients if gradients.offsets is not None]
            none = torch.zeros_like(self.offsets.coefficients, dtype=torch.float64)
            self.offsets.coefficients.grad = self.ranks.total(sum(found, none)).float()
            self.optimizers["offsets"].step()
        self._gradients = []

    def _fit(self, summary: StepSummary) -> None:
        if summary.ends_epoch:
            self.uniform.zero_()
        self.refit(summary.mean_luminance)
        if not summary.ends_epoch:
            return
        if self.learns_offsets and summary.step >= self.config.fits and len(self.field):
            self.freeze()
        # Pixels without candidates stay uniform, and their lens points are stratified over the epoch that begins.
        self.epoch.fill_(summary.step + 1)
        self.uniform.fill_(True)
        if self.candidates is not None:
            self.uniform.copy_(self.candidates.counts() == 0)

    @torch.no_grad()
    def refit(self, mean_luminance: float) -> None:
        """Fit the field to the record and list each pixel's candidates; collective."""
        self.record_buffer.merge()
        self.highlight_cells = fit_gaussians(self.field, self.record_buffer, self.camera, mean_luminance, self.config)
        self.set_candidates()

    def set_candidates(self, slack: float = 0.0) -> None:
        """List the candidates of the pixels that do not stay uniform. Call this method after each change of the field."""
        self._core_field = None
        self.candidates = draw_candidates(self.field, self.camera, slack, self.uniform) if len(self.field) else None

    def freeze(self) -> None:
        """Stop the fits, and start to learn polynomial offsets."""
        self.offsets = PolynomialOffset(self.field, self.camera, self.config.offset_degree)
        self.optimizers["offsets"] = torch.optim.Adam(self.offsets.parameters(), lr=self.config.offset_rate)
        self.set_candidates(self.config.offset_slack)

    def merge(self) -> None:
        self.record_buffer.merge()

    def load_state_dict(self, state_dict, *args, **kwargs):
        """Load Gaussians, β and the record, and the offsets of a frozen guide. Then list each pixel's candidates.

        Adam's moments are not part of this state. Load the states of `optimizers` afterwards.
        """
        field = {name.removeprefix("field."): value for name, value in state_dict.items() if name.startswith("field.")}
        self.field.load_state_dict(field)
        self.uniform.copy_(state_dict["uniform"])
        self.highlight_cells = torch.empty_like(state_dict["highlight_cells"], device=self.uniform.device)
        self.offsets = None
        self.optimizers.pop("offsets", None)
        self.set_candidates()
        if "offsets.coefficients" in state_dict:
            self.freeze()
        return super().load_state_dict(state_dict, *args, **kwargs)

    def blend_weights(self) -> Tensor:
        return self.blend().detach()
