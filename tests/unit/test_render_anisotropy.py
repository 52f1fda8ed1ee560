"""Directions of anisotropy at hits: tangents of the uvs, rotations, textures, and both sides of a surface."""

import numpy as np
import pytest
import torch

from bokehguide.render.geometry import Geometry
from bokehguide.scene.types import Material, Mesh, Texture
from tests.support.tracing import found, rectangle, scene

BRUSHED = {"metallic": 1.0, "roughness": 0.5, "anisotropy": 0.8}


def globe(material: Material) -> Geometry:
    """A sphere whose u grows with the longitude about y, in 24 × 48 quadrilaterals with smooth normals."""
    rows, columns = np.meshgrid(np.linspace(0.0, 1.0, 25), np.linspace(0.0, 1.0, 49), indexing="ij")
    theta, phi = np.pi * rows, 2.0 * np.pi * columns
    points = np.stack((np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)), axis=-1).reshape(-1, 3)
    corner = (np.arange(24)[:, None] * 49 + np.arange(48)).ravel()
    triangles = np.concatenate(
        (np.stack((corner, corner + 49, corner + 1), 1), np.stack((corner + 1, corner + 49, corner + 50), 1))
    )
    uvs = np.stack((columns, rows), axis=-1).reshape(-1, 1, 2)
    mesh = Mesh(points.astype(np.float32), triangles.astype(np.int32), 0, points.astype(np.float32), uvs.astype(np.float32))
    return Geometry(scene([mesh], [material]))


def directions(geometry: Geometry) -> tuple[np.ndarray, np.ndarray]:
    """Tangents and normals `[N, 3]` at points between the poles."""
    generator = np.random.default_rng(0)
    at = generator.normal(size=(400, 3)) * [1.0, 0.4, 1.0]
    at /= np.linalg.norm(at, axis=1, keepdims=True)
    _, surface = found(geometry, 3.0 * at, -at)
    tangent = torch.nn.functional.normalize(surface.tangent, dim=0)
    return tangent.T.double().numpy(), surface.normal.T.double().numpy()


@pytest.mark.parametrize("degrees", [0.0, 90.0, 30.0])
def test_the_direction_follows_u_smoothly_and_turns_anticlockwise(degrees):
    tangent, normal = directions(globe(Material("brushed", **BRUSHED, anisotropy_rotation=degrees)))
    east = np.cross([0.0, 1.0, 0.0], normal)
    east /= np.linalg.norm(east, axis=1, keepdims=True)
    north = np.cross(normal, east)
    expected = np.cos(np.radians(degrees)) * east + np.sin(np.radians(degrees)) * north
    cosine = (tangent * expected).sum(1)
    assert (cosine > np.cos(np.radians(5.0))).all(), "also at the seam of the uvs"
    assert np.median(cosine) > np.cos(np.radians(0.2)), "triangles alone would be off by a degree and more"


def plate(side: float, **others):
    """The surface of a plate in the plane z = 0 whose u grows along x, seen from above (1) or from below (-1)."""
    mesh = rectangle(0)
    uvs = 0.5 * mesh.vertices[:, :2] * [1.0, -1.0] + 0.5
    mesh = Mesh(mesh.vertices, mesh.triangles, 0, mesh.normals, uvs[:, None].astype(np.float32))
    geometry = Geometry(scene([mesh], [Material("brushed", **(BRUSHED | others))]))
    return found(geometry, [[0.3, 0.2, 2.0 * side]], [[0.0, 0.0, -side]])[1]


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_texture_holds_direction_and_strength(side):
    texture = Texture(np.full((2, 2, 3), (0.5 + 0.5 * 0.6, 0.5 + 0.5 * 0.8, 0.25), np.float32))
    surface = plate(side, anisotropy_texture=texture)
    assert torch.allclose(surface.tangent[:, 0].abs(), torch.tensor([0.6, 0.8, 0.0]), atol=2e-3)
    assert float(surface.tangent[0, 0] * surface.tangent[1, 0]) > 0.0, "the same line from both sides"
    assert float(surface.alpha_along) == pytest.approx(0.25 + 0.75 * (0.8 * 0.25) ** 2, abs=1e-3)


def test_without_a_texture_the_strength_alone_counts():
    surface = plate(1.0)
    assert float(surface.alpha_along) == pytest.approx(0.25 + 0.75 * 0.64)
    assert torch.allclose(surface.tangent[:, 0], torch.tensor([1.0, 0.0, 0.0]), atol=1e-5)


def test_a_mesh_without_uvs_has_no_direction():
    mesh = rectangle(0)
    mesh = Mesh(mesh.vertices, mesh.triangles, 0)
    geometry = Geometry(scene([mesh], [Material("brushed", **BRUSHED)]))
    assert not found(geometry, [[0.1, 0.2, 2.0]], [[0.0, 0.0, -1.0]])[1].tangent.any()
