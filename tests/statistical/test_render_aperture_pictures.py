"""Whole renders through apertures of any shape: which way round, how bright, and the same with and without guidance."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch

from bokehguide.models.gaussian_mixture import GaussianMixture
from bokehguide.render.lens import ShapedLens
from bokehguide.scene.types import Aperture, Camera, FilmSettings, Scene
from bokehguide.train import RenderLoop, RenderSettings
from tests.support import aperture_cases, scenes
from tests.support.aperture_cases import plain_transmission
from tests.support.gaussians import use_pytorch
from tests.support.render_checks import Estimate, estimate, insert_gaussians
from tests.support.statistical import SIGNIFICANCE, block_means, chi_square, z_test
from tests.support.tracing import emitter, rectangle

WIDTH, HEIGHT = 64, 48
RADIUS, FOCUS, FOV = 0.5, 2.0, 40.0
SLOPE = 2.0 * math.tan(math.radians(FOV / 2.0)) / WIDTH
HALF = 0.014
"""Half the side of a square emitter at unit distance."""
SPP = 150

LIT_CORNER = np.zeros((8, 8), np.float32)
"""Most light at the top on the right, some below it."""
LIT_CORNER[0:3, 4:8], LIT_CORNER[3:6, 6:8] = 1.0, 0.4


def lamp_hits(aperture: Aperture, x: float, y: float, depth: float) -> np.ndarray:
    """How many samples of each 4 × 4 pixels meet a small emitter at (x, y, -depth); the camera looks along -z."""
    camera = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=FOV, aperture_radius=RADIUS, focus_distance=FOCUS, aperture=aperture)
    light = rectangle(0, (x, y, -depth), scale=HALF * depth)
    loop = RenderLoop(
        Scene("emitter", camera, (light,), (emitter(),), FilmSettings(WIDTH, HEIGHT, 1)),
        RenderSettings("uniform", spp=SPP, threads=1),
    )
    hits = estimate(loop, SPP).mean * SPP / (0.2126 + 2.0 * 0.7152 + 3.0 * 0.0722)
    np.testing.assert_allclose(hits, hits.round(), atol=1e-2)
    return 16.0 * block_means(hits.round(), 4)


def expected_hits(aperture: Aperture, x: float, y: float, depth: float) -> np.ndarray:
    """The same by geometry: an emitter's point p is seen from x_F through the lens point (1 - k) x_F + k p."""
    draws = np.random.default_rng(1).random((4, 40, HEIGHT, WIDTH))
    right = np.arange(WIDTH) + draws[0] - WIDTH / 2
    up = HEIGHT / 2 - np.arange(HEIGHT)[:, None] - draws[1]
    k = FOCUS / (FOCUS - depth)
    lens_x = (1.0 - k) * FOCUS * SLOPE * right + k * (x + HALF * depth * (2.0 * draws[2] - 1.0))
    lens_y = (1.0 - k) * FOCUS * SLOPE * up + k * (y + HALF * depth * (2.0 * draws[3] - 1.0))
    points = np.stack((lens_x.ravel(), lens_y.ravel())) / RADIUS
    passes = plain_transmission(aperture, points * aperture_cases.RADIUS)
    if aperture.cat_eye:  # a second disc, moved to the left for a pixel on the right
        half_diagonal = math.hypot(WIDTH, HEIGHT) / 2.0
        cut_x = points[0] * aperture.ratio + aperture.cat_eye * right.ravel() / half_diagonal
        cut_y = points[1] + aperture.cat_eye * np.broadcast_to(up, right.shape).ravel() / half_diagonal
        passes = passes * (np.hypot(cut_x, cut_y) <= 1.0)
    return block_means(passes.reshape(40, HEIGHT, WIDTH).mean(0), 4) + 1e-5  # a rim may pass between all draws


PICTURES = [
    (Aperture(image=LIT_CORNER), 0.0, 0.0),
    (Aperture(image=LIT_CORNER, rotation=60.0, ratio=1.5), 0.1, -0.05),
    (Aperture(blades=3, rotation=20.0, edge=1.0), 0.0, 0.0),
    (Aperture(blades=3, rotation=90.0, curvature=0.4, ratio=1.3, cat_eye=1.0), -0.1, 0.05),
    (Aperture(cat_eye=1.5), 0.15, 0.1),
]


@pytest.mark.slow
@pytest.mark.parametrize("depth", [6.0, 1.4])
@pytest.mark.parametrize("aperture, x, y", PICTURES)
def test_bokeh_is_the_aperture_upright_behind_the_focal_plane_and_turned_round_before_it(aperture, x, y, depth):
    """Turned by 180°: 1 - k = Z / (Z - d_F) says through which side of the lens a pixel sees the emitter."""
    place = (x * depth, y * depth, depth)
    found, expected = lamp_hits(aperture, *place), expected_hits(aperture, *place)
    assert chi_square(found, expected / expected.sum()) > SIGNIFICANCE
    # Whatever the shape, all of the emitter's light arrives, but for what a cat's eye cuts off.
    light = SPP * (2.0 * HALF / SLOPE) ** 2
    light *= expected.sum() / expected_hits(replace(aperture, cat_eye=0.0), *place).sum()
    assert z_test(found.sum() - light, math.sqrt(light)) > SIGNIFICANCE


@pytest.mark.parametrize(
    "turned", [(slice(None, None, -1), slice(None)), (slice(None), slice(None, None, -1)), (slice(None, None, -1),) * 2]
)
def test_a_mask_the_other_way_round_is_told_apart(turned):
    image = np.ascontiguousarray(LIT_CORNER[turned])
    found, expected = lamp_hits(Aperture(image=LIT_CORNER), 0.0, 0.0, 6.0), expected_hits(Aperture(image=image), 0.0, 0.0, 6.0)
    assert chi_square(found, expected / expected.sum()) < SIGNIFICANCE


FURNACES = {
    "blades": Aperture(blades=6, rotation=10.0, edge=-0.8, ratio=1.5),
    "mask": Aperture(image=LIT_CORNER),
    "round cat's eye": Aperture(cat_eye=1.0),
    "all": Aperture(blades=5, rotation=30.0, curvature=0.4, ratio=0.7, edge=1.0, cat_eye=1.2),
}


def seen_through(aperture: Aperture, scene: Scene) -> Scene:
    return replace(scene, camera=replace(scene.camera, aperture=aperture))


def furnace(name: str, mode: str, steps: int = 64) -> Estimate:
    """Radiance 1 everywhere through a wide lens, guided by 20 Gaussians from the second step on."""
    loop = RenderLoop(seen_through(FURNACES[name], scenes.furnace(80, 48)), RenderSettings(mode, seed=3, threads=1))
    loop.step()
    if mode != "uniform":
        insert_gaussians(loop, 20, 3)
    return estimate(loop, steps - 1)


def open_share(aperture: Aperture, width: int, height: int) -> np.ndarray:
    """What a cat's eye leaves of the light by pixel, by geometry."""
    ticks = (np.arange(150) + 0.5) / 75.0 - 1.0
    x, y = (axis.ravel() for axis in np.meshgrid(ticks / min(1.0, aperture.ratio), ticks))
    passes = plain_transmission(aperture, np.stack((x, y)) * aperture_cases.RADIUS)
    scale = 2.0 * aperture.cat_eye / math.hypot(width, height)
    shares = np.ones((height, width))
    for row in range(height):
        for column in range(width):
            right, up = scale * (column + 0.5 - width / 2), scale * (height / 2 - row - 0.5)
            shares[row, column] = passes[(x * aperture.ratio + right) ** 2 + (y + up) ** 2 <= 1.0].sum()
    return shares / passes.sum()


def furnace_check(name: str, found: Estimate) -> float:
    """p-value of the open share in blocks of 8 × 8 pixels and in the frame."""
    aperture = FURNACES[name]
    share = open_share(aperture, 80, 48) if aperture.cat_eye else np.ones((48, 80))
    return found.p_value(share, 64.0 * (1e-3 * (share < 1.0)) ** 2, (8,))


@pytest.mark.parametrize("mode", ["uniform", "lis"])
@pytest.mark.parametrize("name", FURNACES)
def test_the_furnace_is_as_bright_as_the_lens_is_open(name, mode):
    found = furnace(name, mode)
    assert furnace_check(name, found) > SIGNIFICANCE
    if mode == "uniform" and not FURNACES[name].cat_eye:
        np.testing.assert_allclose(found.mean, 1.0, atol=1e-5)
    if mode != "uniform":
        assert found.last.outside > 0.01  # the guide was at work


MIXED = Aperture(blades=5, rotation=20.0, curvature=0.3, ratio=1.2, cat_eye=1.0, edge=0.8)
FRAME = (128, 72)


def emitters(mode: str, spp: int, seed: int) -> Estimate:
    """Three emitters out of focus, with every sample from the first on in the mean."""
    scene = seen_through(MIXED, scenes.emitters(*FRAME))
    return estimate(RenderLoop(scene, RenderSettings(mode, seed=seed, threads=1)), spp)


@lru_cache
def reference() -> Estimate:
    return emitters("uniform", 256, 1000)


def means_check(found: Estimate) -> float:
    """The least p-value over blocks of 8 × 8 pixels and the frame."""
    return found.p_value(reference().mean, reference().variance, (8,))


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["lis", "lis-o"])
def test_means_while_learning_are_those_of_the_uniform_lens(mode):
    found = emitters(mode, 64, 1)
    assert found.last.gaussians > 0 and found.last.outside > 0.05
    assert means_check(found) > SIGNIFICANCE


def flat_transmission(monkeypatch) -> None:
    """Weights forget W, which draws follow: as if all were alike within the shape."""
    monkeypatch.setattr(ShapedLens, "transmission", lambda self, points: (shaped(self, points) > 0.0).float())


def no_cat_s_eye(monkeypatch) -> None:
    monkeypatch.setattr(ShapedLens, "unblocked", lambda self, points, focus: torch.ones_like(points[0]))


def flat_density(monkeypatch) -> None:
    """q forgets W, though draws follow it. PyTorch has the mixture, as the native core has a `blend` of its own."""
    use_pytorch(monkeypatch)
    monkeypatch.setattr(
        GaussianMixture,
        "blend",
        lambda self, points, mixture: self.beta * mixture + (1.0 - self.beta) * self.lens.contains(points) / self.lens.area,
    )


shaped = ShapedLens.transmission


@pytest.mark.slow
@pytest.mark.parametrize(
    "mutate, spp",
    [(flat_transmission, 64), (no_cat_s_eye, 64), (flat_density, 512)],  # the last acts on guided pixels alone
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_wrong_transmission_fails_the_means(mutate, spp, monkeypatch):
    reference()
    mutate(monkeypatch)
    assert means_check(emitters("lis", spp, 1)) < SIGNIFICANCE


@pytest.mark.slow
def test_alpha_is_what_is_met_by_the_light_that_passes():
    """Guided or not: a cat's eye darkens the picture and makes nothing transparent."""
    scene = seen_through(Aperture(cat_eye=1.0), scenes.emitters(48, 27))
    scene = replace(scene, environment=replace(scene.environment, visible=False))
    alphas = []
    for mode, spp in (("uniform", 256), ("lis", 256)):
        loop = RenderLoop(scene, RenderSettings(mode, seed=5, threads=1))
        estimate(loop, spp)
        alphas.append(loop.film.layers()["alpha"].astype(float))
    whole, guided = alphas
    assert guided.sum() == pytest.approx(whole.sum(), rel=0.1)


def test_what_is_opaque_stays_opaque():
    loop = RenderLoop(seen_through(Aperture(cat_eye=1.5), scenes.furnace(32, 18)), RenderSettings("uniform", threads=1))
    found = estimate(loop, 64)
    np.testing.assert_allclose(loop.film.layers()["alpha"], 1.0, rtol=1e-6)
    assert found.mean.min() < 0.4
