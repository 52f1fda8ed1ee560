"""Shapes and instances of pbrt-v4: areas, sides, subdivision, PLY files."""

import gzip
import math
import struct

import numpy as np
import pytest

from tests.support.pbrt_text import HEAD, SQUARE, message, read


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
