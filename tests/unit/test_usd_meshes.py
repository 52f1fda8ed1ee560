"""Meshes and shapes of USD: polygons, primvars of every interpolation, subsets, and areas against closed forms."""

import math

import numpy as np
import pytest

pytest.importorskip("pxr")

from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from bokehguide.scene.shapes import surface_area
from bokehguide.scene.usd.polygons import triangulate
from tests.support.usd_stages import SQUARE, add_mesh, add_primvar, corners, facing, loaded, new_stage, textured

TYPES = Sdf.ValueTypeNames
PAIR = [(-2, 0, 0), (0, 0, 0), (2, 0, 0), (2, 1, 0), (0, 1, 0), (-2, 1, 0)]
"""Points of two rectangles of area 2 side by side."""
LEFT_RIGHT = [0, 1, 4, 5, 1, 2, 3, 4]


def inside(polygon: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether points `[N, 2]` lie in a polygon `[M, 2]`, by the number of edges to their right."""
    a, b = polygon, np.roll(polygon, -1, axis=0)
    across = (a[:, 1] > points[:, None, 1]) != (b[:, 1] > points[:, None, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        x = a[:, 0] + (points[:, None, 1] - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    return (across & (x > points[:, None, 0])).sum(axis=1) % 2 == 1


def star(count: int, turn: float = 0.3) -> np.ndarray:
    angles = turn + 2 * np.pi * np.arange(count) / count
    radii = np.where(np.arange(count) % 2, 0.3, 1.0)
    return radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)


ARROW = np.array([(0, 0), (2, -1), (0.5, 0), (2, 1)], float)
COMB = np.array([(0, 0), (5, 0), (5, 3), (4, 3), (4, 1), (3, 1), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)], float)


@pytest.mark.parametrize("polygon", [ARROW, np.roll(ARROW, 1, 0), star(10), star(41, 0.1), COMB, np.roll(COMB, 5, 0)])
def test_triangles_cover_a_concave_polygon_once(polygon):
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    points = np.concatenate([polygon, np.zeros((len(polygon), 1))], axis=1) @ turn
    count = len(polygon)
    triangles, faces = triangulate(points, np.array([count]), np.arange(count))
    assert triangles.shape == (count - 2, 3) and (faces == 0).all()
    samples = np.random.default_rng(0).uniform(polygon.min(axis=0), polygon.max(axis=0), (2000, 2))
    covered = sum(inside(polygon[triangle], samples).astype(int) for triangle in triangles)
    np.testing.assert_array_equal(covered, inside(polygon, samples))
    a, b, c = np.moveaxis(polygon[triangles], 1, 0)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert (np.sign(area[np.abs(area) > 1e-9]) == np.sign(area.sum())).all(), "all turn as the polygon does"


def test_degenerate_polygons_have_no_triangles_and_do_no_harm():
    points = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float)
    triangles, faces = triangulate(points, np.array([0, 1, 2, 3, 4, 5]), np.array([0, 0, 1, 0, 1, 2, 0, 1, 2, 3, 0, 0, 0, 0, 0]))
    assert faces.tolist() == [3, 4, 4, 5, 5, 5] and triangles[0].tolist() == [3, 4, 5]


@pytest.mark.parametrize(
    ("interpolation", "values", "indices"),
    [
        ("vertex", [(x / 4 + 0.5, y) for x, y, _ in PAIR], None),
        ("varying", [(x / 4 + 0.5, y) for x, y, _ in PAIR], None),
        ("faceVarying", [(PAIR[n][0] / 4 + 0.5, PAIR[n][1]) for n in LEFT_RIGHT], None),
        ("faceVarying", [(x / 4 + 0.5, y) for x, y, _ in PAIR], LEFT_RIGHT),
        ("vertex", [(x / 4 + 0.5, y) for x, y, _ in reversed(PAIR)], [5, 4, 3, 2, 1, 0]),
    ],
)
def test_texture_coordinates_of_every_interpolation(interpolation, values, indices, tmp_path):
    stage = new_stage()
    mesh = add_mesh(stage, "/mesh", PAIR, (4, 4), LEFT_RIGHT)
    add_primvar(mesh, "map", TYPES.TexCoord2fArray, [Gf.Vec2f(*map(float, value)) for value in values], interpolation, indices)
    textured(stage, mesh, tmp_path, "map")
    found = loaded(stage, tmp_path).meshes[0]
    u, v = found.uvs[:, 0].T
    np.testing.assert_allclose(u, found.vertices[:, 0] / 4 + 0.5, atol=1e-6)
    np.testing.assert_allclose(v, 1.0 - found.vertices[:, 1], atol=1e-6)
    assert len(found.triangles) == 4


def test_missing_texture_coordinates_are_told(tmp_path):
    stage = new_stage()
    textured(stage, add_mesh(stage, "/mesh"), tmp_path, "nothing")
    assert any("without the primvar nothing" in line for line in loaded(stage, tmp_path).warnings)


@pytest.mark.parametrize(
    ("interpolation", "count"), [("constant", 1), ("uniform", 2), ("vertex", 6), ("varying", 6), ("faceVarying", 8)]
)
def test_display_colors_of_every_interpolation(interpolation, count, tmp_path):
    stage = new_stage()
    mesh = add_mesh(stage, "/mesh", PAIR, (4, 4), LEFT_RIGHT)
    colors = [Gf.Vec3f(1.0, number / 10, 0.0) for number in range(count)]
    add_primvar(mesh, "displayColor", TYPES.Color3fArray, colors, interpolation)
    scene = loaded(stage, tmp_path)
    found, material = scene.meshes[0], scene.materials[scene.meshes[0].material]
    if interpolation == "constant":
        assert material.base_color == (1, 0, 0) and found.colors is None
        return
    assert material.base_color == (1, 1, 1) and found.colors.shape == (len(found.vertices), 4)
    left = found.colors[found.triangles].mean(axis=(1, 2))[:2] if interpolation == "uniform" else None
    if left is not None:
        greens = np.sort(found.colors[found.triangles][..., 1].reshape(4, 3), axis=0)
        np.testing.assert_allclose(greens, np.repeat([0.0, 0.0, 0.1, 0.1], 3).reshape(4, 3), atol=1e-6)
    elif interpolation == "faceVarying":
        assert sorted(np.unique(found.colors[:, 1].round(3))) == pytest.approx([n / 10 for n in range(8)])
    else:
        where = [int(np.argmin(np.linalg.norm(np.array(PAIR) - vertex, axis=1))) for vertex in found.vertices]
        np.testing.assert_allclose(found.colors[:, 1], np.array(where) / 10, atol=1e-6)


def test_primvars_that_do_not_fit_are_told(tmp_path):
    stage = new_stage()
    mesh = add_mesh(stage, "/mesh")
    add_primvar(mesh, "displayColor", TYPES.Color3fArray, [Gf.Vec3f(1.0)] * 3, "vertex")
    mesh.CreateNormalsAttr([Gf.Vec3f(0, 0, 1)] * 2)
    scene = loaded(stage, tmp_path)
    assert scene.meshes[0].colors is None and scene.meshes[0].normals is None
    assert any("primvar displayColor: left out" in line for line in scene.warnings)
    assert any("primvar normals: left out" in line for line in scene.warnings)


def test_normals_and_their_transform(tmp_path):
    stage = new_stage()
    mesh = add_mesh(stage, "/mesh")
    mesh.AddScaleOp().Set(Gf.Vec3f(1, 4, 1))
    mesh.CreateNormalsAttr([Gf.Vec3f(0, 1, 1)] * 4)
    mesh.SetNormalsInterpolation("faceVarying")
    np.testing.assert_allclose(
        loaded(stage, tmp_path).meshes[0].normals, [(0, 0.25 / math.hypot(0.25, 1), 1 / math.hypot(0.25, 1))] * 4, atol=1e-6
    )
    add_primvar(mesh, "normals", TYPES.Normal3fArray, [Gf.Vec3f(0, 0, 1)], "constant")
    assert loaded(stage, tmp_path).meshes[0].normals[0] == pytest.approx((0, 0, 1)), "primvars:normals come first"


def test_polygons_without_normals_are_flat(tmp_path):
    stage = new_stage()
    add_mesh(stage, "/mesh")
    assert loaded(stage, tmp_path).meshes[0].normals is None


def test_holes_are_left_out(tmp_path):
    stage = new_stage()
    mesh = add_mesh(stage, "/mesh", PAIR, (4, 4), LEFT_RIGHT)
    mesh.CreateHoleIndicesAttr([0])
    assert corners(loaded(stage, tmp_path))[..., 0].min() == 0


def test_subsets_have_their_own_materials(tmp_path):
    stage = new_stage()
    mesh = add_mesh(stage, "/mesh", PAIR, (4, 4), LEFT_RIGHT)
    for name, faces in (("red", [1, 7]), ("blue", [1])):
        subset = UsdShade.MaterialBindingAPI(mesh).CreateMaterialBindSubset(name, faces)
        material = UsdShade.Material.Define(stage, f"/{name}")
        surface = UsdShade.Shader.Define(stage, f"/{name}/surface")
        surface.SetShaderId("UsdPreviewSurface")
        material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)
    scene = loaded(stage, tmp_path)
    places = {scene.materials[mesh.material].name: mesh.vertices[:, 0].mean() for mesh in scene.meshes}
    assert places == {"red": pytest.approx(1.0), "default": pytest.approx(-1.0)}, "the first subset of a polygon counts"


AREAS = {
    "Sphere": (lambda p: p.CreateRadiusAttr(1.5), 4 * math.pi * 1.5**2),
    "Cube": (lambda p: p.CreateSizeAttr(3.0), 6 * 9.0),
    "Cylinder": (lambda p: (p.CreateRadiusAttr(0.5), p.CreateHeightAttr(3.0)), 2 * math.pi * 0.5 * 3 + 2 * math.pi * 0.25),
    "Cone": (lambda p: (p.CreateRadiusAttr(0.5), p.CreateHeightAttr(3.0)), math.pi * 0.5 * math.hypot(0.5, 3) + math.pi * 0.25),
    "Capsule": (lambda p: (p.CreateRadiusAttr(0.5), p.CreateHeightAttr(3.0)), 2 * math.pi * 0.5 * 3 + 4 * math.pi * 0.25),
    "Plane": (lambda p: (p.CreateWidthAttr(3.0), p.CreateLengthAttr(5.0)), 15.0),
}


@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
@pytest.mark.parametrize("kind", AREAS)
def test_shapes_have_the_area_and_the_extent_of_usd(kind, axis, tmp_path):
    stage = new_stage()
    shape = getattr(UsdGeom, kind).Define(stage, "/shape")
    size, area = AREAS[kind]
    size(shape)
    if kind not in ("Sphere", "Cube"):
        shape.CreateAxisAttr(axis)
    mesh = loaded(stage, tmp_path).meshes[0]
    assert surface_area(mesh) == pytest.approx(area, rel=5e-3)
    extent = UsdGeom.Boundable.ComputeExtentFromPlugins(shape, Usd.TimeCode.Default())
    np.testing.assert_allclose([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)], extent, atol=8e-3)
    normals = facing(loaded(stage, tmp_path))
    if kind == "Plane":
        assert normals.sum(axis=0)["XYZ".index(axis)] == pytest.approx(15.0)
    else:
        a, b, c = np.moveaxis(mesh.vertices[mesh.triangles].astype(float), 1, 0)
        assert np.einsum("ij,ij->i", normals, (a + b + c) / 3).min() > -1e-9, "all face outwards"
    if mesh.normals is not None:
        shading = mesh.normals[mesh.triangles].mean(axis=1)
        assert np.einsum("ij,ij->i", normals, shading).min() >= 0.0


def test_curves_and_points_are_told(tmp_path):
    stage = new_stage()
    add_mesh(stage, "/mesh")
    UsdGeom.BasisCurves.Define(stage, "/hair")
    UsdGeom.Points.Define(stage, "/dust")
    warnings = loaded(stage, tmp_path).warnings
    assert any("BasisCurves: left out (hair)" in line for line in warnings)
    assert any("Points: left out (dust)" in line for line in warnings)


def test_the_square_of_the_tests(tmp_path):
    stage = new_stage()
    add_mesh(stage, "/mesh", SQUARE)
    assert facing(loaded(stage, tmp_path)).sum(axis=0) == pytest.approx((0, 0, 4))
