"""Weights of emitters as proposals: radiance times the area of the outline, or the flux of an emitter of the map."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from bokehguide.color import LUMINANCE
from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.emitter_proposals import EmitterProposals, emitter_proposals
from bokehguide.models.ellipse_mixture import outline_areas, packed
from bokehguide.render.camera import ThinLensCamera
from bokehguide.scene.emitters import find_emitters
from bokehguide.scene.shapes import transform, transformed, unit_sphere
from bokehguide.scene.types import Camera, Environment, FilmSettings, Material, Mesh, Scene

WIDTH, HEIGHT = 64, 36
VIEW = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=70.0, aperture_radius=0.5, focus_distance=2.0)
RADIANCE = 7.0
DISC = (0.2, 0.2, 1e-3)
"""Half axes of a flat ellipsoid."""


def proposals(meshes: tuple[Mesh, ...], environment: Environment | None = None) -> EmitterProposals:
    materials = (Material("lamp", emission=(RADIANCE,) * 3),)
    scene = Scene("test", VIEW, meshes, materials, FilmSettings(WIDTH, HEIGHT), environment)
    return emitter_proposals(scene, find_emitters(scene), ThinLensCamera(VIEW, WIDTH, HEIGHT), GuidedConfig())


def ellipsoid(centre: tuple[float, float, float], half_axes: tuple[float, ...], angles: tuple[float, ...] = (0.0,) * 3) -> Mesh:
    return transformed(unit_sphere(4), transform(centre, angles, half_axes))


def seen_area(points: np.ndarray, centre: np.ndarray) -> float:
    """Area of the outline of points `[N, 3]`, moved along parallel lines of sight onto the plane through `centre`."""
    on_plane = points[:, :2] - (points[:, 2:] - centre[2]) * centre[:2] / centre[2]
    return ConvexHull(on_plane).volume


def surface_points(squares: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Random points `[N, 3]` on the ellipsoid with the matrix `squares` `[3, 3]` of squared half axes."""
    directions = np.random.default_rng(0).normal(size=(20000, 3))
    values, axes = np.linalg.eigh(squares)
    return centre + directions / np.linalg.norm(directions, axis=1, keepdims=True) * np.sqrt(values.clip(0.0)) @ axes.T


@pytest.mark.parametrize("length", [1e-12, 1.0, 1e16])
def test_areas_do_not_depend_on_the_unit(length):
    """Emitters at infinity have the place and the size of 1e5 focus distances."""
    outline = torch.tensor([0.3, 0.05, 0.02, 0.2, -0.1, 0.4])[:, None]
    mean = torch.tensor([0.4, -0.3, 2.0])[:, None]
    scaled = outline_areas(outline * length**2, mean * length)
    torch.testing.assert_close(scaled / length**2, outline_areas(outline, mean), rtol=1e-5, atol=0.0)


@pytest.mark.parametrize("seed", range(10))
def test_areas_are_those_of_projected_points(seed):
    """Of points on random ellipsoids, far from the axis as well."""
    rng = np.random.default_rng(seed)
    half_axes = rng.normal(size=(3, 3)) * rng.uniform(0.05, 1.0, 3)
    squares, centre = half_axes.T @ half_axes, np.append(rng.uniform(-1.0, 1.0, 2), 1.0) * rng.uniform(1.0, 9.0)
    area = float(outline_areas(packed(torch.from_numpy(squares)[None]), torch.from_numpy(centre)[:, None])[0])
    assert math.pi * area == pytest.approx(seen_area(surface_points(squares, centre), centre), rel=0.01)


EMITTERS = {
    "ball": ((0.5, 0.3, -6.0), (0.2, 0.2, 0.2), (0.0, 0.0, 0.0)),
    "disc": ((0.0, 0.0, -6.0), DISC, (0.0, 0.0, 0.0)),
    "turned disc": ((0.0, 0.0, -6.0), DISC, (0.0, 75.0, 0.0)),
    "disc at the side": ((3.0, 1.0, -6.0), DISC, (20.0, -60.0, 0.0)),
    "rod": ((0.3, 0.2, -6.0), (0.3, 0.04, 0.04), (0.0, 0.0, 30.0)),
    "rod along the line of sight": ((0.0, 0.0, -6.0), (0.3, 0.04, 0.04), (0.0, 90.0, 0.0)),
}


@pytest.mark.parametrize("name", EMITTERS)
def test_an_emitter_weighs_by_the_area_of_its_outline(name):
    """As the camera sees it. The outline contains all corners of the mesh, and is at most half as large again as the emitter."""
    mesh = ellipsoid(*EMITTERS[name])
    found = proposals((mesh,))
    assert len(found.field) == 1
    centre = found.field.mean[:, 0].double().numpy()
    xx, xy, xz, yy, yz, zz = found.outlines[:, 0].double().tolist()
    outline = seen_area(surface_points(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), centre), centre)
    emitter = seen_area(mesh.vertices * np.array([1.0, 1.0, -1.0]), centre)
    assert 0.98 * emitter <= outline <= 1.5 * emitter
    assert float(found.field.energy[0]) == pytest.approx(RADIANCE * outline / math.pi, rel=0.01)


@pytest.mark.parametrize("degrees", [0.0, 20.0])
def test_an_emitter_of_the_map_weighs_by_its_flux(degrees):
    """A slanted line of texels, which fills a small part of its cone, on the axis and beside it.

    The weight is that of the line's centre. On the lens, ends of a line cover more area than its centre.
    """
    radiance = np.full((64, 128, 3), 1e-3, np.float32)
    rows, columns = 29 + np.arange(7), 61 + np.arange(7)
    radiance[rows, columns] = 50.0
    found = proposals((), Environment(radiance, degrees))
    (of_map,) = np.flatnonzero(found.shapes.environment_index.numpy() >= 0)
    theta, phi = math.pi * (rows + 0.5) / 64, 2.0 * math.pi * (columns + 0.5) / 128 - math.pi
    directions = np.stack((np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)))
    cosine = abs(directions[2] * math.cos(math.radians(degrees)) + directions[0] * math.sin(math.radians(degrees)))
    solid_angles = np.sin(theta) * 2.0 * math.pi**2 / (64 * 128)
    flux = (50.0 * LUMINANCE.sum() * solid_angles / cosine**3).sum() * VIEW.focus_distance**2
    weight = found.field.lens_weights(VIEW.focus_distance)[of_map]
    assert float(weight) == pytest.approx(flux / math.pi, rel=0.04)
