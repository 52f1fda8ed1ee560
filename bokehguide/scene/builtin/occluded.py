"""A clockwork with its front wheel in focus; a lattice and more wheels hide distant lamps."""

from __future__ import annotations

import numpy as np

from bokehguide.scene.builtin.parts import Builder, emitter_radius, gear, lathe, ring, rod
from bokehguide.scene.environments import sky
from bokehguide.scene.shapes import unit_rectangle
from bokehguide.scene.types import Camera, Inset, Scene

DESCRIPTION = "a clockwork before far lamps: lattice and wheels hide them from part of the lens"

CAMERA = Camera(position=(0.0, 0.22, 1.0), target=(0.0, 0.2, 0.0), fov=40.0, aperture_radius=0.045, focus_distance=1.0)


def occluded() -> Scene:
    """Circles of confusion, clipped by objects between the focal plane and the lamps."""
    builder = Builder()
    _surroundings(builder)
    _clockwork(builder)
    _lattice(builder)
    _lamps(builder)
    return Scene(
        name="occluded",
        description=DESCRIPTION,
        camera=CAMERA,
        meshes=builder.meshes(),
        materials=tuple(builder.materials),
        environment=sky((-90, (0.04, 0.04, 0.04)), (0, (0.14, 0.15, 0.18)), (90, (0.30, 0.32, 0.38))),
        insets=(Inset(0.03, 0.06, 0.3, 0.42), Inset(0.4, 0.03, 0.2, 0.3), Inset(0.68, 0.1, 0.29, 0.45)),
    )


def _surroundings(builder: Builder) -> None:
    bench = builder.material("bench", (0.10, 0.09, 0.08), roughness=0.5)
    builder.box(bench, (0.0, -0.02, -0.1), (2.4, 0.04, 1.2))
    wall = builder.material("wall", (0.07, 0.09, 0.11), roughness=0.9)
    builder.add(unit_rectangle(), wall, translate=(0.0, 0.0, -4.2), scale=(7.0, 4.0, 1.0))
    panel = builder.emitter("panel", (14.0, 13.5, 13.0))
    builder.add(unit_rectangle(), panel, translate=(1.1, 1.1, 1.1), rotate=(-35.0, -140.0, 0.0), scale=0.35)


def _clockwork(builder: Builder) -> None:
    """Wheels in focus at z = 0, and defocused wheels behind them."""
    brass = builder.material("brass", (0.91, 0.72, 0.34), metallic=1.0, roughness=0.28)
    copper = builder.material("copper", (0.93, 0.52, 0.38), metallic=1.0, roughness=0.3)
    steel = builder.material("steel", (0.56, 0.57, 0.58), metallic=1.0, roughness=0.3)
    wheels = (
        (brass, 0.095, 36, (-0.03, 0.185, 0.0)),
        (copper, 0.05, 18, (0.112, 0.215, -0.004)),
        (steel, 0.036, 14, (0.172, 0.152, -0.008)),
        (steel, 0.06, 22, (-0.17, 0.105, -0.05)),
        (copper, 0.11, 40, (0.24, 0.29, -0.22)),
        (brass, 0.085, 30, (-0.30, 0.30, -0.26)),
    )
    for number, (metal, radius, teeth, centre) in enumerate(wheels):
        wheel = gear(radius, teeth, 0.014)
        builder.add(wheel, metal, translate=centre, rotate=(0.0, 0.0, 7.0 * number))
        back = np.add(centre, (0.0, 0.0, -0.5))
        builder.add(rod(np.add(centre, (0, 0, 0.014)), back, 0.06 * radius + 0.002), steel)
    for side in (-0.27, 0.27):
        builder.add(rod((side, 0.0, -0.09), (side, 0.5, -0.09), 0.009), brass)
        foot = [(0.0, 0.0), (0.028, 0.0), (0.026, 0.012), (0.012, 0.02), (0.0, 0.021)]
        builder.add(lathe(foot), brass, translate=(side, 0.0, -0.09))
    builder.add(rod((-0.03, 0.185, 0.012), (0.035, 0.245, 0.012), 0.003), steel)
    builder.add(rod((-0.03, 0.185, 0.016), (-0.055, 0.285, 0.016), 0.0022), steel)
    builder.add(ring(0.104, 0.003), steel, translate=(-0.03, 0.185, 0.004), rotate=(90.0, 0.0, 0.0))


def _lattice(builder: Builder) -> None:
    """Crossed bars at depth 1.5 m, where the cone from a lamp to the lens is 2 to 3 cm wide."""
    iron = builder.material("iron", (0.12, 0.12, 0.13), metallic=1.0, roughness=0.45)
    for number in range(-9, 10):
        for turn in (-45.0, 45.0):
            builder.box(iron, (0.105 * number, 0.3, -0.5), (0.011, 1.6, 0.011), rotate=(0.0, 0.0, turn))
    for height in (0.0, 0.56):
        builder.box(iron, (0.0, height, -0.5), (2.2, 0.02, 0.02))


def _lamps(builder: Builder) -> None:
    """A jittered grid of bulbs, 1.6 to 3 m behind the focal plane."""
    rng = np.random.default_rng(11)
    colors = ((160.0, 95.0, 40.0), (190.0, 70.0, 20.0), (110.0, 130.0, 160.0), (50.0, 140.0, 170.0))
    column, row = np.meshgrid(np.arange(10), np.arange(5))
    column, row = column.ravel(), row.ravel()
    depth = rng.uniform(2.6, 4.0, len(row))
    across = (column - 4.5 + rng.uniform(-0.32, 0.32, len(row))) / 4.6 * 0.36
    up = (row - 1.3 + rng.uniform(-0.32, 0.32, len(row))) / 4.0 * 0.22
    centres = np.stack([across * depth, 0.21 + up * depth, 1.0 - depth], axis=1)
    radii = emitter_radius(CAMERA, centres, rng.uniform(0.004, 0.009, len(row)))
    kinds = rng.permutation(len(row)) % len(colors)
    for number, color in enumerate(colors):
        chosen = kinds == number
        builder.spheres(builder.emitter("bulb", color), centres[chosen], radii[chosen])
