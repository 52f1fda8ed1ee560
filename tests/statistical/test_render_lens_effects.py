"""Whole renders with uniform lens sampling, against what geometry says a thin lens shows."""

import math

import numpy as np
import pytest

from bokehguide.render.lens import Lens
from bokehguide.scene.types import Camera, Environment, FilmSettings, Mesh, Scene
from bokehguide.train import RenderLoop, RenderSettings
from tests.support.scenes import BLACK, constant_sky
from tests.support.statistical import SIGNIFICANCE, chi_square, z_test
from tests.support.tracing import emitter, rectangle

WIDTH, HEIGHT = 48, 36
RADIUS, FOCUS, FOV = 0.5, 2.0, 40.0
SLOPE = 2.0 * math.tan(math.radians(FOV / 2.0)) / WIDTH
"""Width of a pixel at unit distance."""
HALF = 0.02
"""Half the side of a square emitter at unit distance: emitters grow with their distance."""


def render(meshes: list[Mesh], spp: int, environment: Environment | None = None) -> RenderLoop:
    """Emitters of radiance (1, 2, 3) are material 0, black cards material 1; the camera looks along -z."""
    camera = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=FOV, aperture_radius=RADIUS, focus_distance=FOCUS)
    scene = Scene("lens", camera, tuple(meshes), (emitter(), BLACK), FilmSettings(WIDTH, HEIGHT, 1), environment)
    loop = RenderLoop(scene, RenderSettings("uniform", spp=spp, threads=1))
    for _ in range(spp):
        loop.step()
    return loop


def offsets(x: float, y: float, depth: float) -> tuple[np.ndarray, np.ndarray]:
    """How far each pixel's centre lies to the right of and above a point's pinhole image, in pixels."""
    columns = np.arange(WIDTH) + 0.5 - WIDTH / 2 - x / depth / SLOPE
    rows = HEIGHT / 2 - np.arange(HEIGHT) - 0.5 - y / depth / SLOPE
    return np.broadcast_to(columns, (HEIGHT, WIDTH)), np.broadcast_to(rows[:, None], (HEIGHT, WIDTH))


def rims(depth: float) -> tuple[float, float]:
    """Radii in pixels within which an emitter at `depth` is whole for each point of a pixel, and beyond which none is seen."""
    disc = RADIUS * abs(depth - FOCUS) / (depth * FOCUS * SLOPE)
    edge = HALF / SLOPE * math.sqrt(2.0) + math.sqrt(0.5)
    return disc - edge, disc + edge


@pytest.mark.parametrize("x, y, depth", [(0.0, 0.0, 6.0), (0.5, -0.3, 5.0), (-0.05, 0.03, 1.3)])
def test_a_small_lamp_becomes_an_even_disc_of_the_right_size_and_energy(x, y, depth):
    spp = 400
    loop = render([rectangle(0, (x, y, -depth), scale=HALF * depth)], spp)
    image = loop.film.radiance().double().numpy()
    right, above = offsets(x, y, depth)
    distance = np.hypot(right, above)
    whole, none = rims(depth)
    assert whole > 4.0
    assert not image[distance > none].any()
    hits = image[..., 0] * spp
    np.testing.assert_allclose(hits, hits.round(), atol=1e-3)
    np.testing.assert_allclose(image[..., 1:], image[..., :1] * [2.0, 3.0], rtol=1e-5)
    # The emitter as it projects through a focus point covers the same share of the lens everywhere.
    inside = distance < whole
    share = (2.0 * HALF * depth) ** 2 * (FOCUS / (FOCUS - depth)) ** 2 / Lens(RADIUS, FOCUS).area
    assert chi_square(hits[inside], np.full(inside.sum(), 1.0 / inside.sum())) > SIGNIFICANCE
    error = math.sqrt(share * (1.0 - share) / (spp * inside.sum()))
    assert z_test(image[inside, 0].mean() - share, error) > SIGNIFICANCE
    # All its light: the area of its pinhole image.
    total = (2.0 * HALF / SLOPE) ** 2
    assert z_test(image[..., 0].sum() - total, np.sqrt(image[..., 0].sum() / spp)) > SIGNIFICANCE


def test_in_focus_the_lamp_is_as_sharp_as_through_a_pinhole():
    image = render([rectangle(0, (0.0, 0.0, -FOCUS), scale=0.25)], 4).film.radiance().numpy()
    right, above = offsets(0.0, 0.0, FOCUS)
    half = 0.25 / (FOCUS * SLOPE)
    inside = np.maximum(np.abs(right), np.abs(above)) < half - 0.5
    outside = np.maximum(np.abs(right), np.abs(above)) > half + 0.5
    assert inside.sum() > 50
    np.testing.assert_allclose(image[inside], [[1.0, 2.0, 3.0]] * inside.sum(), rtol=1e-6)
    assert not image[outside].any()


def card(side: float) -> Mesh:
    """A card close before the lens that hides its right half (1) or left half (-1)."""
    return rectangle(1, (side * 1.0, 0.0, -1e-5), scale=1.0)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_card_over_half_the_lens_takes_half_the_light(side):
    spp = 256
    loop = render([card(side)], spp, constant_sky(1.0))
    image = loop.film.radiance().double().numpy()[..., 0]
    assert z_test(image - 0.5, np.full_like(image, 0.5 / math.sqrt(spp))) > SIGNIFICANCE
    assert z_test(image.mean() - 0.5, 0.5 / math.sqrt(spp * image.size)) > SIGNIFICANCE


@pytest.mark.parametrize("depth", [6.0, 1.3])
def test_a_card_over_half_the_lens_halves_the_disc(depth):
    """Behind the focal plane the disc loses the covered side, before it the other one."""
    spp = 256
    light = rectangle(0, (0.0, 0.0, -depth), scale=HALF * depth)
    image = render([light, card(1.0)], spp).film.radiance().double().numpy()[..., 0]
    right, _ = offsets(0.0, 0.0, depth)
    dark = right > 0 if depth > FOCUS else right < 0
    edge = HALF / SLOPE + 0.5
    assert not image[dark & (np.abs(right) > edge)].any()
    total = (2.0 * HALF / SLOPE) ** 2 / 2.0
    assert z_test(image.sum() - total, np.sqrt(image.sum() / spp)) > SIGNIFICANCE


def test_alpha_is_the_share_of_the_lens_that_a_card_covers():
    spp = 256
    alpha = render([card(1.0)], spp).film.layers()["alpha"].astype(float)
    assert z_test(alpha - 0.5, np.full_like(alpha, 0.5 / math.sqrt(spp))) > SIGNIFICANCE
    assert z_test(alpha.mean() - 0.5, 0.5 / math.sqrt(spp * alpha.size)) > SIGNIFICANCE


def test_the_variance_layer_is_the_variance_of_the_image():
    """Over the even disc hits are binomial, which gives the variance of the mean."""
    spp = 400
    film = render([rectangle(0, (0.0, 0.0, -6.0), scale=HALF * 6.0)], spp).film
    inside = np.hypot(*offsets(0.0, 0.0, 6.0)) < rims(6.0)[0]
    share = (2.0 * HALF * 6.0) ** 2 * 0.25 / Lens(RADIUS, FOCUS).area
    luminance = 0.2126 + 2.0 * 0.7152 + 3.0 * 0.0722
    expected = luminance**2 * share * (1.0 - share) / spp
    found = film.layers()["variance"][inside].astype(float)
    assert z_test(found.mean() - expected, found.std() / math.sqrt(inside.sum())) > SIGNIFICANCE


def test_depth_is_measured_along_the_axis():
    layers = render([rectangle(0, (0.0, 0.0, -3.0), scale=50.0)], 2).film.layers()
    np.testing.assert_allclose(layers["depth"], 3.0, rtol=1e-5)
    np.testing.assert_array_equal(layers["alpha"], 1.0)
    np.testing.assert_allclose(layers["normal"], np.broadcast_to([0.0, 0.0, 1.0], (HEIGHT, WIDTH, 3)))
