"""Shapes and instances of pbrt-v4: areas, sides, subdivision, PLY files."""

import gzip
import math
import struct

import numpy as np
import pytest

from bokehguide.scene.pbrt.quadrics import _unit_sphere
from bokehguide.scene.shapes import surface_area
from tests.support.pbrt_text import HEAD, SQUARE, message, read

LOOK = "Scale -1 1 1\n" + HEAD
"""A right-handed world, in which the scene has the coordinates of the file."""


def test_front_faces_stay_on_their_side(tmp_path):
    """The square faces the camera space's +z in pbrt, away from the camera; `ReverseOrientation` and its normals turn it."""
    for look in ("", "Scale -1 1 1\n"):
        head = look + HEAD
        for body, wanted in (
            (SQUARE, 1.0),
            ("ReverseOrientation\n" + SQUARE, -1.0),
            ("Scale 1 1 1 Scale -1 1 1\n" + SQUARE, 1.0),
            (SQUARE.replace('"integer', '"normal N" [0 0 -1 0 0 -1 0 0 -1 0 0 -1] "integer'), -1.0),
        ):
            mesh = read(tmp_path, body, head).meshes[0]
            a, b, c = mesh.vertices[mesh.triangles[0]]
            assert np.sign(np.cross(b - a, c - a)[2]) == wanted, (look, body)


def test_instances(tmp_path):
    body = 'ObjectBegin "part"\nTranslate 0 0 1\nMaterial "diffuse" "rgb reflectance" [1 0 0]\n' + SQUARE + "ObjectEnd\n"
    uses = "".join(
        f'AttributeBegin Translate {x} 0 0 Scale 1 1 {s} ObjectInstance "part" AttributeEnd\n' for x, s in ((0, 1), (5, -1))
    )
    scene = read(tmp_path, body + uses, "Scale -1 1 1\n" + HEAD)
    (mesh,) = scene.meshes
    assert len(mesh.triangles) == 4 and scene.materials[mesh.material].base_color == (1.0, 0.0, 0.0)
    np.testing.assert_allclose(mesh.vertices[[0, 4]], [(-1, -1, 5), (4, -1, -5)])
    np.testing.assert_allclose(read(tmp_path, body + uses).meshes[0].vertices[[0, 4]], [(1, -1, 5), (-4, -1, -5)])
    normals = np.cross(*(mesh.vertices[mesh.triangles[:, k]] - mesh.vertices[mesh.triangles[:, 0]] for k in (1, 2)))
    assert (np.sign(normals[:, 2]) == (1, 1, -1, -1)).all()


QUADRICS = {
    'Shape "sphere" "float radius" 2': 4.0 * math.pi * 4.0,
    'Shape "sphere" "float zmin" 0 "float phimax" 180': math.pi,
    'Shape "disk" "float radius" 2 "float innerradius" 1': 3.0 * math.pi,
    'Shape "cylinder" "float radius" 0.5 "float zmin" -1 "float zmax" 2': 3.0 * math.pi,
    'Shape "bilinearmesh" "point3 P" [0 0 0 2 0 0 0 3 0 2 3 0]': 6.0,
}


@pytest.mark.parametrize("shape", QUADRICS)
def test_shapes_have_their_area_and_side(tmp_path, shape):
    mesh = read(tmp_path, shape, "Scale -1 1 1\n" + HEAD).meshes[0]
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    normals = np.cross(b - a, c - a)
    close = 3e-3 if "zmin" in shape else 1e-5
    assert np.linalg.norm(normals, axis=1).sum() / 2.0 == pytest.approx(QUADRICS[shape], rel=close)
    middle = (a + b + c) / 3.0
    outwards = (
        np.array((0.0, 0.0, 1.0)) if "disk" in shape or "bilinear" in shape else middle * ((1, 1, 0) if "cyl" in shape else 1)
    )
    kept = np.linalg.norm(normals, axis=1) > 1e-4
    assert ((normals * outwards).sum(axis=1)[kept] > 0.0).all()


def test_loop_subdivision_smooths(tmp_path):
    corners = "1 1 1 -1 -1 1 -1 1 -1 1 -1 -1"
    faces = "0 2 1 0 1 3 0 3 2 1 2 3"
    text = f'Shape "loopsubdiv" "integer levels" 2 "point3 P" [{corners}] "integer indices" [{faces}]'
    mesh = read(tmp_path, text).meshes[0]
    assert len(mesh.triangles) == 64 and mesh.normals is not None
    assert np.ptp(np.linalg.norm(mesh.vertices, axis=1)) < 0.35 and np.abs(mesh.vertices).max() < 0.9


PLY = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nproperty float u\n"
    "property float v\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0 0 0\n1 0 0 1 0\n1 1 0 1 1\n0 1 0 0 1\n4 0 1 2 3\n"
)


def test_ply_files_with_uvs(tmp_path):
    (tmp_path / "a.ply").write_text(PLY)
    (tmp_path / "b.ply.gz").write_bytes(gzip.compress(PLY.encode()))
    scene = read(tmp_path, 'Shape "plymesh" "string filename" "a.ply"\nShape "plymesh" "string filename" "b.ply.gz"\n')
    for mesh in scene.meshes:
        assert len(mesh.triangles) == 2
        assert mesh.uvs is not None
        np.testing.assert_allclose(mesh.uvs[:, 0], [(0, 1), (1, 1), (1, 0), (0, 0)])
    assert [mesh.name for mesh in scene.meshes] == ["a", "b"]


def test_names_of_shapes_are_unique_and_their_groups_are_shared(tmp_path):
    scene = read(
        tmp_path,
        'MakeNamedMaterial "gold" "string type" "conductor"\nShape "sphere"\n'
        'NamedMaterial "gold"\nShape "sphere"\nShape "sphere"\n'
        'ObjectBegin "tree"\nShape "disk"\nShape "sphere"\nObjectEnd\nObjectInstance "tree"\n',
    )
    assert [mesh.name for mesh in scene.meshes] == ["sphere", "sphere gold", "sphere gold 2", "tree", "tree 2"]
    shared = [set(mesh.groups) for mesh in scene.meshes]
    assert shared[2] == {"sphere gold", "sphere"} and shared[3] == {"tree", "disk"} and shared[4] == {"tree", "sphere"}


MIXED = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0)], np.float32)


@pytest.mark.parametrize("format_", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_files_of_triangles_and_quadrilaterals(tmp_path, format_):
    """A triangle and a quadrilateral with other properties around them, between two other elements."""
    head = f"ply\nformat {format_} 1.0\ncomment a file\nelement extra 2\nproperty uchar a\nelement vertex 5\nproperty double x\n"
    head += "property float y\nproperty float z\nproperty uchar red\nelement face 2\nproperty float w\n"
    head += (
        "property list uchar int vertex_indices\nproperty list ushort float more\nelement edge 1\nproperty int b\nend_header\n"
    )
    order = ">" if "big" in format_ else "<"
    faces = [(0.5, (1, 4, 2), (7.0, 8.0)), (0.25, (0, 1, 2, 3), ())]
    if format_ == "ascii":
        body = "1\n2\n" + "".join(f"{x} {y} {z} 9\n" for x, y, z in MIXED)
        body += "".join(f"{w} {len(i)} {' '.join(map(str, i))} {len(m)} {' '.join(map(str, m))}\n" for w, i, m in faces) + "3\n"
        data = body.encode()
    else:
        data = b"\1\2" + b"".join(struct.pack(order + "dffB", *row, 9) for row in MIXED)
        for w, i, m in faces:
            data += struct.pack(f"{order}fB{len(i)}iH{len(m)}f", w, len(i), *i, len(m), *m)
        data += struct.pack(order + "i", 3)
    (tmp_path / "a.ply").write_bytes(head.encode() + data)
    text = 'Shape "plymesh" "string filename" "a.ply"'
    mesh = read(tmp_path, text, "Scale -1 1 1\n" + HEAD).meshes[0]
    np.testing.assert_array_equal(mesh.vertices, MIXED)
    assert mesh.triangles.tolist() == [[1, 4, 2], [0, 1, 2], [0, 2, 3]]
    for cut in (30, len(head) + 3, len(head) + len(data) - 12):
        (tmp_path / "a.ply").write_bytes((head.encode() + data)[:cut])
        assert "a.ply: not a readable .ply model" in message(tmp_path, text)


def test_instances_are_bounded(tmp_path):
    body = 'ObjectBegin "ball"\nShape "sphere"\nObjectEnd\n' + 'ObjectInstance "ball"\n' * 40_000
    assert "triangles in all" in message(tmp_path, body)


SURFACES = {
    '"cone" "float radius" 2 "float height" 3': lambda x, y, z: np.hypot(x, y) - 2.0 * (1.0 - z / 3.0),
    '"paraboloid" "float radius" 2 "float zmax" 3': lambda x, y, z: (x**2 + y**2) / 4.0 - z / 3.0,
    '"hyperboloid" "point p1" [1 0.5 -1] "point p2" [1 -0.5 1]': lambda x, y, z: x**2 + y**2 - 1.0 - 0.25 * z**2,
}


@pytest.mark.parametrize("text", SURFACES)
def test_quadrics_of_pbrt_v3(tmp_path, text):
    """The vertices lie on the surface, and the normals and the faces point outwards, along the gradient."""
    head = 'Scale -1 1 1\nCamera "perspective"\nFilm "image"\nWorldBegin\n'
    (mesh,) = read(tmp_path, f"Shape {text}\nWorldEnd\n", head).meshes
    surface, points = SURFACES[text], mesh.vertices.astype(np.float64)
    np.testing.assert_allclose(surface(*points.T), 0.0, atol=1e-5)
    assert np.ptp(points[:, 2]) == pytest.approx(2.0 if "hyper" in text else 3.0)
    middles, normals = points[mesh.triangles].mean(axis=1), mesh.normals[mesh.triangles].mean(axis=1)
    a, b, c = np.moveaxis(points[mesh.triangles], 1, 0)
    faces = np.cross(b - a, c - a)
    for outwards in (normals, faces / np.linalg.norm(faces, axis=1, keepdims=True)):
        step = 1e-3 * outwards
        assert (surface(*(middles + step).T) > surface(*(middles - step).T)).all()


@pytest.mark.parametrize("part", [(-1.0, 1.0, 360.0), (-0.1, 1.0, 360.0), (-1.0, 1.0, 120.0)])
def test_spheres_of_one_form_are_tessellated_once(tmp_path, part):
    """Each has the vertices of its own radius: rings of equal angles, and the area of the sphere or of the whole turn."""
    radii, (low, high, phimax) = (0.25, 1.0, 7.5), part
    ends = '"float zmin" {} "float zmax" {} "float phimax" {}'
    body = "".join(f'Shape "sphere" "float radius" {r} {ends.format(low * r, high * r, phimax)}\n' for r in radii)
    _unit_sphere.cache_clear()
    meshes = read(tmp_path, body).meshes
    assert _unit_sphere.cache_info().misses == 1
    whole = low == -1.0
    theta = np.linspace(math.acos(low), math.acos(high), 33 if whole else math.ceil(32 * math.acos(low) / math.pi) + 1)
    for mesh, radius in zip(meshes, radii):
        lengths = np.linalg.norm(mesh.vertices, axis=1)
        np.testing.assert_allclose(lengths, lengths[0], rtol=1e-6)
        assert lengths[0] == pytest.approx(radius, rel=2e-3 if whole else 1e-6)
        np.testing.assert_allclose(np.unique((mesh.vertices[:, 2] / lengths[0]).round(5)), np.sort(np.cos(theta)), atol=2e-5)
        np.testing.assert_allclose(mesh.normals, mesh.vertices / lengths[:, None], atol=1e-6)
        if whole:
            assert surface_area(mesh) == pytest.approx(4.0 * math.pi * radius**2 * phimax / 360.0, rel=1e-5)
        np.testing.assert_allclose(mesh.vertices * (radii[0] / radius), meshes[0].vertices, rtol=1e-5, atol=1e-6 * radii[0])
        assert np.array_equal(mesh.triangles, meshes[0].triangles) and np.array_equal(mesh.uvs, meshes[0].uvs)


CIRCLE = 4.0 / 3.0 * math.tan(math.pi / 8.0)
"""Length of the handles of a Bézier segment that is a quarter of the unit circle, within 0.03 %."""


@pytest.mark.parametrize("kind", ["flat", "cylinder", "ribbon"])
def test_a_curve_is_a_tube_or_a_ribbon_of_its_width(tmp_path, kind):
    """A quarter of the unit circle. A ribbon in the plane of z faces z."""
    points = f"1 0 0 1 {CIRCLE} 0 {CIRCLE} 1 0 0 1 0"
    facing = '"normal N" [0 0 1 0 0 1]' if kind == "ribbon" else ""
    scene = read(tmp_path, f'Shape "curve" "string type" "{kind}" "float width" 0.02 "point3 P" [{points}] {facing}', LOOK)
    mesh = scene.meshes[0]
    wanted = math.pi * 0.02 if kind != "ribbon" else 0.02
    assert surface_area(mesh) == pytest.approx(0.5 * math.pi * wanted, rel=0.01)
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    front, middle = np.cross(b - a, c - a), (a + b + c) / 3.0
    if kind == "ribbon":
        assert (front[:, 2] > 0.0).all() and np.abs(mesh.vertices[:, 2]).max() < 1e-6
        np.testing.assert_allclose(np.unique(np.linalg.norm(mesh.vertices, axis=1).round(3)), (0.99, 1.01), atol=1e-3)
    else:
        spine = middle * (1.0, 1.0, 0.0)
        spine /= np.linalg.norm(spine, axis=1, keepdims=True)
        assert ((front * (middle - spine)).sum(axis=1) > 0.0).all()
        spines = mesh.vertices * (1.0, 1.0, 0.0) / np.linalg.norm(mesh.vertices[:, :2], axis=1)[:, None]
        np.testing.assert_allclose(np.linalg.norm(mesh.vertices - spines, axis=1), 0.01, atol=5e-4 + 3e-4)
    told = any("flat curves: tubes in their place" in line for line in scene.warnings)
    assert told == (kind == "flat")


BASES = {
    "bezier 3": ([(0, 0, 0), (1, 3, 0), (2, -1, 0), (3, 1, 0)], (0, 0, 0), (3, 1, 0)),
    "bezier 2": ([(0, 0, 0), (1, 2, 0), (2, 0, 0), (3, -2, 0), (4, 1, 0)], (0, 0, 0), (4, 1, 0)),
    "bspline 3": ([(0, 0, 0), (1, 3, 0), (2, -1, 0), (3, 1, 0), (5, 2, 0)], (1, 11 / 6, 0), (19 / 6, 5 / 6, 0)),
    "bspline 2": ([(0, 0, 0), (1, 2, 0), (2, 0, 0), (3, -2, 0)], (0.5, 1, 0), (2.5, -1, 0)),
}
"""Control points of curves by basis and degree, with their ends: of B-splines, by the formula of the uniform basis at a knot."""
MIDDLES = {"bezier 3": (1, 3, 3, 1), "bezier 2": (1, 2, 1), "bspline 3": (1, 23, 23, 1), "bspline 2": (1, 6, 1)}
"""Weights of the control points in the middle of the first segment."""


@pytest.mark.parametrize("kind", BASES)
def test_the_ends_and_widths_of_curves(tmp_path, kind):
    points, start, end = BASES[kind]
    basis, degree = kind.split()
    given = " ".join(str(number) for point in points for number in point)
    curve = f'"string basis" "{basis}" "integer degree" {degree} "float width0" 0.1 "float width1" 0.02 "point3 P" [{given}]'
    mesh = read(tmp_path, f'Translate 1 0 0 Scale 2 2 2 Shape "curve" {curve}', LOOK).meshes[0]
    for place, width, ring in ((start, 0.1, mesh.vertices[:6]), (end, 0.02, mesh.vertices[-7:-1])):
        np.testing.assert_allclose(ring.mean(axis=0), 2.0 * np.array(place) + (1.0, 0.0, 0.0), atol=1e-3)
        np.testing.assert_allclose(np.linalg.norm(ring - ring.mean(axis=0), axis=1), width, rtol=0.06)
    weights = np.array(MIDDLES[kind])
    middle = weights @ np.array(points[: len(weights)]) / weights.sum()
    np.testing.assert_allclose(mesh.vertices[28:34].mean(axis=0), 2.0 * middle + (1.0, 0.0, 0.0), atol=1e-3)


def test_many_curves_are_one_mesh_for_each_material(tmp_path):
    strands = "".join(f'Shape "curve" "float width" 0.01 "point3 P" [{x} 0 0 {x} 1 0 {x} 2 0 {x} 3 0]\n' for x in range(50))
    red, blue = ('Material "diffuse" "rgb reflectance" ' + color for color in ("[1 0 0]\n", "[0 0 1]\n"))
    scene = read(tmp_path, f"{red}{strands}{blue}{strands}" + SQUARE, LOOK)
    assert len(scene.meshes) == 3 and len(scene.meshes[0].triangles) == 50 * 2 * 8 * 6
    assert [scene.materials[mesh.material].base_color for mesh in scene.meshes[:2]] == [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)]
    body = f'ObjectBegin "tuft"\n{strands}ObjectEnd\n' + "".join('Translate 0 0 5\nObjectInstance "tuft"\n' for _ in range(2))
    tufts = read(tmp_path, body, LOOK).meshes[0].vertices
    np.testing.assert_allclose(np.unique(tufts[:, 2].round()), (5.0, 10.0))


@pytest.mark.parametrize(
    ("curve", "named"),
    [
        (
            '"point3 P" [0 0 0 1 0 0 2 0 0]',
            "has 3 points; a bezier of degree 3 needs 4 and multiples of 3 more",
        ),
        ('"integer degree" 4 "point3 P" [0 0 0 1 0 0 2 0 0]', "degree: 4.0 is no degree of a curve; give 2 or 3"),
        ('"string basis" "catmull" "point3 P" [0 0 0 1 0 0 2 0 0]', "basis: catmull is unknown"),
        ('"string type" "tube" "point3 P" [0 0 0 1 0 0 2 0 0 3 0 0]', "type: tube is unknown"),
        ('"string type" "ribbon" "point3 P" [0 0 0 1 0 0 2 0 0 3 0 0]', "a ribbon of 1 segments needs 2 normals"),
        ("", 'curve without control points; give "point3 P"'),
    ],
)
def test_wrong_curves_are_refused(tmp_path, curve, named):
    assert named in message(tmp_path, f'Shape "curve" {curve}')
