"""Pixels resampled one by one, neighbour by neighbour, with the formulas as they are printed; slow, and readable."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from bokehguide.baselines.restir import spatial_reuse
from bokehguide.render import dimensions
from bokehguide.render.random import PixelRandom
from bokehguide.render.tracer import MISS_DISTANCE
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.train import RenderLoop
from tests.support.restir_cases import WIDTH, loop_of

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
STEP, NEIGHBOURS = 3, 12


@dataclass
class Sample:
    """What a pixel's path with the random numbers of pixel `key` finds from a lens point."""

    key: int
    lens: np.ndarray
    value: np.ndarray
    triangle: int
    position: np.ndarray
    """In the camera frame; where nothing was hit, the direction."""
    normal: np.ndarray

    @property
    def target(self) -> float:
        return float(LUMINANCE @ self.value)


class SlowReuse:
    """The second pass of a loop that stands between its two passes."""

    def __init__(self, loop: RenderLoop):
        self.loop, self.camera, self.lens = loop, loop.camera, loop.camera.lens

    def random(self, pixel: int) -> PixelRandom:
        return PixelRandom(self.loop.settings.seed, STEP, torch.tensor([pixel]))

    def focus(self, pixel: int, key: int) -> np.ndarray:
        """x_F of `pixel` at the sub-pixel position that `key`'s random numbers choose."""
        corner = torch.tensor([[pixel % WIDTH], [pixel // WIDTH]])
        raster = corner + self.random(key).stratified(0, 2)
        return self.camera.focus_points(raster)[:, 0].double().numpy()

    def sample(self, pixel: int, key: int, lens: np.ndarray) -> Sample:
        focus = torch.from_numpy(self.focus(pixel, key)).float()[:, None]
        points = torch.from_numpy(lens).float()[:, None]
        origin, direction = self.camera.rays(focus, points)
        found = self.loop.tracer.trace(origin, direction, self.random(key), PhaseTimer())
        value = found.radiance[:, 0].double().numpy() * float(self.lens.contains(points))
        axes = self.camera.axes.double().numpy()
        away = axes.T @ direction[:, 0].double().numpy()
        triangle = int(found.triangle)
        position = away if triangle < 0 else np.append(lens, 0.0) + away * float(found.distance)
        normal = axes.T @ self.loop.tracer.geometry.face_normals(found.triangle.clamp(min=0))[:, 0].double().numpy()
        return Sample(key, lens, value, triangle, position, normal)

    def shift(self, sample: Sample, source: int, target: int, reconnects: bool) -> tuple[Sample | None, float]:
        """The sample in another pixel and |∂T|; None where the shift fails."""
        if not reconnects:
            return self.sample(target, sample.key, sample.lens), 1.0
        old, new = self.focus(source, sample.key), self.focus(target, sample.key)
        if sample.triangle < 0:
            lens, jacobian = sample.lens + (new - old)[:2], 1.0
        else:
            z = sample.position[2]
            lens = (sample.position + (new - sample.position) * z / (z - self.lens.focus_distance))[:2]
            jacobian = self.jacobian(sample, lens)
        if math.hypot(*lens) > self.lens.radius:
            return None, jacobian
        shifted = self.sample(target, sample.key, lens)
        return (shifted if shifted.triangle == sample.triangle else None), jacobian

    def jacobian(self, sample: Sample, lens: np.ndarray) -> float:
        """|ω'·n₁| |ω·n₀| / (|ω'·n₀| |ω·n₁|)."""
        cosines = []
        for point in (lens, sample.lens):
            omega = sample.position - np.append(point, 0.0)
            omega /= np.linalg.norm(omega)
            cosines.append(abs(omega @ sample.normal) / abs(omega[2]))
        return cosines[0] / cosines[1]

    def is_copied(self, pixel: int, slot: int) -> bool:
        """By the CoC, in the pixels of a neighbourhood of radius 50, of what a pinhole in the lens centre shows."""
        raster = torch.tensor([[pixel % WIDTH + 0.5], [pixel // WIDTH + 0.5]])
        rays = self.camera.rays(self.camera.focus_points(raster), torch.zeros(2, 1))
        distance = float(self.loop.tracer.geometry.tracer.intersect(*rays).distance)
        z = distance * float(self.camera.axes[:, 2] @ rays[1][:, 0]) if distance < MISS_DISTANCE else 1e12
        focus, radius = self.lens.focus_distance, self.lens.radius
        coc = 2.0 * radius * abs(z - focus) / (z * focus * self.camera.pixel_slope) * 50.0 / self.loop.settings.reuse_radius
        gamma = 1.0 if coc <= 2.0 else 17.939 / (coc + 21.383) + 0.1
        return slot < gamma * NEIGHBOURS

    def estimate(self, centre: int, initial: dict[int, Sample], weights: np.ndarray) -> np.ndarray:
        """f(Y) Σw / (A p̂(Y)), `[3]`. initial: each pixel's own sample; weights: 1 / (A q) of them."""
        start = self.random(centre).uniform(dimensions.NEIGHBOURS, 1)[0]
        members = self.loop.mode.reuse.spatial._neighbourhood.of(torch.tensor([centre]), start)[:, 0].tolist()
        present = [(slot, pixel) for slot, pixel in enumerate(members) if pixel >= 0]
        own, confidence, total = initial[centre], 1.0, 1.0 + len(present)
        offers, own_weight = [], confidence / total
        for slot, pixel in present:
            theirs, reconnects = initial[pixel], not self.is_copied(centre, slot)
            here, jacobian = self.shift(theirs, pixel, centre, reconnects)
            if here is not None and here.target > 0.0:
                others = (total - confidence) * theirs.target / jacobian
                m = 1.0 / total * others / (others + confidence * here.target)
                offers.append((slot, m * here.target * weights[pixel] * jacobian, here.value))
            there, jacobian = self.shift(own, centre, pixel, reconnects)
            if own.target > 0.0:
                others = 0.0 if there is None else (total - confidence) * there.target * jacobian
                own_weight += 1.0 / total * confidence * own.target / (others + confidence * own.target)
        offers.append((NEIGHBOURS, own_weight * own.target * weights[centre], own.value))
        return self.choose(centre, offers)

    def choose(self, centre: int, offers: list[tuple[int, float, np.ndarray]]) -> np.ndarray:
        total, chosen = 0.0, np.zeros(3)
        for number, weight, value in offers:
            total += weight
            if float(self.random(centre).uniform(dimensions.NEIGHBOUR_CHOICE + number, 1)) * total < weight:
                chosen = value / (LUMINANCE @ value)
        return chosen * total


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["area-restir", "area-restir+lis"])
def test_the_batched_pass_agrees(mode, monkeypatch):
    monkeypatch.setattr(spatial_reuse, "NEIGHBOURS", NEIGHBOURS)
    loop = loop_of(mode, seed=5)
    for _ in range(STEP - 1):
        loop.step()
    loop.step_number = STEP
    loop._in_batches(loop._render_batch, [slice(0, loop.film.width * loop.film.height)])
    points, weights = loop.mode.reuse.spatial._reservoirs.lens_points.clone(), loop.mode.reuse.spatial._reservoirs.weight.clone()
    whole, _ = loop.mode.reuse.spatial.resample(slice(0, WIDTH * loop.camera.height), STEP, PhaseTimer())
    batched = (whole.radiance * whole.radiance_weight).T.double().numpy()

    slow = SlowReuse(loop)
    # In the emitter's disc, on the card and the ball, in the sky, and all along the frame's edge and corner.
    places = [(0, 0), (47, 0), (12, 5), (16, 8), (13, 9), (18, 14), (34, 15), (30, 17), (20, 22), (40, 25), (10, 30), (47, 31)]
    centres = [y * WIDTH + x for x, y in places]
    initial: dict[int, Sample] = {}
    for centre in centres:
        start = slow.random(centre).uniform(dimensions.NEIGHBOURS, 1)[0]
        members = loop.mode.reuse.spatial._neighbourhood.of(torch.tensor([centre]), start)[:, 0].tolist()
        for pixel in {centre, *members} - {-1} - set(initial):
            initial[pixel] = slow.sample(pixel, pixel, points[:, pixel].double().numpy())
    if mode == "area-restir+lis":
        assert len({round(float(weights[pixel]), 3) for pixel in initial}) > 3
    expected = np.array([slow.estimate(centre, initial, weights.double().numpy()) for centre in centres])
    assert (expected.max(1) > 0.0).sum() >= len(centres) - 2
    np.testing.assert_allclose(batched[centres], expected, rtol=2e-3, atol=1e-6)
