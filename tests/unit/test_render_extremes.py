"""Geometry and films at their limits: triangles and emitters without an area, slivers, tiny emitters, sums that overflow."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from bokehguide.errors import BokehguideError
from bokehguide.render.film import Film, FilmSamples
from bokehguide.scene import Overrides, summarize
from bokehguide.scene.cameras import read_camera
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.types import Mesh
from bokehguide.scene.validation import checked
from bokehguide.train import RenderLoop, RenderSettings
from tests.support.scenes import emitters
from tests.support.statistical import SIGNIFICANCE
from tests.support.tracing import UP, emitter, estimates, matte, mean_test, rectangle, scene, sky, sphere, trace

LINE = np.array([[0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [2.0, 1.0, 0.0]], np.float32)
FLOOR = rectangle(0, rotate=UP, scale=10.0)
DOWNWARDS = ((0.3, 0.5, 0.2), (0.0, -1.0, 0.0))
"""A ray to the floor."""


def flat_lamp() -> Mesh:
    """An emitter of two triangles without an area: a line and a point."""
    return Mesh(np.concatenate((LINE, LINE[:1])), np.array([[0, 1, 2], [3, 3, 3]], np.int32), 1)


def test_triangles_without_an_area_are_left_out():
    """Beside others they change nothing."""
    whole = scene([FLOOR, rectangle(1, (0.0, 2.0, 0.0), (90.0, 0.0, 0.0))], [matte(), emitter()])
    spoilt = Mesh(FLOOR.vertices, np.concatenate((FLOOR.triangles, [[1, 1, 2], [0, 0, 0]])).astype(np.int32), 0)
    kept = checked(replace(whole, meshes=(spoilt, whole.meshes[1])), "here")
    assert len(kept.meshes[0].triangles) == 2 and kept.warnings == ()
    np.testing.assert_array_equal(estimates(kept, *DOWNWARDS, 100), estimates(whole, *DOWNWARDS, 100))


def test_a_lamp_without_an_area_is_told_of():
    kept = checked(scene([FLOOR, flat_lamp()], [matte(), emitter()]), "here")
    assert kept.warnings == ("material emitter: emits, but from no triangle with an area",)
    assert "ignored:      material emitter: emits" in summarize(kept)
    assert len(kept.meshes) == 1 and not estimates(kept, *DOWNWARDS, 100).any()


def test_a_scene_without_an_area_is_refused():
    with pytest.raises(BokehguideError, match="here: holds no triangle with an area; add"):
        checked(scene([replace(flat_lamp(), material=0)], [matte()]), "here")


def test_a_sliver_that_shines():
    """An emitter 2 m long and 10 µm wide: E = ∫ L cos cos / d² over it, known from quadrature."""
    half, width, height = 1.0, 1e-5, 1.0
    corners = np.array([[-half, height, 0], [half, height, 0], [half, height, width], [-half, height, width]], np.float32)
    strip = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), 1)
    found = checked(scene([FLOOR, strip], [matte(), emitter()]), "here")
    x = np.linspace(-half, half, 20_001)
    irradiance = np.trapezoid(height**2 / (x * x + height**2) ** 2, x) * (corners[2, 2] - corners[0, 2])
    samples = estimates(found, (0.0, 0.5, 0.0), (0.0, -1.0, 0.0))
    assert mean_test(samples, 0.5 / math.pi * irradiance * np.array((1.0, 2.0, 3.0)), 1e-3) > SIGNIFICANCE


@pytest.mark.parametrize("radius", [1e-2, 1e-5])
def test_a_lamp_of_hardly_any_size(radius):
    """A sphere of radiance 1 / r² lights what is 2 m below it as an emitter of that power does, however small it is."""
    spot = emitter(1.0 / radius**2)
    found = checked(scene([FLOOR, sphere(1, (0.3, 2.0, 0.2), radius)], [matte(), spot]), "here")
    samples = estimates(found, *DOWNWARDS)
    assert np.isfinite(samples).all()
    assert mean_test(samples, 0.5 / 4.0 * np.array((1.0, 2.0, 3.0)), 5e-3) > SIGNIFICANCE


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (0.3, 0.0, 0.2), (0.0, 1.0, 0.0)])
def test_rays_that_begin_on_a_surface(origin):
    """On a wall, and on an emitter: numbers all of them."""
    found = scene([FLOOR, rectangle(1, (0.0, 1.0, 0.0), (90.0, 0.0, 0.0))], [matte(), emitter()], sky(0.1))
    for direction in ((0.0, -1.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)):
        samples = trace(found, origin, direction, 500)
        assert all(bool(getattr(samples, name).isfinite().all()) for name in ("radiance", "distance", "normal"))


def test_sums_of_squares_beyond_single_precision():
    """Radiance of 1e25 twice: the mean is exact, and the variance of what differs ends at the largest float32."""
    film = Film(2, 1)
    for step, radiance in enumerate((1e25, 3e25), 1):
        colors = torch.tensor([[radiance, 1.0]]).expand(3, 2)
        zeros = torch.zeros(3, 2)
        film.add(slice(None), FilmSamples(torch.ones(2), colors, torch.ones(2), torch.ones(2), zeros, zeros, zeros), step)
    layers = film.layers()
    np.testing.assert_allclose(layers["beauty"][0, :, 0], (2e25, 1.0), rtol=1e-6)
    assert layers["variance"][0, 0] == np.finfo(np.float32).max and layers["variance"][0, 1] == 0.0
    assert film.bad_count == 0 and math.isfinite(film.relative_noise())


@pytest.mark.parametrize("size", [1e-9, 1e-6, 1.0, 1e6])
def test_cameras_of_any_size(size):
    """What counts is whether single precision tells position and target apart where they are."""
    camera = read_camera({"position": [0.0, 0.0, 0.0], "target": [0.0, 0.0, -size]}, "here", SceneFiles(Path()))
    assert camera.focus_distance == size
    with pytest.raises(BokehguideError, match=r"here: camera.target: .* equals position"):
        read_camera({"position": [size, 0.0, 0.0], "target": [size * (1.0 + 1e-8), 0.0, 0.0]}, "here", SceneFiles(Path()))


def test_infinity_is_a_focus_distance():
    values = {"position": [0.0, 0.0, 0.0], "target": [0.0, 0.0, -1.0], "aperture_radius": 0.1, "focus_distance": math.inf}
    camera = read_camera(values, "here", SceneFiles(Path()))
    found = replace(scene([FLOOR, sphere(1, (0.0, 0.1, -5.0), 0.1)], [matte(), emitter()]), camera=camera)
    assert "focused at infinity" in summarize(found)
    assert "% of the lens" in summarize(found)
    for wrong in (-math.inf, math.nan, 10**400):
        with pytest.raises(BokehguideError, match=r"here: camera.focus_distance: .* out of range; give metres .* or inf"):
            read_camera(values | {"focus_distance": wrong}, "here", SceneFiles(Path()))


@pytest.mark.parametrize("focus", [1e-18, 0.9e-9])
def test_a_focus_within_the_lens_is_out_of_range(focus):
    """Nearer focus makes slopes of rays whose squares overflow."""
    values = {"position": [0.0, 0.0, 0.0], "target": [0.0, 0.0, -1.0], "aperture_radius": 0.1}
    with pytest.raises(
        BokehguideError, match=r"here: camera.focus_distance: .* out of range; give metres above 0, between 1e-09"
    ):
        read_camera(values | {"focus_distance": focus}, "here", SceneFiles(Path()))
    with pytest.raises(BokehguideError, match=r"--focus-distance: .* out of range"):
        Overrides(focus_distance=focus)


@pytest.mark.parametrize("mode", ["uniform", "guided"])
def test_the_nearest_focus_renders_a_finite_picture(mode):
    scene = emitters(32, 20)
    loop = RenderLoop(replace(scene, camera=replace(scene.camera, focus_distance=1e-9)), RenderSettings(mode, threads=1))
    for _ in range(3):
        loop.step()
    assert all(np.isfinite(layer).all() for layer in loop.film.layers().values()) and loop.film.bad_count == 0
