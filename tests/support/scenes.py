"""Small scenes as code, for tests that render."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bokehguide.scene.shapes import spheres
from bokehguide.scene.types import Camera, Environment, FilmSettings, Material, Scene

BLACK = Material("black", (0.0, 0.0, 0.0), specular=0.0)
LAMP = Material("emitter", (0.0, 0.0, 0.0), specular=0.0, emission=(40.0, 30.0, 20.0))


def constant_sky(radiance: float) -> Environment:
    """An environment of one radiance in all directions."""
    return Environment(np.full((1, 1, 3), radiance, np.float32))


def furnace(width: int, height: int) -> Scene:
    """Radiance 1 from everywhere, seen through a lens as wide as half its focus distance.

    The only triangles are a black ball behind the camera.
    """
    camera = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=60.0, aperture_radius=0.5, focus_distance=1.0)
    ball = spheres(np.array([[0.0, 0.0, 50.0]]), 0.01, material=0)
    return Scene("furnace", camera, (ball,), (BLACK,), FilmSettings(width, height, max_depth=2), constant_sky(1.0))


LAMP_CENTRES = np.array([[0.35, 0.15, -6.0], [-0.3, -0.15, -1.1], [-0.1, 0.25, -4.0]])
LAMP_RADII = np.array([0.07, 0.02, 0.03])


def emitters(width: int, height: int) -> Scene:
    """Three emitters out of focus (two behind, one before the focal plane) under a dim sky."""
    camera = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=40.0, aperture_radius=0.1, focus_distance=2.0)
    mesh = spheres(LAMP_CENTRES, LAMP_RADII, material=0)
    return Scene("emitters", camera, (mesh,), (LAMP,), FilmSettings(width, height, max_depth=1), constant_sky(0.1))


def scaled(scene: Scene, light: float, length: float) -> Scene:
    """The scene with all light and all lengths multiplied."""
    camera = scene.camera
    camera = replace(
        camera,
        position=tuple(length * x for x in camera.position),
        target=tuple(length * x for x in camera.target),
        aperture_radius=length * camera.aperture_radius,
        focus_distance=length * camera.focus_distance,
    )
    return replace(
        scene,
        camera=camera,
        meshes=tuple(replace(mesh, vertices=mesh.vertices * np.float32(length)) for mesh in scene.meshes),
        materials=tuple(replace(m, emission=tuple(light * c for c in m.emission)) for m in scene.materials),
        environment=replace(scene.environment, radiance=np.float32(light) * scene.environment.radiance),
    )
