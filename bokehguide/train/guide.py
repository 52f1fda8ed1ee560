"""The lens guide: the modules, what they learn from a step, and when (sections 4.2, 5 and 6.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from bokehguide.models.blend_weight import BlendWeightMap
from bokehguide.models.candidates import CandidateList, draw_candidates
from bokehguide.models.gaussian_field import GaussianField
from bokehguide.models.kl import blend_gradient, offset_gradient, one_sample_kl
from bokehguide.models.lens_distribution import GuidedLensDistribution, LensDensity, LensMixture, owners
from bokehguide.models.polynomial_offset import PolynomialOffset
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.lens import Lens
from bokehguide.render.path_tracer import PathSamples
from bokehguide.render.pixels import Pixels, put, put_where, take, worthwhile
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import luminance
from bokehguide.train.fitting import fit_gaussians
from bokehguide.train.ranks import Ranks
from bokehguide.train.record_buffer import Raster, RecordBuffer, Records
from bokehguide.train.settings import RenderSettings

FITS = 8
"""With polynomials the field is fitted after steps 1 to 8 and then frozen, or, where nothing was found,
at the end of a later block."""
BLEND_RATE, OFFSET_RATE = 0.1, 0.01
"""Learning rates of β's logit and of the polynomial coefficients (section 6.1)."""
LENS_DIMENSION = 2
"""Random dimensions of a lens point: from this one on five."""
OFFSET_SLACK = 2.0
"""Pixels up to 2σ beyond a frozen Gaussian's disc keep it as a candidate: its mean may move."""


def starts_block(step: int) -> bool:
    """Whether a block of steps begins: 1, 2, 3, 5, 9, 17, … so that their lengths are powers of two."""
    return step == 1 or (step - 1) & (step - 2) == 0


@dataclass
class GuidedBatch:
    """The lens distribution of a batch of pixels, and what it was made of.

    gaussian: of each candidate, `[M]`, where somebody asks; slots: where its draws are learnt about (see `LampYield`), `[M]`.
    """

    pixels: Pixels
    raster: Tensor
    distribution: LensMixture
    gaussian: Tensor | None = None
    slots: Tensor | None = None


@dataclass
class BatchLesson:
    """What one batch teaches: its loss, and the gradients of its pixels' β and of the polynomial coefficients, or what
    `LampYield.add` takes."""

    kl: Tensor
    pixels: Pixels
    blend_gradient: Tensor | None = None
    offset_gradient: Tensor | None = None
    draws: tuple[Tensor, Tensor] | None = None


class LensDraw(NamedTuple):
    """One lens point for each of N pixels.

    points: `[2, N]`; weight: W/q of Eq. 11, 0 for a draw that does not pass, `[N]`; what they
    were drawn from and its density there, None where all are uniform.
    """

    points: Tensor
    weight: Tensor
    batch: GuidedBatch | None = None
    at: LensDensity | None = None


def uniform_draw(lens: Lens, focus: Tensor, uniforms: Tensor) -> LensDraw:
    """Lens points of the density W/A for focus points `[3, N]`, from uniform numbers `[2, N]`."""
    points = lens.sample(uniforms)
    return LensDraw(points, lens.unblocked(points, focus))


def guided_draw(lens: Lens, focus: Tensor, batch: GuidedBatch, uniforms: Tensor) -> LensDraw:
    """Lens points of the batch's distribution, from as many uniform numbers as it takes.

    Those of pixels without candidates are, to the bit, as `uniform_draw` has them.
    """
    points = batch.distribution.sample(uniforms)
    at, unblocked = batch.distribution.evaluate(points), lens.unblocked(points, focus)
    weight = lens.transmission(points) * unblocked / (lens.area * at.density).clamp(min=1e-20)  # W of Eq. 6
    return LensDraw(points, torch.where(batch.distribution.guided, weight, unblocked), batch, at)


class LensGuide(nn.Module):
    """Learns, step by step, where on the lens each pixel should look.

    `draw` and `study` work on batches of pixels, side by side; `update` ends a
    step. What a step draws from depends on earlier steps only; a pixel without candidates
    at the start of a block of steps stays uniform until it ends, so that its lens points may
    be stratified over the block (see `render/random.py`).
    """

    def __init__(self, camera: ThinLensCamera, settings: RenderSettings, ranks: Ranks | None = None):
        super().__init__()
        self.camera, self.ranks = camera, ranks or Ranks()
        self.learns_blend = settings.mode in ("lis-b", "lis-o")
        self.learns_offsets = settings.mode == "lis-o"
        self.field = GaussianField()
        self.blend = BlendWeightMap(camera.width * camera.height)
        self.record = RecordBuffer(camera, self.ranks)
        self.offsets: PolynomialOffset | None = None
        self.to(settings.device)
        self.register_buffer("held", torch.zeros(camera.width * camera.height, dtype=torch.bool, device=settings.device))
        """Pixels that stay uniform until their block of steps ends, whatever is found meanwhile, bool `[pixels]`."""
        self.register_buffer("block", torch.tensor(1))  # on the host, which asks for it
        """First step of that block."""
        self.register_buffer("spotlights", torch.zeros(0, dtype=torch.int64, device=settings.device))
        self.candidates: CandidateList | None = None
        self.optimizers = {"blend": torch.optim.Adam([self.blend.logit], lr=BLEND_RATE, fused=True)}

    @torch.no_grad()
    def draw(self, step: int, pixels: Pixels, raster: Tensor, focus: Tensor, random: PixelRandom) -> LensDraw:
        """Lens points for N pixels at raster positions `[2, N]`; uniform in the first step."""
        lens = self.camera.lens
        if step == 1:
            return uniform_draw(lens, focus, random.uniform(LENS_DIMENSION, 2))
        uniforms = random.uniform(LENS_DIMENSION, 5)  # independent: what a lens point is used for is learnt
        self.stratify(pixels, random, uniforms)
        batch = self.distribution(pixels, raster, focus)
        if batch is None:
            return uniform_draw(lens, focus, uniforms[2:4])
        return guided_draw(lens, focus, batch, uniforms)

    @torch.no_grad()
    def distribution(self, pixels: Pixels, raster: Tensor, focus: Tensor) -> GuidedBatch | None:
        """The mixture for N pixels at raster positions `[2, N]`, None if they have no candidates."""
        if self.candidates is None:
            return None
        start, gaussian = self.candidates.batch(pixels)
        if len(gaussian) == 0:
            return None
        field, lens = self.field, self.camera.lens
        mean = field.mean.index_select(1, gaussian)
        if self.offsets is not None:
            owner = owners(start, len(gaussian))
            mean = mean + self.offsets(gaussian, raster.index_select(1, owner))
        beta = self.blend(pixels)
        weight = field.lens_weights(lens.focus_distance).index_select(0, gaussian)
        mixture = GuidedLensDistribution(lens, focus, beta, start, mean, field.sigma.index_select(0, gaussian), weight)
        return GuidedBatch(pixels, raster, mixture, gaussian)

    @torch.no_grad()
    def study(self, batch: GuidedBatch, ratio: Tensor, at: LensDensity) -> BatchLesson:
        """Gradients of the one-sample KL for one sample a pixel.

        ratio: L / (A q) `[N]`, 0 outside the aperture; at: the densities at the samples.
        """
        mixture = batch.distribution
        of_blend = blend_gradient(mixture, ratio, at) if self.learns_blend else None
        of_offsets = None
        if self.offsets is not None:
            of_offsets = offset_gradient(mixture, self.offsets, batch.gaussian, batch.raster, ratio, at)
        loss = one_sample_kl(ratio, at.density, mixture.lens.area)
        return BatchLesson(loss, batch.pixels, of_blend, of_offsets)

    def is_fresh(self, step: int) -> bool:
        """Whether the weights of a step are independent of the steps before: held pixels all have the weight 1."""
        return True

    def parts(self, weight: Tensor) -> None:
        """Paths never split."""

    def recorded(self, samples: PathSamples) -> Tensor:
        """Luminance `[N]` that the record buffer is told of."""
        return luminance(samples.radiance)

    def apparent_distance(self, samples: PathSamples) -> Tensor:
        """At which distances `[N]` the record buffer takes them to lie: where the first surface is."""
        return samples.distance

    def remember(self, records: Sequence[Records], mean_luminance: float) -> None:
        """Add batches of samples to the record buffer."""
        for batch in records:
            self.record.add(*batch)

    def update(self, step: int, lessons: list[BatchLesson], mean_luminance: float) -> None:
        """End a step: one Adam step, then, while fitting goes on, the next set of Gaussians; collective."""
        if self.learns_blend and self.ranks.any(bool(lessons))[0]:
            self.blend.logit.grad = torch.zeros_like(self.blend.logit)
            for lesson in lessons:
                put(self.blend.logit.grad, lesson.pixels, lesson.blend_gradient)
            self.optimizers["blend"].step()
            self.optimizers["blend"].zero_grad()
        if self.offsets is not None:
            gradients = [lesson.offset_gradient for lesson in lessons if lesson.offset_gradient is not None]
            none = torch.zeros_like(self.offsets.coefficients, dtype=torch.float64)
            self.offsets.coefficients.grad = self.ranks.total(sum(gradients, none)).float()
            self.optimizers["offsets"].step()
        if self.offsets is None:
            opens = starts_block(step + 1)
            if opens:
                self.held.zero_()
            self.refit(mean_luminance)
            if opens and self.learns_offsets and step >= FITS and len(self.field):
                self.freeze()
            if opens:
                self._hold_unguided(step + 1)

    def _hold_unguided(self, step: int) -> None:
        """Begin a block of steps: pixels without candidates stay so, and their lens points are stratified over it."""
        self.block.fill_(step)
        self.held.fill_(True)
        if self.candidates is not None:
            self.held.copy_(self.candidates.counts() == 0)

    def stratify(self, pixels: Pixels, random: PixelRandom, uniforms: Tensor) -> None:
        """Replace, in numbers `[5, N]` for N pixels, those of the held pixels' lens points."""
        held = take(self.held, pixels)
        index = worthwhile(held)
        if len(index) > 0:
            stratified = random.select(index).stratified(LENS_DIMENSION, 2, int(self.block))
            put_where(held.index_select(0, index), uniforms[2:4], index, stratified)

    @torch.no_grad()
    def refit(self, mean_luminance: float) -> None:
        """Fit the field to the record buffer and list each pixel's candidates; collective."""
        self.record.merge()
        self.spotlights = fit_gaussians(self.field, self.record, self.camera, mean_luminance)
        self.set_candidates()

    def set_candidates(self, slack: float = 0.0) -> None:
        """List the candidates of the pixels that are not held; to be called after any change of the field."""
        self.candidates = draw_candidates(self.field, self.camera, slack, self.held) if len(self.field) else None

    def freeze(self) -> None:
        """Keep the Gaussians from now on, and let polynomial offsets learn."""
        self.offsets = PolynomialOffset(self.field, self.camera)
        self.optimizers["offsets"] = torch.optim.Adam(self.offsets.parameters(), lr=OFFSET_RATE)
        self.set_candidates(OFFSET_SLACK)

    def merge(self) -> None:
        """Let every rank know the samples of all; collective."""
        self.record.merge()

    def load_state_dict(self, state_dict, *args, **kwargs):
        """Load Gaussians, β, records and, of a frozen guide, offsets; then list each pixel's candidates.

        Adam's moments are no part of it: `optimizers` have state dicts of their own, to be loaded afterwards.
        """
        field = {name.removeprefix("field."): value for name, value in state_dict.items() if name.startswith("field.")}
        self.field.load_state_dict(field)
        self.held.copy_(state_dict["held"])
        self.spotlights = torch.empty_like(state_dict["spotlights"], device=self.held.device)
        self.offsets = None
        self.optimizers.pop("offsets", None)
        self.set_candidates()
        if "offsets.coefficients" in state_dict:
            self.freeze()
        return super().load_state_dict(state_dict, *args, **kwargs)

    def blend_weights(self) -> Tensor:
        """β of each pixel, `[pixels]`."""
        return self.blend().detach()


def guide_images(
    camera: ThinLensCamera, record: Raster, spotlights: Tensor, beta: Tensor, candidates: CandidateList | None
) -> dict[str, Tensor]:
    """β, record buffer and spotlights as `[H, W, 3]` in 0 … 1; the last two with their margin."""
    beta = beta.reshape(camera.height, camera.width)
    if candidates is not None:
        beta = beta * (candidates.counts() > 0).reshape(beta.shape)
    radiance = record.radiance()
    spots = torch.zeros(record.height * record.width, device=radiance.device)
    spots[spotlights] = 1.0
    bright = radiance / (radiance + radiance.mean().clamp(min=1e-20))
    images = {"beta": beta, "record": bright, "spotlights": spots.reshape(radiance.shape)}
    return {name: image[..., None].expand(-1, -1, 3).float() for name, image in images.items()}
