"""The guide of mode `guided`: highlights as discs, known before the first ray or found on the way.

It differs from the paper's (`guide.py`) in what is measured to pay:

- The lamps that the scene holds (emissive pieces, peaks of the environment, suns) are in the
  field from the start; the record buffer is left to find what they show up in: reflections
  and refractions.
- A highlight is an even disc on the lens and no Gaussian.
- It learns at the ends of blocks of steps only, which grow in powers of two. Within a block
  nothing that decides on a lens point changes, so all lens points are stratified over it.
- β is the one of least variance, from the second moments of what each part of the mixture
  brought, shared among neighbouring pixels.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from bokehguide.models.candidates import CandidateList, draw_candidates
from bokehguide.models.disc_distribution import DiscLensDistribution, balls, packed
from bokehguide.models.gaussian_field import GaussianField
from bokehguide.models.kl import one_sample_kl
from bokehguide.models.lens_distribution import LensDensity
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.path_tracer import PathSamples
from bokehguide.render.pixels import Pixels, increase, take
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import luminance
from bokehguide.scene.lamps import find_lamps
from bokehguide.scene.types import Scene
from bokehguide.train.fitting import fit_gaussians
from bokehguide.train.guide import LENS_DIMENSION, BatchLesson, GuidedBatch, LensDraw, guided_draw, starts_block, uniform_draw
from bokehguide.train.ranks import Ranks
from bokehguide.train.record_buffer import FAR, RecordBuffer

FIRST_BLEND = 0.65
"""β in the first block."""
LOWEST, HIGHEST = 0.05, 0.9
"""Bounds of β: weights stay below 10, and a lamp that comes into sight is still found."""
REACH = 1.1
"""Radius of a lamp's disc by its extent: what misses the disc is left to the uniform part."""
EMPTIEST = 16.0
"""A piece whose outline has more than this many times the area that it shows is no lamp but a tangle, left to be found."""
WIDEST = 3.0
"""A lamp's disc of so many lens radii is no help: nine draws in ten would miss the lens."""
POOLED = 5
"""Pixels across the squares whose moments are shared."""
BRIGHTEST = 1e18
"""Above this a sample counts as one of this: its square is still a single-precision number."""
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
        self.record = RecordBuffer(camera, self.ranks)
        self.register_buffer("beta", torch.full((pixels,), FIRST_BLEND))
        self.register_buffer("moments", torch.zeros(2, pixels))
        """Σ β² f² p / q³ and Σ (1 - β)² f² u / q³ of the discs and the uniform part: at the β of least variance
        their roots are as β to 1 - β. Of discs small against the lens neither depends on the β that was drawn with."""
        self.register_buffer("block", torch.tensor(1))
        self.to(device)
        self.register_buffer("spotlights", torch.zeros(0, dtype=torch.int64, device=device))
        self.optimizers: dict[str, torch.optim.Optimizer] = {}
        self._lamps, self._lamp_outlines, known, self._knows_sky = _lamps(scene, camera)
        triangles = torch.tensor([len(mesh.triangles) for mesh in scene.meshes])
        self._known = torch.repeat_interleave(known, triangles).to(device)
        """Triangles whose light is that of lamps in the field, bool `[T]`."""
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
        return guided_draw(lens, focus, GuidedBatch(pixels, raster, mixture), uniforms)

    def _mixture(self, pixels: Pixels, focus: Tensor) -> DiscLensDistribution | None:
        """The mixture of each pixel, None where none has candidates."""
        if self.candidates is None:
            return None
        start, spot = self.candidates.batch(pixels)
        if len(spot) == 0:
            return None
        field, lens = self.field, self.camera.lens
        mean, outline = field.mean.index_select(1, spot), self._outlines.index_select(1, spot)
        weight = field.lens_weights(lens.focus_distance).index_select(0, spot)
        return DiscLensDistribution(lens, focus, take(self.beta, pixels), start, mean, outline, weight)

    @torch.no_grad()
    def study(self, batch: GuidedBatch, ratio: Tensor, at: LensDensity) -> BatchLesson:
        """Add to the moments of the batch's pixels; ratio: L / (A q) `[N]`, 0 outside the aperture."""
        mixture, pixels = batch.distribution, batch.pixels
        of_discs = mixture.beta * at.mixture / at.density.clamp(min=1e-37)
        squared = ratio.clamp(max=BRIGHTEST).square() * mixture.guided  # the others have no β to tell of
        increase(self.moments[0], pixels, squared * of_discs * mixture.beta)
        increase(self.moments[1], pixels, squared * (1.0 - of_discs) * (1.0 - mixture.beta))
        return BatchLesson(float(one_sample_kl(ratio, at.density, mixture.lens.area)), pixels, None, None)

    def is_fresh(self, step: int) -> bool:
        """Whether the weights of a step are independent of the steps before: at the start of a block."""
        return step == int(self.block)

    def recorded(self, samples: PathSamples) -> Tensor:
        """Luminance `[N]` for the record buffer: all but what the field's lamps send straight into the lens."""
        hit = samples.triangle >= 0
        known = self._known[samples.triangle.clamp(min=0).long()] & hit
        light = luminance(samples.radiance - samples.emission * known)
        return light * hit if self._knows_sky else light

    @torch.no_grad()
    def update(self, step: int, lessons: list[BatchLesson], mean_luminance: float) -> None:
        """End a step: where a block ends with it, fit the field to the record buffer and set every β; collective."""
        if not starts_block(step + 1):
            return
        self.block.fill_(step + 1)
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
        self.record.merge()
        found = GaussianField().to(self.beta.device)
        self.spotlights = fit_gaussians(found, self.record, self.camera, mean_luminance)
        if len(found) == 0 and len(self.field) == len(self._lamps) > 0:
            return
        # σ stands for a disc's radius.
        parts = [[getattr(part, name) for part in (self._lamps, found)] for name in ("mean", "radius", "radius", "energy")]
        self.field.assign(*(torch.cat(part, dim=-1) for part in parts))
        self.set_candidates()

    def set_candidates(self) -> None:
        """List each pixel's candidates; to be called after any change of the field."""
        found = balls(self.field.sigma[len(self._lamps) :])
        self._outlines = torch.cat((self._lamp_outlines, found), dim=1)
        """Of the field's ellipsoids (see `DiscLensDistribution`): of what was found, only radii are known."""
        self.candidates: CandidateList | None = draw_candidates(self.field, self.camera) if len(self.field) else None

    def blend_weights(self) -> Tensor:
        """β of each pixel, `[pixels]`."""
        return self.beta

    def load_state_dict(self, state_dict, *args, **kwargs):
        """Load β, moments, records and the field; then list each pixel's candidates."""
        self.spotlights = torch.empty_like(state_dict["spotlights"], device=self.beta.device)
        result = super().load_state_dict(state_dict, *args, **kwargs)
        self.set_candidates()
        return result


def _lamps(scene: Scene, camera: ThinLensCamera) -> tuple[GaussianField, Tensor, Tensor, bool]:
    """The scene's lamps that the lens can see out of focus, as balls in the camera frame, and their outlines `[6, L]`.

    Also which meshes, bool `[meshes]`, and whether the sky, have no light but theirs.
    """
    lamps = find_lamps(scene)
    arrays = (lamps.centres.T, lamps.extents, lamps.radii, lamps.luminance, lamps.outlines)
    centre, reach, size, bright, outline = (torch.from_numpy(x).float() for x in arrays)
    infinite, axes = torch.from_numpy(lamps.infinite), camera.axes.cpu()
    scale = torch.where(infinite, FAR * camera.lens.focus_distance, 1.0)
    world = centre - torch.where(infinite, 0.0, camera.position.cpu())
    mean, radius = (axes.T @ world) * scale, REACH * reach * scale
    outline = torch.where(infinite, balls(radius), packed(axes.T @ outline @ axes) * REACH**2)
    energy = bright * radius.square()
    # Rings and other tangles fill little of their outlines.
    area = torch.linalg.eigvalsh(torch.from_numpy(lamps.outlines))[:, 1:].prod(1).sqrt().float()
    compact = area <= EMPTIEST * size.square()
    visible = scene.environment is None or scene.environment.visible
    seen = (mean[2] > radius) & (~infinite | visible) & compact & (energy > 0.0) & energy.isfinite()
    # Near the focus, or through a tiny lens, a lamp's disc is far larger than the lens: there is nothing to guide.
    away, lens = (mean[2] - camera.lens.focus_distance).abs(), camera.lens
    seen &= (away > radius) & (WIDEST * away * lens.radius > radius * lens.focus_distance)
    field = GaussianField()
    field.assign(mean[:, seen], radius[seen], radius[seen], energy[seen])
    known = torch.ones(len(scene.meshes), dtype=torch.bool)
    known[lamps.mesh[(~seen & ~infinite).numpy()]] = False
    knows_sky = bool(infinite.any() and seen[infinite].all())
    device = camera.position.device
    return field.to(device), outline[:, seen].to(device), known, knows_sky
