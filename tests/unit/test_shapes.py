"""Spheres and rotations against trimesh, which takes a second to import and is therefore not used for them."""

import numpy as np
import pytest
import trimesh

from bokehguide.scene.icosphere import icosphere
from bokehguide.scene.shapes import transform


@pytest.mark.parametrize("subdivisions", [0, 1, 3])
def test_icospheres_are_those_of_trimesh(subdivisions):
    points, triangles = icosphere(subdivisions)
    truth = trimesh.creation.icosphere(subdivisions)
    np.testing.assert_array_equal(triangles, truth.faces)
    np.testing.assert_allclose(points, truth.vertices, atol=1e-15)
    assert (np.linalg.det(points[triangles]) > 0.0).all(), "the triangles face outwards"


def test_rotations_about_x_then_y_then_z():
    for angles in np.random.default_rng(0).uniform(-400.0, 400.0, (20, 3)):
        truth = trimesh.transformations.compose_matrix(scale=(1, 2, 3), angles=np.radians(angles), translate=(4, 5, 6))
        np.testing.assert_allclose(transform((4, 5, 6), angles, (1, 2, 3)), truth, atol=1e-14)
