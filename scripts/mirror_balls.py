"""A scene whose highlights are unknown before the first ray, and lie behind one another."""

from __future__ import annotations

import math

import numpy as np

from bokehguide.scene.builtin.parts import Builder, sky
from bokehguide.scene.types import Camera, Film, Scene

CAMERA = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=40.0, aperture_radius=0.05, focus_distance=2.0)
ACROSS, DOWN = 8, 5
NEAR, FAR = 0.8, 6.0
"""Distances of the balls, metres: before the focal plane and behind it."""


def mirror_balls(width: int, height: int) -> Scene:
    """Forty small balls of polished metal, each with a larger one exactly behind it, mirror a lamp behind the camera."""
    builder = Builder()
    steel = builder.material("steel", (0.9, 0.9, 0.9), metallic=1.0, roughness=0.1)
    reach = 0.8 * math.tan(math.radians(0.5 * CAMERA.fov))
    x, y = np.meshgrid(np.linspace(-reach, reach, ACROSS), np.linspace(-reach, reach, DOWN) * height / width)
    towards = np.stack((x.ravel(), y.ravel(), np.full(x.size, -1.0)), axis=1)
    for distance, radius in ((NEAR, 0.004), (FAR, 0.02)):
        builder.balls(steel, distance * towards, radius)
    builder.balls(builder.lamp("lamp", (300.0, 300.0, 300.0)), np.array([[1.0, 2.0, 2.0]]), 0.7)
    return Scene(
        name="mirror-balls",
        camera=CAMERA,
        meshes=builder.meshes(),
        materials=tuple(builder.materials),
        film=Film(width, height, max_depth=3),
        environment=sky((-90, (0.02, 0.02, 0.02)), (90, (0.05, 0.05, 0.07))),
    )
