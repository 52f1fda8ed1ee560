"""The second pass of a step: each pixel resamples its own sample and the samples of its neighbours."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from bokehguide.baselines.restir.neighbours import Neighbourhood
from bokehguide.baselines.restir.pairwise_mis import TINY, centre_share, neighbour_weight
from bokehguide.baselines.restir.reservoirs import Reservoirs
from bokehguide.baselines.restir.shifts import Shift, Shifted, copied_share
from bokehguide.render import dimensions
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.film import FilmSamples
from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import dot, luminance, normalize
from bokehguide.runtime.indexing import pixel_numbers
from bokehguide.runtime.timer import PhaseTimer

NEIGHBOURS = 32
"""Number of neighbours of each pixel (section 6.2)."""


class SpatialReuse:
    """Area ReSTIR without temporal reuse, on the samples of one step.

    `keep` stores the initial samples of a batch of pixels. After all batches of the frame, `resample` returns the final samples.
    Threads may call `keep` concurrently, and later `resample` concurrently.

    The target p̂ is the luminance of the radiance f. A sample x has a lens point with the density q. The shift T maps x to the
    sample y = T(x) of another pixel. The resampling weight of y is w = m p̂(y) |∂T| / q, with m from pairwise MIS. The pixel
    chooses one sample Y in proportion to w. f(Y) Σw / (A p̂(Y)) is an unbiased estimate of the pixel, because the weights m of
    all samples that lead to the same point sum to 1.

    radius: of the neighbourhood, pixels; seed: of the samples' random numbers.
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
        """Number of neighbours with a lens copy, `[pixels]`. They are the first neighbours of the pixel."""

    def _pinhole_depth(self, device: torch.device) -> Tensor:
        """Depth `[pixels]` of the hits of rays from the lens centre through the pixels' centres."""
        pixels = torch.arange(self._camera.width * self._camera.height, device=device)
        center = torch.zeros(2, len(pixels), device=device)
        rays = self._camera.rays(self._shift.focus_points(pixels, center + 0.5), center)
        return self._camera.depth(self._tracer.geometry.tracer.intersect(*rays).distance, rays[1])

    def keep(self, span: slice, subpixel: Tensor, points: Tensor, path: PathSamples, samples: FilmSamples) -> Tensor:
        """Store the initial samples of a span of pixels; returns whether each sample is finite, bool `[N]`.

        subpixel: u, `[2, N]`; points: lens points, `[2, N]`; path, samples: results of their rays.
        """
        pixels = pixel_numbers(span, points.device)
        good = (samples.radiance * samples.weight).sum(0).isfinite()
        self._reservoirs.store(span, self.to_reservoirs(pixels, subpixel, points, path, samples, good))
        self._initial[span.start] = samples
        return good

    def to_reservoirs(
        self, pixels: Tensor, subpixel: Tensor, points: Tensor, path: PathSamples, samples: FilmSamples, good: Tensor
    ) -> Reservoirs:
        """Samples as reservoirs, black where they are not `good`, bool `[N]`."""
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
        """Final samples of a span of pixels that `keep` stored, and the number of traced rays.

        The radiance belongs to the chosen sample. All other values belong to the initial sample.
        """
        with timer.measure("guiding"):
            pixels = pixel_numbers(span, self._copied.device)
            random = PixelRandom(self._seed, step, pixels)
            own, initial = self._reservoirs.select(span), self._initial.pop(span.start)
            neighbours = self._neighbourhood.of(pixels, random.uniform(dimensions.NEIGHBOURS, 1)[0])
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
            bad = 0.0 * initial.radiance * initial.weight  # the film reports NaN
            return replace(initial, radiance=choice.radiance + bad, radiance_weight=choice.weight), rays

    def _exchange(
        self, pixels: Tensor, neighbour: Tensor, slot: int, step: int, timer: PhaseTimer
    ) -> tuple[Reservoirs, Shifted, Shifted]:
        """Samples of the neighbours `[N]`, these samples shifted to `pixels`, and samples of `pixels` shifted to the neighbours.

        Samples are black if the neighbour is -1. The first `Shifted` has the number of rays of both.
        """
        present = neighbour >= 0
        neighbour = torch.where(present, neighbour, pixels)
        source, target = torch.cat((neighbour, pixels)), torch.cat((pixels, neighbour))
        samples = self._reservoirs.select(source)
        samples.target *= present.repeat(2)
        reconnects = (slot >= self._copied.index_select(0, pixels)).repeat(2)
        random = PixelRandom(self._seed, step, source)
        shifted = self._shift(samples, random, source, target, reconnects, timer)
        return samples.select(slice(0, len(pixels))), *shifted.split(len(pixels))


class _Choice:
    """Weighted reservoir sampling of one sample from a stream (Chao 1982).

    radiance: of the chosen sample, scaled to luminance 1, `[3, N]`; weight: sum of all weights, `[N]`.
    """

    def __init__(self, random: PixelRandom, like: Tensor):
        self._random, self._dimension = random, dimensions.NEIGHBOUR_CHOICE
        self.radiance, self.weight = torch.zeros_like(like), torch.zeros_like(like[0])

    def offer(self, weight: Tensor, radiance: Tensor) -> None:
        """Choose samples of radiance `[3, N]` with the probability weight / (sum of weights)."""
        self.weight = self.weight + weight
        taken = self._random.uniform(self._dimension, 1)[0] * self.weight < weight
        self._dimension += 1
        self.radiance = torch.where(taken, radiance / luminance(radiance).clamp(min=TINY), self.radiance)
