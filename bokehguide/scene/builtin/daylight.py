"""A cup and a plant on a terrace under a bright hazy sky, without small emitters."""

from __future__ import annotations

import numpy as np

from bokehguide.scene.builtin.parts import Builder, lathe, ring
from bokehguide.scene.environments import sky
from bokehguide.scene.shapes import unit_sphere
from bokehguide.scene.types import Camera, Inset, Scene

DESCRIPTION = "a cup on a terrace before white walls and a bright sky: no lamps at all"


def daylight() -> Scene:
    """The control scene: bright and defocused, without highlights for the guide."""
    builder = Builder()
    _terrace(builder)
    _cup(builder)
    _plant(builder)
    return Scene(
        name="daylight",
        description=DESCRIPTION,
        camera=Camera(position=(0.0, 0.23, 0.9), target=(0.0, 0.14, 0.0), fov=40.0, aperture_radius=0.035, focus_distance=0.92),
        meshes=builder.meshes(),
        materials=tuple(builder.materials),
        environment=sky(
            (-90.0, (0.25, 0.24, 0.22)),
            (-2.0, (0.5, 0.48, 0.45)),
            (1.0, (1.05, 1.05, 1.05)),
            (14.0, (0.62, 0.80, 1.1)),
            (90.0, (0.40, 0.65, 1.25)),
        ),
        insets=(Inset(0.03, 0.03, 0.3, 0.35), Inset(0.68, 0.05, 0.28, 0.35)),
    )


def _terrace(builder: Builder) -> None:
    table = builder.material("table", (0.45, 0.30, 0.18), roughness=0.7)
    for number in range(9):
        builder.box(table, (0.0, -0.015, 0.5 - 0.14 * number), (1.8, 0.03, 0.134))
    white = builder.material("white wall", (0.82, 0.80, 0.76), roughness=0.9, specular=0.0)
    floor = builder.material("paving", (0.45, 0.42, 0.38), roughness=0.9, specular=0.0)
    shutter = builder.material("shutter", (0.10, 0.28, 0.45), roughness=0.8)
    glass = builder.material("dark window", (0.06, 0.07, 0.08), roughness=0.6)
    builder.box(floor, (0.0, -0.8, -4.0), (20.0, 0.1, 16.0))
    builder.box(white, (-2.6, 0.6, -4.5), (3.0, 2.9, 1.0))
    builder.box(white, (2.3, 0.1, -3.6), (2.4, 1.9, 1.0))
    builder.box(white, (0.3, -0.35, -5.5), (4.0, 0.9, 0.2))
    for x, y, z in ((-2.9, 1.0, -4.0), (-1.75, 1.0, -4.0), (1.9, 0.45, -3.1), (2.9, 0.45, -3.1)):
        builder.box(glass, (x, y, z), (0.4, 0.6, 0.04))
        for side in (-0.3, 0.3):
            builder.box(shutter, (x + side, y, z + 0.03), (0.2, 0.64, 0.04))


def _cup(builder: Builder) -> None:
    china = builder.material("china", (0.85, 0.84, 0.80), roughness=0.3)
    coffee = builder.material("coffee", (0.05, 0.02, 0.01), roughness=0.3)
    x = -0.07
    saucer = [(0.0, 0.0), (0.04, 0.0), (0.075, 0.012), (0.078, 0.015), (0.04, 0.006), (0.0, 0.006)]
    builder.add(lathe(saucer), china, translate=(x, 0.0, 0.0))
    cup = [(0.0, 0.006), (0.022, 0.006), (0.026, 0.012), (0.040, 0.035), (0.045, 0.070)]
    cup += [(0.042, 0.072), (0.037, 0.037), (0.023, 0.015), (0.0, 0.013)]
    builder.add(lathe(cup), china, translate=(x, 0.0, 0.0))
    builder.add(lathe([(0.0, 0.059), (0.041, 0.059), (0.0, 0.06)]), coffee, translate=(x, 0.0, 0.0))
    handle = ring(0.018, 0.0045, sections=48)
    builder.add(handle, china, translate=(x + 0.055, 0.042, 0.01), rotate=(90.0, 10.0, 0.0))


def _plant(builder: Builder) -> None:
    clay = builder.material("clay", (0.60, 0.26, 0.15), roughness=0.9)
    earth = builder.material("earth", (0.06, 0.04, 0.03))
    leaf = builder.material("leaf", (0.10, 0.32, 0.08), roughness=0.5, double_sided=True)
    foot = np.array([0.13, 0.0, -0.04])
    pot = [(0.0, 0.0), (0.038, 0.0), (0.050, 0.075), (0.056, 0.075), (0.056, 0.092)]
    pot += [(0.049, 0.092), (0.047, 0.075), (0.0, 0.074)]
    builder.add(lathe(pot), clay, translate=foot)
    builder.add(lathe([(0.0, 0.08), (0.047, 0.08), (0.0, 0.081)]), earth, translate=foot)
    rng = np.random.default_rng(3)
    for number in range(26):
        turn, lean = 137.5 * number, rng.uniform(10.0, 62.0)
        length = rng.uniform(0.05, 0.085)
        lean_radians, turn_radians = np.radians(lean), np.radians(turn)
        direction = np.array(
            [np.sin(lean_radians) * np.sin(turn_radians), np.cos(lean_radians), np.sin(lean_radians) * np.cos(turn_radians)]
        )
        builder.add(
            unit_sphere(),
            leaf,
            translate=foot + (0.0, 0.08, 0.0) + length * direction,
            rotate=(lean, turn, 0.0),
            scale=(0.013, length, 0.003),
        )
