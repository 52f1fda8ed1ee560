"""`find_emitters`: components that are parallelograms, and connected texels of an environment map."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from bokehguide.scene.emitters import find_emitters
from bokehguide.scene.shapes import joined, spheres, transform, transformed, unit_box, unit_rectangle
from bokehguide.scene.types import Camera, Environment, Material, Mesh, Scene

SHEARED = np.array([[1.0, 0.7, 0.0, 0.3], [0.1, 0.4, 0.0, -0.2], [0.0, 0.5, 1.0, -6.0], [0.0, 0.0, 0.0, 1.0]])
TURNED = transform((0.4, -0.3, -5.0), (20.0, 70.0, -10.0), (0.5, 0.02, 1.0))


def emitters_of(*meshes: Mesh, environment: Environment | None = None):
    materials = (Material("emitter", emission=(5.0, 5.0, 5.0)),)
    return find_emitters(Scene("test", Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0)), meshes, materials, environment=environment))


def flat(*corners: tuple[float, float], triangles=((0, 1, 2), (0, 2, 3))) -> Mesh:
    """A mesh of corners in the xy plane."""
    vertices = np.array([(x, y, -6.0) for x, y in corners], np.float32)
    return Mesh(vertices, np.array(triangles, np.int32), material=0)


@pytest.mark.parametrize("matrix", [TURNED, SHEARED], ids=["rectangle", "sheared"])
def test_half_edges_of_a_parallelogram_are_those_of_the_mesh(matrix):
    """Up to their order and signs: middle ± one ± the other are the corners."""
    mesh = transformed(unit_rectangle(), matrix)
    emitters = emitters_of(mesh)
    assert len(emitters.half_edges) == 1
    right, up = emitters.half_edges[0]
    np.testing.assert_allclose(emitters.centres[0], matrix[:3, 3], atol=1e-6)
    found = emitters.centres[0] + np.array([a * right + b * up for a in (-1, 1) for b in (-1, 1)])
    np.testing.assert_allclose(sorted(found.tolist()), sorted(mesh.vertices.tolist()), atol=1e-5)
    own = np.abs(matrix[:3, :2].T)
    assert any(np.allclose(np.abs(emitters.half_edges[0]), own[list(order)], atol=1e-5) for order in permutations(range(2)))


DIAGONALS = [((0, 1, 2), (0, 2, 3)), ((1, 2, 3), (3, 0, 1)), ((2, 0, 1), (3, 2, 0)), ((0, 1, 2), (2, 0, 3))]


@pytest.mark.parametrize("diagonal", DIAGONALS)
def test_a_parallelogram_may_have_either_diagonal(diagonal):
    """And its corners be listed from any of them, either way round."""
    parallelogram = emitters_of(flat((0.0, 0.0), (2.0, 0.5), (2.3, 1.5), (0.3, 1.0), triangles=diagonal)).half_edges[0]
    sides = {tuple(np.abs(edge).round(5).tolist()) for edge in parallelogram}
    assert sides == {(1.0, 0.25, 0.0), (0.15, 0.5, 0.0)}


def test_triangles_of_a_parallelogram_may_have_their_own_vertices():
    apart = flat((0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 0.0), (2.0, 1.0), (0.0, 1.0), triangles=((0, 1, 2), (3, 4, 5)))
    assert emitters_of(apart).half_edges[0].any()


BENT = np.array([(0, 0, -6), (1, 0, -6), (1, 1, -5.7), (0, 1, -6)], np.float32)
OTHER_SHAPES = {
    "trapezoid": flat((0.0, 0.0), (2.0, 0.0), (1.5, 1.0), (0.5, 1.0)),
    "kite": flat((0.0, 0.0), (1.0, -0.5), (3.0, 0.0), (1.0, 0.5)),
    "nearly a parallelogram": flat((0.0, 0.0), (1.0, 0.0), (1.002, 1.0), (0.0, 1.0)),
    "folded": Mesh(BENT, unit_rectangle().triangles, material=0),
    "box": transformed(unit_box(), TURNED),
    "ball": spheres([[0.0, 0.0, -6.0]], 0.05, 0),
    "triangle": flat((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), triangles=((0, 1, 2),)),
    "triangles apart": flat((0, 0), (1, 0), (1, 1), (2, 0), (3, 1), (2, 1), triangles=((0, 1, 2), (3, 4, 5))),
    "triangles that share a corner": flat((0, 0), (1, 0), (1, 1), (-1, 0), (-1, -1), triangles=((0, 1, 2), (0, 3, 4))),
    "a triangle and its back": flat((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), triangles=((0, 1, 2), (0, 2, 1))),
    "three triangles": flat((0, 0), (1, 0), (1, 1), (0, 1), (-1, 1), triangles=((0, 1, 2), (0, 2, 3), (0, 3, 4))),
}


@pytest.mark.parametrize("name", OTHER_SHAPES)
def test_other_shapes_have_no_half_edges(name):
    emitters = emitters_of(OTHER_SHAPES[name])
    assert len(emitters.half_edges) == (2 if name == "triangles apart" else 1)
    assert not emitters.half_edges.any()


def test_parallelograms_among_other_components_of_a_mesh():
    """Each emitter has its own half edges, and none the half edges of another."""
    parallelograms = (transformed(unit_rectangle(), TURNED), flat((5, 0), (7, 0), (7, 1), (5, 1)))
    pieces = [OTHER_SHAPES["ball"], parallelograms[0], OTHER_SHAPES["trapezoid"], parallelograms[1]]
    bare = [Mesh(piece.vertices, piece.triangles, material=0) for piece in pieces]
    emitters = emitters_of(joined(bare), unit_rectangle())
    order = np.argsort(emitters.centres[:4, 0])  # ball, parallelogram, trapezoid, parallelogram from left to right
    assert [bool(emitters.half_edges[number].any()) for number in order] == [False, True, False, True]
    np.testing.assert_allclose(np.sort(np.abs(emitters.half_edges[order[3]]).sum(1)), (0.5, 1.0), atol=1e-6)
    np.testing.assert_allclose(np.abs(emitters.half_edges[4]).sum(1), 1.0, atol=1e-6)


def texels_of(*bright: tuple[int, int], height: int = 32) -> np.ndarray:
    """The emitters' numbers at these texels of a map of which nothing else is bright."""
    radiance = np.full((height, 2 * height, 3), 0.01, np.float32)
    for row, column in bright:
        radiance[row, column] = 100.0
    emitters = emitters_of(unit_rectangle(), environment=Environment(radiance))
    numbers = emitters.texel_emitters[tuple(np.array(bright).T)]
    assert (emitters.texel_emitters >= 0).sum() == len(bright) and set(numbers) == set(np.flatnonzero(emitters.infinite))
    return numbers


TOUCHING = [((5, 9), (5, 10)), ((5, 9), (6, 10)), ((6, 9), (5, 10)), ((5, 63), (5, 0)), ((5, 63), (6, 0)), ((6, 63), (5, 0))]
APART = [((5, 9), (5, 11)), ((5, 9), (7, 10)), ((5, 63), (5, 1)), ((5, 63), (7, 0)), ((0, 63), (31, 0)), ((31, 63), (0, 0))]


@pytest.mark.parametrize("pair", TOUCHING)
def test_texels_that_touch_are_one_emitter(pair):
    """At a side or at a corner, across the edge of the map as well."""
    first, second = texels_of(*pair)
    assert first == second == 1  # 0 is the rectangle


@pytest.mark.parametrize("pair", APART)
def test_separate_texels_are_two_emitters(pair):
    """The map's top does not touch its bottom."""
    first, second = texels_of(*pair)
    assert {first, second} == {1, 2}


def test_meshes_that_touch_are_apart():
    """Each emissive mesh has its own emitters and luminance, also beside one that does not emit."""
    square = flat((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))
    meshes = [replace(square, material=number) for number in (0, 1, 2)] + [replace(square, material=0)]
    materials = tuple(Material(name, emission=(value,) * 3) for name, value in (("dim", 5.0), ("dark", 0.0), ("bright", 7.0)))
    emitters = find_emitters(Scene("test", Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0)), meshes, materials))
    assert emitters.triangle_emitters.tolist() == [0, 0, -1, -1, 1, 1, 2, 2]
    assert emitters.luminance.tolist() == pytest.approx([5.0, 7.0, 5.0])
