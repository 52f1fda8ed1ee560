"""Solids of revolution: those of trimesh, and without its import."""

import subprocess
import sys

import numpy as np
import pytest
import trimesh
from trimesh.graph import smooth_shade

from bokehguide.scene.builtin.parts import lathe, ring, rod
from bokehguide.scene.builtin.solids import CREASE
from bokehguide.scene.shapes import transform
from bokehguide.scene.types import Mesh

PROFILES = {
    "cone": [(0.0, 0.1), (0.05, 0.1), (0.0, 0.3)],
    "lid": [(0.0, 0.059), (0.041, 0.059), (0.0, 0.06)],
    "disc": [(0.0, 0.0), (1.0, 0.0)],
    "cup": [(0.0, 0.0), (0.03, 0.0), (0.032, 0.01), (0.04, 0.06), (0.037, 0.06), (0.0, 0.02)],
    "sphere": [(float(np.sin(a)), -float(np.cos(a))) for a in np.linspace(0.0, np.pi, 17)],
    "open tube": [(1.0, 0.0), (1.0, 3.0)],
}
RODS = [
    ((0.1, 0.2, 0.3), (0.4, -0.2, 1.0), 0.05, 24),
    ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), 0.3, 6),
    ((0, 0, 0), (0, 2, 0), 0.2, 3),
]


def assert_shaded(found: Mesh, surface: trimesh.Trimesh) -> None:
    expected = smooth_shade(surface, angle=CREASE)
    np.testing.assert_array_equal(found.vertices, expected.vertices.astype(np.float32))
    np.testing.assert_array_equal(found.triangles, expected.faces)
    np.testing.assert_allclose(found.normals, expected.vertex_normals, rtol=0, atol=1e-6)


@pytest.mark.parametrize("sections", [5, 64])
@pytest.mark.parametrize("name", PROFILES)
def test_a_lathe_is_that_of_trimesh(name, sections):
    surface = trimesh.creation.revolve(np.array(PROFILES[name]), sections=sections)
    surface.apply_transform(transform(rotate=(-90.0, 0.0, 0.0)))
    assert_shaded(lathe(PROFILES[name], sections), surface)


@pytest.mark.parametrize(("start", "end", "radius", "sections"), RODS)
def test_a_rod_is_that_of_trimesh(start, end, radius, sections):
    segment = np.array([start, end], dtype=float)
    assert_shaded(rod(start, end, radius, sections), trimesh.creation.cylinder(radius, segment=segment, sections=sections))


@pytest.mark.parametrize(("thickness", "sections"), [(0.1, 48), (0.004, 7)])
def test_a_ring_is_that_of_trimesh(thickness, sections):
    surface = trimesh.creation.torus(1.0, thickness, major_sections=sections, minor_sections=20)
    surface.apply_transform(transform(rotate=(-90.0, 0.0, 0.0)))
    assert_shaded(ring(1.0, thickness, sections), surface)


def test_a_built_in_scene_does_not_wait_for_the_import_of_trimesh():
    program = """
import sys
from bokehguide.scene.builtin import BUILTIN
for make in BUILTIN.values():
    make()
print(*{"trimesh", "networkx", "scipy"} & set(sys.modules))
"""
    done = subprocess.run((sys.executable, "-c", program), check=True, capture_output=True, text=True, timeout=120)
    assert done.stdout.strip() == ""
