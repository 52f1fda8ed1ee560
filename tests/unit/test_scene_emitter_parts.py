"""Compact parts of emissive meshes: which components are divided, and the proposals that result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.emitter_proposals import emitter_proposals
from bokehguide.render.camera import ThinLensCamera
from bokehguide.scene import emitters as emitters_module
from bokehguide.scene.emitter_parts import (
    FEWEST_TRIANGLES,
    MOST_ELONGATED,
    MOST_EMPTY,
    MOST_PARTS,
    compact_parts,
    emptiness,
    shapes,
)
from bokehguide.scene.emitters import find_emitters
from bokehguide.scene.shapes import joined, spheres, transform, transformed, unit_box, unit_rectangle
from bokehguide.scene.types import Mesh, Scene
from bokehguide.train import RenderLoop, RenderSettings
from tests.support import scenes
from tests.support.render_checks import estimate
from tests.support.statistical import SIGNIFICANCE


def tube(path: np.ndarray, radius: float = 0.03, sides: int = 12) -> Mesh:
    """An open tube along points `[N, 3]` of the xy plane."""
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    beside = np.cross(along, (0.0, 0.0, 1.0))
    angles = 2.0 * np.pi * np.arange(sides) / sides
    across = np.cos(angles)[:, None] * beside[:, None] + np.sin(angles)[:, None] * np.array((0.0, 0.0, 1.0))
    vertices = (path[:, None] + radius * across).reshape(-1, 3)
    segment, side = np.meshgrid(np.arange(len(path) - 1), np.arange(sides), indexing="ij")
    one, other = segment * sides + side, segment * sides + (side + 1) % sides
    triangles = np.concatenate((np.stack((one, other, other + sides), -1), np.stack((one, other + sides, one + sides), -1)))
    return Mesh(vertices.astype(np.float32), triangles.reshape(-1, 3).astype(np.int32), material=0)


def arc(points: int = 97, turn: float = 2.0 * np.pi) -> np.ndarray:
    angle = np.linspace(0.0, turn, points)
    return np.stack((np.cos(angle), np.sin(angle), np.zeros(points)), axis=1)


def straight(length: float) -> Mesh:
    x = np.linspace(0.0, length, 65)
    return tube(np.stack((x, np.zeros(65), np.zeros(65)), axis=1))


def hairpin() -> Mesh:
    """Two legs beside each other, with a bend at one end. A plane across both legs leaves two ends that do not connect."""
    leg = np.linspace(0.0, 3.0, 40)
    bend = 0.2 * arc(12, np.pi)[:, [1, 0, 2]] * (1.0, -1.0, 1.0) + (3.0, 0.0, 0.0)
    one, other = (np.stack((leg, np.full(40, y), np.zeros(40)), axis=1) for y in (-0.2, 0.2))
    return tube(np.concatenate((one, bend[1:-1], other[::-1])), 0.05)


DIVIDED: dict[str, Callable[[], Mesh]] = {"ring": lambda: tube(arc()), "hairpin": hairpin, "rod": lambda: straight(4.0)}


def shape(mesh: Mesh, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radii `[N]` and ellipsoids `[N, 3, 3]` of the parts."""
    parts = shapes(mesh, labels)
    return parts.radii, parts.ellipsoids


@pytest.mark.parametrize("name", DIVIDED)
def test_parts_are_compact(name):
    mesh = DIVIDED[name]()
    labels = compact_parts(mesh, MOST_PARTS)[0]
    radii, ellipsoids = shape(mesh, labels)
    squares = np.linalg.eigvalsh(ellipsoids)
    large = np.bincount(labels) >= FEWEST_TRIANGLES
    assert 4 <= len(radii) <= 128 and large.mean() > 0.9
    assert (emptiness(ellipsoids, radii)[large] <= MOST_EMPTY).all()
    assert (squares[large, 2] <= MOST_ELONGATED**2 * squares[large, 1]).all()


@pytest.mark.parametrize("name", DIVIDED)
def test_triangles_of_a_part_connect(name):
    mesh = DIVIDED[name]()
    labels = compact_parts(mesh, MOST_PARTS)[0]
    for part in range(labels.max() + 1):
        triangles = mesh.triangles[labels == part]
        edges = triangles[:, [0, 1, 1, 2]].reshape(-1, 2)
        assert len(trimesh.graph.connected_components(edges, nodes=np.unique(triangles))) == 1


WHOLE = {
    "ball": lambda: spheres([[0.0, 0.0, -6.0]], 0.05, 0),
    "box": unit_box,
    "short tube": lambda: straight(0.15),
    "plate": lambda: transformed(unit_rectangle(), transform((0.0, 0.0, 0.0), scale=(50.0, 1.0, 1.0))),
}


@pytest.mark.parametrize("name", WHOLE)
def test_compact_components_and_those_of_few_triangles_stay_whole(name):
    mesh = joined([WHOLE[name](), transformed(WHOLE[name](), transform((0.0, 90.0, 0.0)))])
    labels = compact_parts(mesh, MOST_PARTS)[0]
    half = len(labels) // 2
    assert set(labels[:half]) == {0} and set(labels[half:]) == {1}


def test_the_number_of_parts_is_limited(monkeypatch):
    """For all meshes together."""
    mesh, many = tube(arc()), len(np.unique(compact_parts(tube(arc()), MOST_PARTS)[0]))
    for most in (1, 2, 7):
        assert 1 <= len(np.unique(compact_parts(mesh, most)[0])) <= most
    monkeypatch.setattr(emitters_module, "MOST_PARTS", many + 5)
    scene = replace(scenes.emitters(8, 8), meshes=(mesh, tube(arc(), 0.05)), environment=None)
    assert many < len(find_emitters(scene).radii) <= many + 5


def test_triangles_at_one_place_are_not_divided():
    vertices = np.array([(-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1e-4, 0.0)], np.float32)
    mesh = Mesh(vertices, np.tile(np.array([[0, 1, 2]], np.int32), (40, 1)), material=0)
    assert set(compact_parts(mesh, MOST_PARTS)[0]) == {0}


def ring_scene(width: int, height: int) -> Scene:
    """A ring of a diameter of 1 m behind the focal plane."""
    ring = transformed(tube(arc()), transform((0.0, 0.0, -5.0), (30.0, 0.0, 0.0), 0.5))
    lamp = replace(scenes.LAMP, emission=(0.7, 0.6, 0.5))
    return replace(scenes.emitters(width, height), meshes=(replace(ring, material=0),), materials=(lamp,))


def test_a_ring_has_proposals_along_its_light():
    """The light of all triangles is that of proposals, and each ball contains its part of the ring."""
    scene = ring_scene(64, 36)
    emitters, camera = find_emitters(scene), ThinLensCamera(scene.camera, 64, 36)
    found = emitter_proposals(scene, emitters, camera, GuidedConfig())
    assert len(found.field) == len(emitters.radii) >= 8 and bool(found.triangles[:-1].all())
    centre = found.field.mean * torch.tensor([[1.0], [1.0], [-1.0]])
    corners = torch.from_numpy(scene.meshes[0].vertices[scene.meshes[0].triangles])
    own = centre.T[emitters.triangle_emitters]
    reach = (corners - own[:, None]).norm(dim=2).amax(1)
    assert bool((reach <= found.field.radius[emitters.triangle_emitters]).all())


def test_outlines_as_large_as_the_lens_are_no_proposals():
    """The same ring with two fifths of the aperture: all parts are narrower than three lens radii."""
    scene = ring_scene(64, 36)
    narrow = replace(scene, camera=replace(scene.camera, aperture_radius=0.4 * scene.camera.aperture_radius))
    emitters, camera = find_emitters(narrow), ThinLensCamera(narrow.camera, 64, 36)
    found = emitter_proposals(narrow, emitters, camera, GuidedConfig())
    away = np.abs(-emitters.centres[:, 2] - scene.camera.focus_distance)
    reach = emitters.bounding_radii * scene.camera.focus_distance / away
    assert (reach < 2.9 * narrow.camera.aperture_radius).all()
    assert len(found.field) == 0 and not found.triangles[:-1].any()


@pytest.mark.slow
def test_means_of_a_ring_are_those_of_the_uniform_lens():
    scene = ring_scene(128, 72)
    uniform = estimate(RenderLoop(scene, RenderSettings("uniform", 1024)), 1024)
    guided = estimate(RenderLoop(scene, RenderSettings("guided", 64)), 64)
    assert guided.last.gaussians >= 8 and guided.last.outside > 0.0
    assert guided.p_value(uniform.mean, uniform.variance, (4, 8)) > SIGNIFICANCE
