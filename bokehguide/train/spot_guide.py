"""The guide of mode `guided`: highlights as discs, known before the first ray or found on the way.

It differs from the paper's (`guide.py`) in what is measured to pay:

- The lamps that the scene holds (emissive pieces, peaks of the environment, suns) are in the
  field from the start; the record buffer is left to find what they show up in: reflections
  and refractions. What mirrors and glass show is recorded where its image is, and not where they are, and what lies behind one
  another is kept apart (`voxel_record.py`).
- A highlight is an even disc on the lens and no Gaussian, cut off where the lens ends; one of the map is as bright on the
  lens as the map has it.
- It learns at the ends of blocks of steps only, which grow in powers of two. Within a block
  nothing that decides on a lens point changes, so all lens points are stratified over it.
- How often each lamp is drawn in vain is learnt, tile by tile.
- Rays split where they land, into more paths the more their draws weigh: the uniform part's, which bring what is no
  highlight and are few, count for much.
- Neighbours look at what each other's rays found (`sharing.py`), and the weights of what they see are a control variate
  (`radiance_control.py`).
- β is the one of least variance, from the second moments of what each part of the mixture
  brought, shared among neighbouring pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, pad

from bokehguide.models.candidates import CandidateList, draw_candidates
from bokehguide.models.disc_distribution import DiscLensDistribution, Shapes
from bokehguide.models.gaussian_field import GaussianField
from bokehguide.models.kl import one_sample_kl
from bokehguide.models.lens_distribution import LensDensity, owners
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.kernels import kernel
from bokehguide.render.path_tracer import PathSamples
from bokehguide.render.pixels import Pixels, increase, take, worthwhile
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import luminance
from bokehguide.scene.types import Scene
from bokehguide.train.fitting import RADIANCE_THRESHOLD, fit_ellipsoids
from bokehguide.train.guide import LENS_DIMENSION, BatchLesson, GuidedBatch, LensDraw, guided_draw, starts_block, uniform_draw
from bokehguide.train.known_lamps import known_lamps
from bokehguide.train.lamp_yield import LampYield
from bokehguide.train.ranks import Ranks
from bokehguide.train.record_buffer import Records
from bokehguide.train.voxel_record import VoxelRecord

FIRST_BLEND = 0.65
"""β in the first block."""
LOWEST, HIGHEST = 0.05, 0.9
"""Bounds of β: weights stay below 10, and a lamp that comes into sight is still found."""
POOLED = 5
"""Pixels across the squares whose moments are shared."""
BRIGHTEST = 1e18
"""Above this a sample counts as one of this: its square is still a single-precision number."""
PARTS, MOST_PARTS = 2, 16
"""Paths that go on from the first surface of a draw of weight 1, of others in proportion to their weight, and most of any
draw: the light they find is what is left of the noise, and a lens point, once found, is dear."""
SLACK = 0.1
"""Pixels so many radii beyond a lamp's disc on the raster have it as a candidate: the disc is that of a small ball on the axis."""
PRIOR = 1e-3
"""Second moment that either part of the mixture is taken to have had already, in units of the frame's mean squared."""


class SpotGuide(nn.Module):
    """Learns, block by block, where on the lens each pixel should look.

    `draw` and `study` work on batches of pixels, side by side; `update` ends a step. What a
    block draws from depends on earlier blocks only.

    scene: whose lamps the guide begins with.
    """

    def __init__(self, camera: ThinLensCamera, scene: Scene, ranks: Ranks | None = None):
        super().__init__()
        self.camera, self.ranks = camera, ranks or Ranks()
        pixels, device = camera.width * camera.height, camera.position.device
        self.field = GaussianField()
        self.record = VoxelRecord(camera, self.ranks)
        self.register_buffer("beta", torch.full((pixels,), FIRST_BLEND))
        self.register_buffer("moments", torch.zeros(2, pixels))
        """Σ β² f² p / q³ and Σ (1 - β)² f² u / q³ of the discs and the uniform part: at the β of least variance
        their roots are as β to 1 - β. Of discs small against the lens neither depends on the β that was drawn with."""
        self.to(device)
        self.register_buffer("block", torch.tensor(1))  # on the host, which asks for it
        self.register_buffer("spotlights", torch.zeros(0, dtype=torch.int64, device=device))
        self.register_buffer("outlines", torch.zeros(6, 0, device=device))
        """Of the field's ellipsoids (see `DiscLensDistribution`)."""
        self.optimizers: dict[str, torch.optim.Optimizer] = {}
        self._lamps = known_lamps(scene, camera)
        self.lamp_yield = LampYield(camera, len(self._lamps.field), self.ranks)
        self.register_buffer("unit", torch.tensor(1.0))
        """Luminance that `ratio` counts in, about."""
        self.refit(1.0)

    @torch.no_grad()
    def draw(self, step: int, pixels: Pixels, raster: Tensor, focus: Tensor, random: PixelRandom) -> LensDraw:
        """Lens points for N pixels at raster positions `[2, N]`."""
        lens = self.camera.lens
        # The first two dimensions of a Sobol' sequence are the most even: they are the place.
        uniforms = random.stratified(LENS_DIMENSION, 3, int(self.block)).roll(1, 0)
        mixture = self._mixture(pixels, focus)
        if mixture is None:
            return uniform_draw(lens, focus, uniforms[1:3])
        return guided_draw(lens, focus, GuidedBatch(pixels, raster, *mixture), uniforms)

    def _mixture(self, pixels: Pixels, focus: Tensor) -> tuple[DiscLensDistribution, Tensor, Tensor] | None:
        """The mixture of each pixel, what of the field its candidates are, and their slots; None where none has any."""
        if self.candidates is None:
            return None
        start, spot = self.candidates.batch(pixels)
        if len(spot) == 0:
            return None
        field, lens = self.field, self.camera.lens
        mean, outline = field.mean.index_select(1, spot), self.outlines.index_select(1, spot)
        weight = field.lens_weights(lens.focus_distance).index_select(0, spot)
        known, shapes = self._lamps.shapes, None
        if known.sky is not None or known.panels is not None:
            sky_lamp, panel = self._numbers.index_select(1, spot)
            shapes = Shapes(known.sky, sky_lamp, known.panels, panel, known.light)
        slots = self.lamp_yield.slots(pixels, owners(start, len(spot)), spot)
        factor = self.lamp_yield.factor(slots)
        beta = take(self.beta, pixels)
        return DiscLensDistribution(lens, focus, beta, start, mean, outline, weight, factor, shapes), spot, slots

    @torch.no_grad()
    def study(self, batch: GuidedBatch, ratio: Tensor, at: LensDensity) -> BatchLesson:
        """Add to the moments of the batch's pixels; ratio: L / (A q) `[N]`, 0 outside the aperture."""
        mixture, pixels = batch.distribution, batch.pixels
        increase(self.moments, pixels, _moments(mixture.beta, at.mixture, at.density, ratio))
        draws = self._draws(batch, ratio)
        return BatchLesson(one_sample_kl(ratio, at.density, mixture.lens.area), pixels, draws=draws)

    def _draws(self, batch: GuidedBatch, ratio: Tensor) -> tuple[Tensor, Tensor]:
        """Slots of the lamps that were drawn, and the squares of what the draws brought over what they might have."""
        mixture = batch.distribution
        drawn = mixture.chosen >= 0
        index = worthwhile(drawn)
        chosen = mixture.chosen.index_select(0, index).clamp(min=0)
        slots = torch.where(drawn.index_select(0, index), batch.slots.index_select(0, chosen), 0)
        share = mixture.beta.index_select(0, index) * mixture.weight.index_select(0, chosen)
        might = mixture.bright.index_select(0, chosen) * math.pi / (mixture.lens.area * self.unit)
        brought = ratio.index_select(0, index) * share / might
        return slots, brought.nan_to_num(0.0, BRIGHTEST).clamp(max=BRIGHTEST).square()

    def is_fresh(self, step: int) -> bool:
        """Whether the weights of a step are independent of the steps before: at the start of a block."""
        return step == int(self.block)

    def parts(self, weight: Tensor) -> Tensor:
        """Into how many paths rays of these weights `[N]` split at their first surfaces, whole numbers (Vorba and Křivánek 2016)."""
        return (PARTS * weight).round().clamp(1, MOST_PARTS)

    def recorded(self, samples: PathSamples) -> Tensor:
        """Luminance `[N]` for the record buffer: all but what the field's lamps send straight into the lens."""
        hit = samples.triangle >= 0
        known = self._lamps.triangles[samples.triangle.clamp(min=0).long()] & hit
        light = _luminance_beside(samples.radiance, samples.emission, known)
        return light * hit if self._lamps.whole_sky else light

    def apparent_distance(self, samples: PathSamples) -> Tensor:
        """At which distances `[N]` the record buffer takes them to lie: lamps in mirrors and glass where their images are."""
        return samples.distance if samples.image is None else samples.image

    def remember(self, records: Sequence[Records], mean_luminance: float) -> None:
        """Add batches of samples to the record buffer."""
        self.record.add(records, RADIANCE_THRESHOLD * mean_luminance)

    @torch.no_grad()
    def update(self, step: int, lessons: list[BatchLesson], mean_luminance: float) -> None:
        """End a step: where a block ends with it, fit the field to the record buffer and set every β; collective."""
        for lesson in lessons:
            self.lamp_yield.add(*lesson.draws)
        if not starts_block(step + 1):
            self.record.end_step()
            return
        self.block.fill_(step + 1)
        self.lamp_yield.update()
        self.unit.fill_(max(mean_luminance, 1e-15))
        if step == 1:  # studied before the frame's mean, the unit of all later moments, was known
            self.moments /= max(mean_luminance, 1e-15) ** 2
        self.refit(mean_luminance)
        squares = self.ranks.total(self.moments).reshape(2, 1, self.camera.height, self.camera.width)
        pooled = avg_pool2d(squares, POOLED, 1, POOLED // 2, count_include_pad=False).reshape(2, -1)
        discs, uniform = (pooled + PRIOR).sqrt()
        self.beta.copy_((discs / (discs + uniform)).clamp(LOWEST, HIGHEST))

    @torch.no_grad()
    def refit(self, mean_luminance: float) -> None:
        """The lamps, and what the record buffer shows beside them; then list each pixel's candidates. Collective."""
        self.record.settle()
        self.spotlights, *found = fit_ellipsoids(self.record, self.camera, mean_luminance)
        lamps = (self._lamps.field.mean, self._lamps.outlines, self._lamps.field.radius, self._lamps.field.energy)
        mean, self.outlines, radius, energy = (torch.cat(part, dim=-1) for part in zip(lamps, found))
        if len(radius) == len(self.field) == len(self._lamps.field) > 0:
            return
        self.field.assign(mean, radius, radius, energy)  # σ stands for a disc's radius
        self.set_candidates()

    def set_candidates(self) -> None:
        """List each pixel's candidates; to be called after any change of the field."""
        shapes, found = self._lamps.shapes, len(self.field) - len(self._lamps.field)
        self._numbers = pad(torch.stack((shapes.sky_lamp, shapes.panel)), (0, found), value=-1)
        """Which lamp of the map, and which panel, each of the field is, -1 for none, `[2, G]`."""
        self.candidates: CandidateList | None = draw_candidates(self.field, self.camera, SLACK) if len(self.field) else None

    def blend_weights(self) -> Tensor:
        """β of each pixel, `[pixels]`."""
        return self.beta

    def merge(self) -> None:
        """Let every rank know the samples of all; collective."""
        self.record.merge()
        self.lamp_yield.merge()

    def load_state_dict(self, state_dict, *args, **kwargs):
        """Load all that is learnt, and the field; then list each pixel's candidates. Raises ValueError where draws are none."""
        for name in ("spotlights", "outlines"):  # a fit decides how many there are
            setattr(self, name, torch.empty_like(state_dict[name], device=self.beta.device))
        result = super().load_state_dict(state_dict, *args, **kwargs)
        positive = bool((self.lamp_yield.sums >= 0.0).all() and (self.lamp_yield.learnt > 0.0).all() and self.unit > 0.0)
        if not positive or self.outlines.shape[1] != len(self.field) or not bool(self.outlines.isfinite().all()):
            raise ValueError("what was learnt of draws is none")
        self.set_candidates()
        return result


@kernel
def _luminance_beside(radiance: Tensor, emission: Tensor, known: Tensor) -> Tensor:
    """Luminance `[N]` of radiance `[3, N]` without the emission that is `known`, bool `[N]`."""
    return luminance(radiance - emission * known)


@kernel
def _moments(beta: Tensor, of_discs: Tensor, density: Tensor, ratio: Tensor) -> Tensor:
    """What samples add to `SpotGuide.moments`, `[2, N]`; of_discs, density: of the lens points, by the discs and in all."""
    share = beta * of_discs / density.clamp(min=1e-37)
    squared = ratio.clamp(max=BRIGHTEST) * ratio.clamp(max=BRIGHTEST) * (beta > 0.0)  # the others have no β to tell of
    return torch.stack((squared * share * beta, squared * (1.0 - share) * (1.0 - beta)))
