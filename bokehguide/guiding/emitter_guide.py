"""The lens sampler of the mode `guided`, which knows the scene's emitters and finds other highlights during the render.

Differences from the paper's guide (`gaussian_guide.py`), each measured to reduce the error:

- The field initially contains the scene's emitters: connected emissive triangles, peaks of the environment map, and suns. The
  record of primary hits finds their reflections and refractions. The record places light from mirrors and glass at its virtual
  image, and separates highlights at different depths.
- A component of the mixture is an ellipse of constant density on the lens, not a Gaussian. The ellipse is clipped near the lens.
  Parallelograms and emitters of the environment map have exact densities.
- Learning takes place at the ends of epochs. An epoch is a range of steps whose length is a power of two. No distribution changes
  within an epoch, so lens points are stratified over the epoch.
- Each tile of the frame learns a success rate for each emitter.
- Paths split after the primary hit in proportion to the weight of the lens point.
- β minimises the variance, given second moments averaged over neighbouring pixels.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from types import ModuleType
from typing import NamedTuple, cast

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.emitter_proposals import emitter_proposals
from bokehguide.guiding.guide import Guide, GuideRecord, finite, learned_of
from bokehguide.guiding.highlight_fitting import fit_ellipsoids
from bokehguide.guiding.inheritance import Learned, moved
from bokehguide.guiding.layered_record import VoxelRecord
from bokehguide.guiding.lens_queries import MixtureQuery, UniformQuery
from bokehguide.guiding.protocols import BatchSamples, LensPoints, LensQuery, ModeContext, PixelBatch, StepSummary
from bokehguide.guiding.success_rates import SuccessRates
from bokehguide.guiding.virtual_images import HighlightImages
from bokehguide.models.candidates import draw_candidates
from bokehguide.models.ellipse_mixture import EllipseMixture
from bokehguide.models.native_mixture import CoreField, NativeEllipseMixture
from bokehguide.render import dimensions
from bokehguide.render.observer import PathObserver
from bokehguide.render.path_tracer import PathSamples
from bokehguide.render.splitting import SplitPaths
from bokehguide.render.vector import luminance
from bokehguide.runtime import native
from bokehguide.runtime.indexing import ActiveEntries, Pixels, core_pixels, gather_pixels, scatter_add

MAX_RATIO = 1e18
"""Contributions in learning are clamped to this value, so that their squares stay finite in single precision."""
PRIOR_MOMENT = 1e-3
"""Initial second moment of either part of the mixture, over the squared mean luminance of the frame."""


AnyEllipseMixture = EllipseMixture | NativeEllipseMixture


class DrawnEmitters(NamedTuple):
    """Draws of a batch: slots `[K]` of the emitters, and squares `[K]` of contribution over expected contribution."""

    slots: Tensor
    squared: Tensor


class EmitterGuide(Guide):
    """Mixture of emitters, found highlights and the uniform lens. All steps of an epoch draw from the state at its start.

    moments: Σ β² f² p / q³ of the proposals and Σ (1 - β)² f² u / q³ of the uniform part, `[2, pixels]`. f is the radiance. p and
    u are the densities of the two parts, and q is the density of the mixture. At the β of least variance, β / (1 - β) is the
    square root of the ratio of both moments. If ellipses are small against the lens, the moments do not depend on the β of the
    draws.
    """

    inherits = True
    record_buffer: VoxelRecord
    beta: Tensor
    moments: Tensor
    outlines: Tensor
    unit: Tensor

    def __init__(self, context: ModeContext, config: GuidedConfig):
        super().__init__(context)
        self.config = config
        pixels, device = self.camera.width * self.camera.height, self.camera.position.device
        self.record_buffer = VoxelRecord(self.camera, self.ranks, config.depth_layers)
        self.register_buffer("beta", torch.full((pixels,), config.first_blend))
        self.register_buffer("moments", torch.zeros(2, pixels))
        self.register_buffer("outlines", torch.zeros(6, 0))
        """Squared half axes of the field's ellipsoids (see `EllipseMixture`), `[6, G]`."""
        self.to(device)
        self.epoch = self.epoch.cpu()
        self._owned = context.owned.to(device)
        self._proposals = emitter_proposals(context.scene, context.tracer.emitters, self.camera, config)
        self.success_rates = SuccessRates(self.camera, len(self._proposals.field), self.ranks)
        self.register_buffer("unit", torch.tensor(1.0))
        """Unit of luminance for the success rates: the approximate mean luminance of the frame."""
        self.paths_per_sample = config.split_count
        self._tracer = context.tracer
        self.refit(1.0)

    @torch.no_grad()
    def query(self, batch: PixelBatch) -> LensQuery:
        # The first two dimensions of a Sobol' sequence are the most even, and choose the lens point.
        first = int(self.epoch) if self.config.stratify else batch.step
        shared = batch.grouped_random if self.config.stratify else None
        uniforms = (shared or batch.random).stratified(dimensions.LENS, 3, first).roll(1, 0)
        if self.candidates is None:
            return UniformQuery(self.camera.lens, batch.focus, uniforms[1:3])
        start, component = self.candidates.batch(batch.pixels)
        if len(component) == 0:
            return UniformQuery(self.camera.lens, batch.focus, uniforms[1:3])
        slots, rates = self.success_rates.of_candidates(batch.pixels, start, component)
        return MixtureQuery(self._mixture(batch, start, component, rates), uniforms, component, slots)

    def _mixture(self, batch: PixelBatch, start: Tensor, component: Tensor, scale: Tensor) -> AnyEllipseMixture:
        lens, focus, clips = self.camera.lens, batch.focus, self.config.clip_to_lens
        beta = gather_pixels(self.beta, batch.pixels)
        if self._core_field is not None:
            return NativeEllipseMixture(lens, focus, beta, start, self._core_field, component, scale, clips)
        mean, outline = self.field.mean.index_select(1, component), self.outlines.index_select(1, component)
        weight = self.field.lens_weights(lens.focus_distance).index_select(0, component)
        environment, parallelogram = (number.index_select(0, component) for number in self._numbers)
        shapes = self._proposals.shapes._replace(environment_index=environment, parallelogram_index=parallelogram)
        return EllipseMixture(lens, focus, beta, start, mean, outline, weight, scale, shapes, clips)

    def initial_queries(self, batch: PixelBatch) -> Iterable[LensQuery]:
        """One uniform query before the first step, because the weights of the first step may differ from 1."""
        if batch.step > 1 or self.candidates is None:
            return ()
        return (UniformQuery(self.camera.lens, batch.focus, batch.random.uniform(dimensions.INITIAL_LENS, 2)),)

    def is_independent(self, step: int) -> bool:
        """Whether the step starts an epoch: within an epoch, stratified weights depend on earlier steps."""
        return step == int(self.epoch)

    def splitting(self, weight: Tensor) -> SplitPaths:
        """Path counts in proportion to the weight of the lens point (Vorba and Křivánek 2016)."""
        return SplitPaths((self.config.split_count * weight).round().clamp(1, self.config.max_split_count))

    def observers(self, batch: PixelBatch) -> Sequence[PathObserver]:
        if not self.config.virtual_images:
            return ()
        # The frame's mean luminance is unknown in the first step, so that all light may come from highlights.
        threshold = 0.5 * self.config.highlights.radiance_threshold * batch.mean_luminance * (batch.step > 1)
        return (HighlightImages(self._tracer.geometry, batch.focus.shape[1], threshold),)

    def recorded_distance(self, samples: BatchSamples) -> Tensor:
        """Distance of the virtual image, `[N]`, if the mode observes virtual images; else of the primary hit."""
        if not samples.lens_observers:
            return super().recorded_distance(samples)
        (images,) = cast(Sequence[HighlightImages], samples.lens_observers)
        return images.distances()

    @torch.no_grad()
    def learn_from(self, samples: BatchSamples, query: MixtureQuery[AnyEllipseMixture], ratio: Tensor) -> DrawnEmitters:
        """Add to the moments of the batch's pixels; returns the contributions of the emitters that were drawn."""
        mixture, slots_of, at, candidate = query.mixture, query.slots, samples.drawn.at, samples.drawn.candidate
        assert slots_of is not None and at is not None and candidate is not None
        core = native.core()
        if core is not None and isinstance(mixture, NativeEllipseMixture):
            return self._learn_by_core(core, samples.batch.pixels, mixture, samples.drawn, slots_of, ratio)
        scatter_add(self.moments, samples.batch.pixels, _moments(mixture.beta, at.mixture, at.density, ratio))
        drawn = ActiveEntries(candidate >= 0)
        chosen = drawn.select(candidate).clamp(min=0)
        slots = drawn.masked(slots_of.index_select(0, chosen), 0)
        share = drawn.select(mixture.beta) * mixture.weight.index_select(0, chosen)
        expected = mixture.expected_contribution.index_select(0, chosen) * math.pi / (mixture.lens.area * self.unit)
        contribution = drawn.select(ratio) * share / expected
        return DrawnEmitters(slots, contribution.nan_to_num(0.0, MAX_RATIO).clamp(max=MAX_RATIO).square())

    def _learn_by_core(
        self, core: ModuleType, pixels: Pixels, mixture: NativeEllipseMixture, drawn: LensPoints, slots: Tensor, ratio: Tensor
    ) -> DrawnEmitters:
        """`learn_from` by the native core."""
        assert drawn.at is not None and drawn.candidate is not None
        first, numbers = core_pixels(pixels)
        draws = {"beta": mixture.beta, "mixture": drawn.at.mixture, "density": drawn.at.density, "ratio": ratio}
        draws |= {"candidate": drawn.candidate, "weight": mixture.weight, "slots": slots}
        draws["contribution"] = mixture.expected_contribution
        of_draws, squares = torch.empty(len(ratio), dtype=torch.int32), torch.empty(len(ratio))
        area = mixture.lens.area * float(self.unit)
        found = core.learn_emitters(self.moments, first, numbers, draws, area, MAX_RATIO, of_draws, squares)
        return DrawnEmitters(of_draws[:found], squares[:found])

    def recorded_light(self, paths: PathSamples, good: Tensor) -> Tensor:
        """See `Guide`: without the light that comes directly from emitters with proposals."""
        core, known = native.core_on(good.device), self._proposals.triangles
        if core is not None:
            light = torch.empty(len(good))
            emission = paths.emission.contiguous(), paths.triangle, known, self._proposals.whole_environment
            core.recorded_light(paths.radiance.contiguous(), good, *emission, light)
            return light
        hit = paths.triangle >= 0
        known = known[paths.triangle.clamp(min=0).long()] & hit
        light = luminance(paths.radiance - paths.emission * known)
        return finite(light * hit if self._proposals.whole_environment else light, good)

    def accumulate(self, records: Sequence[GuideRecord], summary: StepSummary) -> None:
        threshold = self.config.highlights.radiance_threshold * summary.mean_luminance
        self.record_buffer.add([record.records for record in records], threshold, summary.threads)
        self.success_rates.add(learned_of(records), summary.threads)

    @torch.no_grad()
    def update(self, summary: StepSummary) -> None:
        """End a step. If the step ends an epoch, fit the field to the record and compute β of every pixel. Collective."""
        if not summary.ends_epoch:
            self.record_buffer.end_step()
            return
        mean_luminance = max(summary.mean_luminance, 1e-15)
        self.epoch.fill_(summary.step + 1)
        if self.config.learn_success_rates:
            self.success_rates.update()
        self.unit.fill_(mean_luminance)
        if summary.step == 1:  # its samples precede the frame's mean luminance, the unit of later moments
            self.moments /= mean_luminance**2
        self.refit(summary.mean_luminance)
        self.beta.copy_(self._least_variance_blend())

    @torch.no_grad()
    def inherit(self, learned: Learned, name: str) -> None:
        """See `Strategy`. Highlights move with the camera; success rates, which belong to tiles, stay with the view alone."""
        state, mean_luminance = learned.state[name], max(learned.mean_luminance, 1e-15)
        self.record_buffer.inherit(learned, *(state[f"record_buffer.{each}"] for each in ("sums", "voxels", "waiting")))
        moments = state["moments"]
        if learned.same_view(self.camera):
            self.success_rates.sums.copy_(learned.share * state["success_rates.sums"])
            self.success_rates.update()
        else:
            moments = moved(moments, learned.pixels(self.camera))
        self.refit(mean_luminance)
        self.moments.copy_(learned.share * moments)
        self.beta.copy_(self._least_variance_blend())
        self.moments *= mean_luminance**2  # the unit of luminance in the first step is 1

    def _least_variance_blend(self) -> Tensor:
        squares = self.ranks.total(self.moments).reshape(2, 1, self.camera.height, self.camera.width)
        pool = self.config.blend_pool
        pooled = avg_pool2d(squares, pool, 1, pool // 2, count_include_pad=False).reshape(2, -1)
        ellipses, uniform = (pooled + PRIOR_MOMENT).sqrt()
        return (ellipses / (ellipses + uniform)).clamp(self.config.min_blend, self.config.max_blend)

    @torch.no_grad()
    def refit(self, mean_luminance: float) -> None:
        """Fill the field with the scene's emitters and the record's highlights, and list each pixel's candidates. Collective."""
        self.record_buffer.merge_voxels()
        self.highlight_cells, *found = fit_ellipsoids(self.record_buffer, self.camera, mean_luminance, self.config)
        field = self._proposals.field
        known = (field.mean, self._proposals.outlines, field.radius, field.energy)
        mean, self.outlines, radius, energy = (torch.cat(part, dim=-1) for part in zip(known, found))
        if len(radius) == len(self.field) == len(field) > 0:
            return
        self.field.assign(mean, radius, radius, energy)  # σ is the largest half axis of an ellipsoid
        self.set_candidates()

    def set_candidates(self) -> None:
        """List each pixel's candidates. Call this method after each change of the field."""
        shapes, found = self._proposals.shapes, len(self.field) - len(self._proposals.field)
        self._numbers = pad(torch.stack((shapes.environment_index, shapes.parallelogram_index)), (0, found), value=-1)
        """Number of each component among the map's emitters and among the parallelograms, -1 for none, int64 `[2, G]`."""
        self._core_field: CoreField | None = None
        core = native.core_on(self.beta.device)
        if core is not None and len(self.field):
            environment, parallelogram = self._numbers
            numbered = shapes._replace(environment_index=environment, parallelogram_index=parallelogram)
            weight = self.field.lens_weights(self.camera.lens.focus_distance)
            self._core_field = CoreField.of(core, self.field.mean, self.outlines, weight, numbered)
        slack = self.config.candidate_slack
        self.candidates = draw_candidates(self.field, self.camera, slack) if len(self.field) else None

    def blend_weights(self) -> Tensor:
        return self.beta

    def merge(self) -> None:
        self.record_buffer.merge()
        self.success_rates.merge()

    def load_state_dict(self, state_dict, *args, **kwargs):
        """Load the learned state and the field, and list each pixel's candidates.

        Raises ValueError for a state that no render can have.
        """
        for name in ("highlight_cells", "outlines"):  # the sizes depend on the fit
            setattr(self, name, torch.empty_like(state_dict[name], device=self.beta.device))
        result = super().load_state_dict(state_dict, *args, **kwargs)
        if not self.ranks.alone:  # each rank adds up the moments of its own pixels
            self.moments *= self._owned
        rates = self.success_rates
        positive = bool((rates.sums >= 0.0).all() and (rates.rates > 0.0).all() and self.unit > 0.0)
        if not positive or self.outlines.shape[1] != len(self.field) or not bool(self.outlines.isfinite().all()):
            raise ValueError("success rates or outlines that no render has")
        self.set_candidates()
        return result


def _moments(beta: Tensor, ellipses: Tensor, density: Tensor, ratio: Tensor) -> Tensor:
    """Summands of `EmitterGuide.moments`, `[2, N]`; ellipses, density: densities of the proposals and of the mixture."""
    share = beta * ellipses / density.clamp(min=1e-37)
    squared = ratio.clamp(max=MAX_RATIO) * ratio.clamp(max=MAX_RATIO) * (beta > 0.0)  # other pixels have no β to learn
    return torch.stack((squared * share * beta, squared * (1.0 - share) * (1.0 - beta)))
