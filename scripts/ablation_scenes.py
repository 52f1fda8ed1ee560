"""Scenes for the parts of mode `guided` that the built-in scenes hardly need: see `SCENES`."""

from __future__ import annotations

import math

import numpy as np

from bokehguide.scene.builtin.parts import Builder, rod
from bokehguide.scene.environments import sky
from bokehguide.scene.types import Camera, FilmSettings, Scene

CAMERA = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=40.0, aperture_radius=0.05, focus_distance=2.0)
ACROSS, DOWN = 8, 5
NEAR, FAR = 0.8, 6.0
"""Distances of the balls, metres: in front of the focal plane and behind it."""
TUBES = 16
NIGHT = sky((-90, (0.02, 0.02, 0.02)), (90, (0.05, 0.05, 0.07)))


def mirror_balls(width: int, height: int) -> Scene:
    """Forty small balls of polished metal, each with a larger one exactly behind it, mirror an emitter behind the camera."""
    builder = Builder()
    steel = builder.material("steel", (0.9, 0.9, 0.9), metallic=1.0, roughness=0.1)
    reach = 0.8 * math.tan(math.radians(0.5 * CAMERA.fov))
    x, y = np.meshgrid(np.linspace(-reach, reach, ACROSS), np.linspace(-reach, reach, DOWN) * height / width)
    towards = np.stack((x.ravel(), y.ravel(), np.full(x.size, -1.0)), axis=1)
    for distance, radius in ((NEAR, 0.004), (FAR, 0.02)):
        builder.spheres(steel, distance * towards, radius)
    builder.spheres(builder.emitter("emitter", (300.0, 300.0, 300.0)), np.array([[1.0, 2.0, 2.0]]), 0.7)
    return Scene(
        name="mirror-balls",
        camera=CAMERA,
        meshes=builder.meshes(),
        materials=tuple(builder.materials),
        film=FilmSettings(width, height, max_depth=3),
        environment=NIGHT,
    )


def neon_tubes(width: int, height: int) -> Scene:
    """Long and thin emitters of all directions, far behind a ball in focus."""
    builder, random = Builder(), np.random.default_rng(0)
    glass = builder.emitter("neon", (60.0, 40.0, 80.0))
    for _ in range(TUBES):
        middle = random.uniform((-2.5, -1.0, -7.0), (2.5, 1.5, -4.0))
        half = random.normal(size=3)
        half *= random.uniform(0.2, 0.4) / np.linalg.norm(half)
        builder.add(rod(tuple(middle - half), tuple(middle + half), 0.008), glass)
    builder.spheres(builder.material("ball"), np.array([[0.1, -0.3, -2.0]]), 0.2)
    return Scene(
        "neon-tubes", CAMERA, builder.meshes(), tuple(builder.materials), FilmSettings(width, height, max_depth=4), NIGHT
    )


def two_rooms(width: int, height: int) -> Scene:
    """A floor that a wall parts, seen from above, with a dim emitter on the left and one twenty times as bright on the right."""
    builder = Builder()
    white, black = builder.material("white"), builder.material("black", (0.0, 0.0, 0.0), specular=0.0)
    builder.box(white, (0.0, -0.05, 0.0), (6.0, 0.1, 6.0))
    builder.box(black, (0.0, 0.75, 0.0), (0.02, 1.5, 6.0))
    for x, radiance in ((-1.0, 30.0), (1.0, 600.0)):
        builder.spheres(builder.emitter(f"bulb {radiance:g}", (radiance,) * 3), np.array([[x, 0.8, 0.0]]), 0.05)
    camera = Camera((0.0, 5.0, 0.01), (0.0, 0.0, 0.0), fov=40.0, aperture_radius=0.02, focus_distance=5.0)
    return Scene("two-rooms", camera, builder.meshes(), tuple(builder.materials), FilmSettings(width, height, max_depth=3), NIGHT)


SCENES = {"mirror-balls": mirror_balls, "neon-tubes": neon_tubes, "two-rooms": two_rooms}
"""Scenes of a width and height in pixels: for highlights behind one another, proportions of emitters, and visibility."""
