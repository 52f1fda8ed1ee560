"""The pilot of `guided_thinlens`: large pixels, and the gain that their samples tell."""

import math

import numpy as np
import pytest
import torch

pytest.importorskip("mitsuba")
import mitsuba as mi

mi.set_variant("scalar_rgb")
MITSUBA_VARIANT = "scalar_rgb"

from bokehguide.mitsuba.frame import Frame
from bokehguide.mitsuba.lens import GuidedLens, LensSamples
from bokehguide.mitsuba.pilot import error_ratio, large_pixels
from bokehguide.render.camera import ThinLensCamera
from bokehguide.scene.types import Camera, FilmSettings, Material, Mesh, Scene

CAMERA = Camera((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), fov=50.0, aperture_radius=0.1, focus_distance=2.0)
SMALL, BLEND = 0.05, 0.6
"""Part of the lens that sees a highlight, and part of the samples that are drawn there."""


@pytest.fixture(scope="module")
def emitters():
    """A black triangle, as wide as a hair, and a lamp."""
    black = Mesh(np.array([[0, 0, -1], [1e-6, 0, -1], [0, 1e-6, -1]], np.float32), np.array([[0, 1, 2]], np.int32), 0)
    lamp = Mesh(np.array([[0, 0, 9], [0.1, 0, 9], [0, 0.1, 9]], np.float32), np.array([[0, 2, 1]], np.int32), 1)
    materials = Material("black", (0.0, 0.0, 0.0)), Material("lamp", (0.0, 0.0, 0.0), emission=(9.0, 9.0, 9.0))
    return Scene("emitters", CAMERA, (black, lamp), materials, FilmSettings(45, 31))


def drawn(shape: tuple[int, int, int], blend: float) -> tuple[LensSamples, np.ndarray]:
    """Samples of a mixture on a lens of length 1 and their radiance: 1 / SMALL up to SMALL, so that the mean is 1."""
    random = np.random.default_rng(1)
    place = random.random(shape) * np.where(random.random(shape) < blend, SMALL, 1.0)
    inside = place < SMALL
    weight = 1.0 / (1.0 - blend + inside * blend / SMALL)
    empty = np.zeros((2, inside.size))
    return LensSamples(empty, empty, weight.ravel(), True), (inside / SMALL).ravel()


def test_the_gain_in_closed_form():
    """Variances 1 / SMALL - 1 and 1 / (β + SMALL (1 - β)) - 1."""
    shape = (64, 50, 51)
    variances = 1.0 / SMALL - 1.0, 1.0 / (BLEND + SMALL * (1.0 - BLEND)) - 1.0
    assert error_ratio(*drawn(shape, BLEND), shape) == pytest.approx(math.sqrt(variances[0] / variances[1]), rel=0.03)
    assert error_ratio(*drawn(shape, 0.0), shape) == pytest.approx(1.0)


@pytest.mark.parametrize("cell", [2, 4, 7])
def test_large_pixels_see_what_the_frame_sees(cell, emitters):
    """Equal slopes at equal places, over the whole crop."""
    rows, columns = np.mgrid[5:23, 11:40]
    frame = Frame(CAMERA, np.eye(4), 0, 45, 31, (rows * 45 + columns).ravel(), (11, 5), (29, 18))
    scene, down, across, start = large_pixels(emitters, frame, cell)
    film, fine = scene.film, ThinLensCamera(CAMERA, 45, 31)
    large = ThinLensCamera(scene.camera, film.width, film.height)
    assert (film.width, film.height) == (math.ceil(45 / cell), math.ceil(31 / cell))
    places = torch.rand(2, 20, generator=torch.Generator().manual_seed(0)) * 5.0
    there = places * cell + torch.from_numpy(start)
    np.testing.assert_allclose(large.slopes(places), fine.slopes(there), atol=1e-5)
    for numbers, first, (low, high) in zip((across, down), start.ravel(), ((11, 40), (5, 23))):
        ends = numbers[0] * cell + first, (numbers[-1] + 1) * cell + first
        assert low - cell < ends[0] <= low + 0.5 and high - 0.5 <= ends[1] < high + cell


def test_the_last_epoch_is_not_learned(emitters):
    """Nothing is drawn after the last epoch of a render."""
    with GuidedLens(emitters, np.arange(45 * 31), "guided", 0) as lens:
        learned, step = [], 0
        while step < 16:
            samples = lens.draw(16 - step)
            count = len(samples.weight) // (45 * 31)
            learned += [samples.learned] * count
            step += count
    assert learned == [True] * 8 + [False] * 8


def test_pixels_near_highlights_are_guided(emitters):
    """The lamp is near the middle of the frame; pixels at its left edge do not see it."""
    with GuidedLens(emitters, np.arange(45 * 31), "guided", 0) as lens:
        guided = lens.guided().reshape(31, 45)
        lens.restrict(np.flatnonzero(guided.ravel()))
        assert len(lens.draw(4).weight) == guided.sum()
    assert guided[15, 22] and not guided[:, 0].any()


def test_restricted_pixels_get_other_random_numbers(emitters):
    """The choice of the pixels depends on earlier film positions, from which later ones would follow."""
    pixels, places = np.arange(45 * 31), []
    for restricts in (False, False, True):
        with GuidedLens(emitters, pixels, "guided", 0) as lens:
            lens.draw(64)
            if restricts:
                lens.restrict(pixels)
            places.append(lens.draw(63).raster)
    np.testing.assert_array_equal(places[0], places[1])
    assert (places[0] == places[2]).mean() < 0.01
