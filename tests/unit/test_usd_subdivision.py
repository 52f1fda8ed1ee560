"""Catmull-Clark surfaces of USD against closed forms: cubic splines, the refined cube, creases and corners."""

import numpy as np
import pytest

pytest.importorskip("pxr")

from pxr import Gf, Sdf

from bokehguide.scene.shapes import surface_area
from tests.support.usd_stages import add_mesh, add_primvar, loaded, new_stage, textured

TYPES = Sdf.ValueTypeNames


def grid(height) -> tuple[list, list, list]:
    """A grid of 8 × 8 squares with z = height(x, y): points, counts, indices."""
    points = [(x, y, height(x, y)) for y in range(9) for x in range(9)]
    starts = [9 * y + x for y in range(8) for x in range(8)]
    return points, [4] * 64, [n for start in starts for n in (start, start + 1, start + 10, start + 9)]


@pytest.mark.parametrize("level", [1, 2, 3])
def test_subdivision_of_a_grid_is_the_cubic_spline(level, tmp_path, monkeypatch):
    """Uniform cubic B-splines of x² are x² + 1/3, and the control points after n refinements are x² + (1 - 4^-n) / 3."""
    monkeypatch.setattr("bokehguide.scene.usd.surfaces.MAX_LEVEL", level)
    stage = new_stage()
    points, counts, indices = grid(lambda x, y: x * x + 2.0 * y)
    add_mesh(stage, "/mesh", points, counts, indices, "catmullClark")
    scene = loaded(stage, tmp_path)
    vertices = scene.meshes[0].vertices
    inner = vertices[((vertices[:, :2] > 2.0) & (vertices[:, :2] < 6.0)).all(axis=1)]
    x, y, z = inner.T.astype(np.float64)
    np.testing.assert_allclose(z, x * x + 2.0 * y + (1.0 - 4.0**-level) / 3.0, atol=1e-4)
    assert len(scene.meshes[0].triangles) == 64 * 4**level * 2 and scene.warnings == ()
    assert vertices[:, :2].min() == 0 and vertices[:, :2].max() == 8, "the corners of the boundary stay"
    slopes = np.stack([-2.0 * x, np.full_like(x, -2.0), np.ones_like(x)])
    normals = scene.meshes[0].normals[((vertices[:, :2] > 2.0) & (vertices[:, :2] < 6.0)).all(axis=1)]
    np.testing.assert_allclose(normals, (slopes / np.linalg.norm(slopes, axis=0)).T, atol=0.02)


BOX = [(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]
BOX_FACES = [0, 2, 3, 1, 4, 5, 7, 6, 0, 1, 5, 4, 2, 6, 7, 3, 0, 4, 6, 2, 1, 3, 7, 5]


def box_mesh(stage):
    return add_mesh(stage, "/box", BOX, [4] * 6, BOX_FACES, "catmullClark")


def test_the_first_refinement_of_a_cube(tmp_path, monkeypatch):
    """Corners at 5/9, edges at 3/4, faces at 1."""
    monkeypatch.setattr("bokehguide.scene.usd.surfaces.MAX_LEVEL", 1)
    stage = new_stage()
    box_mesh(stage)
    vertices = np.abs(loaded(stage, tmp_path).meshes[0].vertices)
    found = {tuple(np.sort(vertex).astype(float).round(5)) for vertex in vertices}
    assert found == {(0.0, 0.0, 1.0), (0.0, 0.75, 0.75), (0.55556, 0.55556, 0.55556)} and len(vertices) == 26


def test_infinitely_sharp_edges_keep_a_cube(tmp_path):
    stage = new_stage()
    mesh = box_mesh(stage)
    edges = [(0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7)]
    mesh.CreateCreaseIndicesAttr([n for edge in edges for n in edge])
    mesh.CreateCreaseLengthsAttr([2] * 12)
    mesh.CreateCreaseSharpnessesAttr([10.0] * 12)
    found = loaded(stage, tmp_path).meshes[0]
    assert surface_area(found) == pytest.approx(24.0) and np.abs(found.vertices).max(axis=1) == pytest.approx(1.0)
    assert np.abs(found.normals).max(axis=1) == pytest.approx(1.0), "the normals are those of the faces"
    mesh.CreateCreaseSharpnessesAttr([1.0] * 12)
    assert 9.0 < surface_area(loaded(stage, tmp_path).meshes[0]) < 23.0


def test_a_sharp_corner_stays(tmp_path):
    stage = new_stage()
    mesh = box_mesh(stage)
    mesh.CreateCornerIndicesAttr([7])
    mesh.CreateCornerSharpnessesAttr([10.0])
    vertices = loaded(stage, tmp_path).meshes[0].vertices
    assert vertices.max(axis=0) == pytest.approx((1, 1, 1)) and vertices.min(axis=0) == pytest.approx([-1] * 3, abs=0.3)
    assert np.abs(vertices.min(axis=0)).max() < 0.9


@pytest.mark.parametrize("interpolation", ["faceVarying", "vertex"])
def test_texture_coordinates_of_subdivided_faces(interpolation, tmp_path):
    stage = new_stage()
    points, counts, indices = grid(lambda x, y: 0.0)
    mesh = add_mesh(stage, "/mesh", points, counts, indices, "catmullClark")
    owners = indices if interpolation == "faceVarying" else range(len(points))
    uvs = [Gf.Vec2f(points[n][0] / 8, points[n][1] / 8) for n in owners]
    add_primvar(mesh, "st", TYPES.TexCoord2fArray, uvs, interpolation)
    textured(stage, mesh, tmp_path, "st")
    found = loaded(stage, tmp_path).meshes[0]
    u, v = found.uvs[:, 0].T
    inner = ((found.vertices[:, :2] > 1) & (found.vertices[:, :2] < 7)).all(axis=1)
    np.testing.assert_allclose(u[inner], found.vertices[inner, 0] / 8, atol=1e-6)
    np.testing.assert_allclose(v[inner], 1 - found.vertices[inner, 1] / 8, atol=1e-6)


def test_a_crease_splits_the_normals_of_a_roof(tmp_path):
    """The corners at a vertex share a normal on each side of a crease along x = 4, and only there."""
    stage = new_stage()
    points, counts, indices = grid(lambda x, y: -abs(x - 4.0) - 0.1 * y * y)
    mesh = add_mesh(stage, "/mesh", points, counts, indices, "catmullClark")
    mesh.CreateCreaseIndicesAttr([9 * y + 4 for y in range(9)])
    mesh.CreateCreaseLengthsAttr([9])
    mesh.CreateCreaseSharpnessesAttr([10.0])
    found = loaded(stage, tmp_path).meshes[0]
    sides = np.sign(found.vertices[found.triangles].mean(axis=1)[:, 0] - 4.0)
    normals: dict[tuple, set] = {}
    for triangle, side in zip(found.triangles, sides, strict=True):
        for vertex in triangle:
            key = *found.vertices[vertex].round(4).tolist(), side
            normals.setdefault(key, set()).add(tuple(found.normals[vertex].round(4).tolist()))
    assert all(len(shared) == 1 for shared in normals.values())
    ridge = [(side, *shared) for (x, _, _, side), shared in normals.items() if x == 4.0]
    assert len(ridge) == 2 * 65 and all(side * x > 0.3 for side, (x, _, _) in ridge)


def test_other_schemes_are_drawn_as_their_control_mesh(tmp_path):
    stage = new_stage()
    add_mesh(stage, "/mesh", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], (3,), scheme="loop")
    scene = loaded(stage, tmp_path)
    assert len(scene.meshes[0].triangles) == 1 and scene.meshes[0].normals is not None
    assert any("subdivision surfaces (loop): drawn as their control meshes" in line for line in scene.warnings)
