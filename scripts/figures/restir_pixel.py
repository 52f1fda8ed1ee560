"""Area ReSTIR's reuse for one pixel in many passes at once, which returns the chosen lens points."""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.baselines.restir import SpatialReuse
from bokehguide.baselines.restir.neighbours import Neighbourhood
from bokehguide.baselines.restir.reservoirs import Reservoirs
from bokehguide.baselines.restir.shifts import Shift, Shifted, reconnect
from bokehguide.baselines.restir.spatial_reuse import NEIGHBOURS
from bokehguide.guiding.lens_queries import UniformQuery
from bokehguide.render import dimensions
from bokehguide.render.film import FilmSamples
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import luminance
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.train import RenderLoop

WEIGHTS = luminance(torch.eye(3)).tolist()


def as_radiance(points: Tensor) -> Tensor:
    """Lens points `[2, N]` as colours `[3, N]` of luminance 1: red and green are the point in units of the lens's radius."""
    red, green, blue = WEIGHTS
    return torch.cat((points, ((1.0 - red * points[0] - green * points[1]) / blue)[None]))


class LensPointShift(Shift):
    """Shifts that return the lens point of the path in place of its radiance. places: pixel of each index, int64 `[N]`."""

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
    """Passes of `SpatialReuse` over one pixel, each with its own samples.

    Index t < count is the pixel in pass t; indices from `count` on are its neighbours. Random numbers are keyed by index and
    step. Attributes have the meaning of `SpatialReuse`, with these indices in place of pixels.
    """

    def __init__(self, loop: RenderLoop, pixel: int, radius: float, seed: int, step: int, count: int):
        self._camera, self._tracer, self._seed, self._step = loop.camera, loop.tracer, seed, step
        self._count = count
        own = torch.arange(count)
        starts = PixelRandom(seed, step, own).uniform(dimensions.NEIGHBOURS, 1)[0]
        around = Neighbourhood(loop.camera.width, loop.camera.height, radius, NEIGHBOURS)
        pixels = around.of(torch.full_like(own, pixel), starts)
        # A pixel that is a neighbour twice has one sample, that of its first occurrence.
        place = (pixels[:, None] == pixels[None]).to(torch.uint8).argmax(0)
        self._members = torch.where(pixels >= 0, (place + 1) * count + own, -1)
        self._places = torch.cat((torch.full((1, count), pixel), pixels.clamp(min=0))).flatten()
        self._neighbourhood = self
        self._shift = LensPointShift(loop, self._places)
        self._reservoirs = Reservoirs.empty(len(self._places))
        self._initial = {}
        self._copied = SpatialReuse(loop.camera, loop.tracer, radius, seed)._copied[pixel].expand(count)

    def of(self, pixels: Tensor, start: Tensor) -> Tensor:
        """As `Neighbourhood.of`: the indices `[NEIGHBOURS, count]` of the constructor."""
        return self._members

    def passes(self) -> FilmSamples:
        """The pixel's sample in each pass, with `as_radiance` of the chosen lens point as its radiance."""
        pixels, camera = torch.arange(len(self._places)), self._camera
        random = PixelRandom(self._seed, self._step, pixels)
        subpixel = random.stratified(0, 2)
        focus = self._shift.focus_points(pixels, subpixel)
        points, weight = UniformQuery(camera.lens, focus, random.stratified(dimensions.LENS, 2)).sample()[:2]
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
        """Lens points `[2, M]` of the chosen samples of the M passes that found light."""
        final = self.passes()
        return final.radiance[:2, final.radiance_weight > 0.0] * self._camera.lens.radius
