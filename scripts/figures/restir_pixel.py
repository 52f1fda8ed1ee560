"""Area ReSTIR's reuse for one pixel, many passes at once, that tells which lens points it chooses."""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.render.film import FilmSamples
from bokehguide.render.random import PixelRandom
from bokehguide.render.timer import PhaseTimer
from bokehguide.render.vector import luminance
from bokehguide.restir import SpatialReuse
from bokehguide.restir.neighbours import Neighbourhood
from bokehguide.restir.reservoirs import Reservoirs
from bokehguide.restir.shifts import Shift, Shifted, reconnect
from bokehguide.restir.spatial_reuse import NEIGHBOURS, START_DIMENSION
from bokehguide.train import RenderLoop
from bokehguide.train.guide import LENS_DIMENSION, uniform_draw

WEIGHTS = luminance(torch.eye(3)).tolist()


def as_radiance(points: Tensor) -> Tensor:
    """Colours of luminance 1 `[3, N]` whose red and green are lens points `[2, N]`, in units of the lens's radius."""
    red, green, blue = WEIGHTS
    return torch.cat((points, ((1.0 - red * points[0] - green * points[1]) / blue)[None]))


class LensPointShift(Shift):
    """Shifts that tell, in place of the radiance, the lens point from which it arrives.

    places: the camera's pixel for each index, int64 `[N]`.
    """

    def __init__(self, loop: RenderLoop, places: Tensor):
        super().__init__(loop.camera, loop.tracer)
        self._places = places

    def focus_points(self, pixels: Tensor, subpixel: Tensor) -> Tensor:
        return super().focus_points(self._places[pixels], subpixel)

    def __call__(
        self, samples: Reservoirs, random: PixelRandom, source: Tensor, target: Tensor, reconnects: Tensor, timer: PhaseTimer
    ) -> Shifted:
        shifted = super().__call__(samples, random, source, target, reconnects, timer)
        moved = (self.focus_points(target, samples.subpixel) - self.focus_points(source, samples.subpixel))[:2]
        lens = self._camera.lens
        points = reconnect(samples.lens_points, moved, samples.depth, lens.focus_distance)
        shifted.radiance = as_radiance(torch.where(reconnects, points, samples.lens_points) / lens.radius)
        return shifted


class PixelReuse(SpatialReuse):
    """Passes of `SpatialReuse` over one pixel, each with samples of its own.

    Index t stands for the pixel in pass t, the indices from `count` on for its neighbours then; all
    random numbers are keyed by index and step. `_initial`, `_shift` and the like mean what they
    do in `SpatialReuse`, for these indices in place of the frame's pixels.
    """

    def __init__(self, loop: RenderLoop, pixel: int, radius: float, seed: int, step: int, count: int):
        self._camera, self._tracer, self._seed, self._step = loop.camera, loop.tracer, seed, step
        self._count = count
        own = torch.arange(count)
        starts = PixelRandom(seed, step, own).uniform(START_DIMENSION, 1)[0]
        around = Neighbourhood(loop.camera.width, loop.camera.height, radius, NEIGHBOURS)
        pixels = around.of(torch.full_like(own, pixel), starts)
        # A pixel that is a neighbour twice has one sample, that of its first place.
        place = (pixels[:, None] == pixels[None]).to(torch.uint8).argmax(0)
        self._members = torch.where(pixels >= 0, (place + 1) * count + own, -1)
        self._places = torch.cat((torch.full((1, count), pixel), pixels.clamp(min=0))).flatten()
        self._neighbourhood = self
        self._shift = LensPointShift(loop, self._places)
        self._reservoirs = Reservoirs.empty(len(self._places))
        self._initial = {}
        self._copied = SpatialReuse(loop.camera, loop.tracer, radius, seed)._copied[pixel].expand(count)

    def of(self, pixels: Tensor, start: Tensor) -> Tensor:
        """As `Neighbourhood.of`: the indices `[NEIGHBOURS, count]`, settled before."""
        return self._members

    def passes(self) -> FilmSamples:
        """What the pixel gets in each pass, with `as_radiance` of the chosen sample's lens point for a radiance."""
        pixels, camera = torch.arange(len(self._places)), self._camera
        random = PixelRandom(self._seed, self._step, pixels)
        subpixel = random.stratified(0, 2)
        focus = self._shift.focus_points(pixels, subpixel)
        points, weight = uniform_draw(camera.lens, focus, random.stratified(LENS_DIMENSION, 2))[:2]
        origins, directions = camera.rays(focus, points)
        path = self._tracer.trace(origins, directions, random, PhaseTimer())
        depth = camera.depth(path.distance, directions)
        seen = (weight, path.radiance, path.alpha, depth, path.normal, path.albedo, path.emission)
        self.keep(slice(0, len(pixels)), subpixel, points, path, FilmSamples(*seen))
        centres = FilmSamples(*(value[..., : self._count] for value in seen))
        centres.radiance = as_radiance(points[:, : self._count] / camera.lens.radius)
        self._initial[0] = centres
        return self.resample(slice(0, self._count), self._step, PhaseTimer())[0]

    def chosen(self) -> Tensor:
        """Lens points `[2, M]` of the samples chosen in the M passes that found any light."""
        final = self.passes()
        return final.radiance[:2, final.radiance_weight > 0.0] * self._camera.lens.radius
