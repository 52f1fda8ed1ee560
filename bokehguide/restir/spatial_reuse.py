"""The second pass of a step: every pixel resamples its own sample and those of its neighbours."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.film import FilmSamples
from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.pixels import pixel_numbers
from bokehguide.render.random import PixelRandom
from bokehguide.render.timer import PhaseTimer
from bokehguide.render.vector import dot, luminance, normalize
from bokehguide.restir.neighbours import Neighbourhood
from bokehguide.restir.pairwise_mis import TINY, centre_share, neighbour_weight
from bokehguide.restir.reservoirs import Reservoirs
from bokehguide.restir.shifts import Shift, Shifted, copied_share

NEIGHBOURS = 32
"""Of each pixel (section 6.2)."""
START_DIMENSION = 1 << 30
"""Random dimension that chooses a pixel's neighbours, beyond those of paths."""
CHOICE_DIMENSION = START_DIMENSION + 1
"""Random dimensions from here on choose among the samples."""


class SpatialReuse:
    """Area ReSTIR without reuse over time, on the samples of one step.

    `keep` takes the initial samples of a batch of pixels; when it has those of the whole
    frame, `resample` makes each pixel's final one. Threads may call either side by side.

    p̂ is the luminance of what arrives, f. Shifted to another pixel, y = T(x), a sample with a
    lens point of density q counts there with w = m p̂(y) |∂T| / q, m by pairwise MIS. One of
    them, Y, is chosen in proportion to w, and f(Y) Σw / (A p̂(Y)) is an unbiased estimate of
    the pixel, as all m that lead to a point sum to 1.

    radius: of the neighbourhood, pixels; seed: of the random numbers, as the samples have it.
    """

    def __init__(self, camera: ThinLensCamera, tracer: PathTracer, radius: float, seed: int):
        device = camera.position.device
        self._camera, self._tracer, self._seed = camera, tracer, seed
        self._shift = Shift(camera, tracer)
        self._neighbourhood = Neighbourhood(camera.width, camera.height, radius, NEIGHBOURS, device)
        self._reservoirs = Reservoirs.empty(camera.width * camera.height, device)
        self._initial: dict[int, FilmSamples] = {}
        coc = camera.coc_diameter(self._pinhole_depth(device))
        self._copied = copied_share(coc, radius) * NEIGHBOURS
        """How many of a pixel's neighbours, the first ones, get the lens copy `[pixels]`."""

    def _pinhole_depth(self, device: torch.device) -> Tensor:
        """Depth `[pixels]` of what rays from the lens centre through the pixels' centres meet."""
        pixels = torch.arange(self._camera.width * self._camera.height, device=device)
        center = torch.zeros(2, len(pixels), device=device)
        rays = self._camera.rays(self._shift.focus_points(pixels, center + 0.5), center)
        return self._camera.depth(self._tracer.geometry.tracer.intersect(*rays).distance, rays[1])

    def keep(self, span: slice, subpixel: Tensor, points: Tensor, path: PathSamples, samples: FilmSamples) -> Tensor:
        """Take the initial samples of the pixels of a span; returns the finite ones, bool `[N]`.

        subpixel: u `[2, N]`; points: lens points `[2, N]`; path, samples: what their rays found.
        """
        pixels = pixel_numbers(span, points.device)
        good = (samples.radiance * samples.weight).sum(0).isfinite()
        self._reservoirs.put(span.start, self.describe(pixels, subpixel, points, path, samples, good))
        self._initial[span.start] = samples
        return good

    def describe(
        self, pixels: Tensor, subpixel: Tensor, points: Tensor, path: PathSamples, samples: FilmSamples, good: Tensor
    ) -> Reservoirs:
        """The samples as reservoirs; those that are not `good` are black."""
        focus, lens = self._shift.focus_points(pixels, subpixel), self._camera.lens
        passes = lens.transmission(points) * lens.unblocked(points, focus) * good
        target = luminance(samples.radiance).nan_to_num(0.0, 0.0, 0.0) * passes
        weight = samples.weight.nan_to_num(0.0, 0.0, 0.0) / passes.clamp(min=TINY)
        hit = (path.triangle >= 0).to(torch.float32)
        normal = self._camera.axes.T @ self._tracer.geometry.face_normals(path.triangle.clamp(min=0)) * hit
        origin = torch.cat((points, torch.zeros_like(points[:1])))
        position = origin + normalize(focus - origin) * (path.distance * hit)
        plane = torch.cat((normal[:2], (dot(position, normal) + (1.0 - hit))[None]))
        return Reservoirs(subpixel, points, samples.depth, plane, path.triangle, target, weight)

    def resample(self, span: slice, step: int, timer: PhaseTimer) -> tuple[FilmSamples, int]:
        """Final samples of the pixels of a span that was kept, and the number of rays traced for them.

        Their radiance is that of the chosen sample; all else is the initial one's, with its weight.
        """
        with timer.measure("guiding"):
            pixels = pixel_numbers(span, self._copied.device)
            random = PixelRandom(self._seed, step, pixels)
            own, initial = self._reservoirs.select(pixels), self._initial.pop(span.start)
            neighbours = self._neighbourhood.of(pixels, random.uniform(START_DIMENSION, 1)[0])
            count = (neighbours >= 0).sum(0).to(torch.float32)
            choice = _Choice(random, initial.radiance)
            share = 1.0 / (count + 1.0)
            rays = 0
            for slot, neighbour in enumerate(neighbours):
                samples, here, there = self._exchange(pixels, neighbour, slot, step, timer)
                rays += here.rays
                weight = neighbour_weight(samples.target, here.target, here.jacobian, count)
                choice.offer(weight * here.target * samples.weight * here.jacobian, here.radiance)
                share += centre_share(own.target, there.target, there.jacobian, count) * (neighbour >= 0)
            choice.offer(share * own.target * own.weight, initial.radiance)
            bad = 0.0 * initial.radiance * initial.weight  # a NaN is the film's to report
            return replace(initial, radiance=choice.radiance + bad, radiance_weight=choice.weight), rays

    def _exchange(
        self, pixels: Tensor, neighbour: Tensor, slot: int, step: int, timer: PhaseTimer
    ) -> tuple[Reservoirs, Shifted, Shifted]:
        """Samples of the neighbours `[N]`, the same shifted to `pixels` `[N]`, and those of `pixels` shifted to them.

        Black where there is no neighbour, -1. The rays of both are counted with the first.
        """
        present = neighbour >= 0
        neighbour = torch.where(present, neighbour, pixels)
        source, target = torch.cat((neighbour, pixels)), torch.cat((pixels, neighbour))
        samples = self._reservoirs.select(source)
        samples.target *= present.repeat(2)
        reconnects = (slot >= self._copied.index_select(0, pixels)).repeat(2)
        random = PixelRandom(self._seed, step, source)
        shifted = self._shift(samples, random, source, target, reconnects, timer)
        places = torch.arange(len(pixels), device=pixels.device)
        return samples.select(places), *shifted.split(len(pixels))


class _Choice:
    """One of the samples offered one by one, in proportion to their weights (Chao 1982).

    radiance: of the one chosen so far, at luminance 1, `[3, N]`; weight: the sum so far `[N]`.
    """

    def __init__(self, random: PixelRandom, like: Tensor):
        self._random, self._dimension = random, CHOICE_DIMENSION
        self.radiance, self.weight = torch.zeros_like(like), torch.zeros_like(like[0])

    def offer(self, weight: Tensor, radiance: Tensor) -> None:
        """Take samples of radiance `[3, N]` with probability weight / (sum so far)."""
        self.weight = self.weight + weight
        taken = self._random.uniform(self._dimension, 1)[0] * self.weight < weight
        self._dimension += 1
        self.radiance = torch.where(taken, radiance / luminance(radiance).clamp(min=TINY), self.radiance)
