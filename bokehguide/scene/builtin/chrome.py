"""A bar at night: polished metal near, in and behind the focal plane, and small lamps."""

from __future__ import annotations

import numpy as np

from bokehguide.scene.builtin.parts import Builder, emitter_radius, lathe, ring, rod
from bokehguide.scene.environments import sky
from bokehguide.scene.shapes import unit_rectangle
from bokehguide.scene.types import Camera, Inset, Scene

DESCRIPTION = "polished metal near and far under small lamps: highlights that move with the lens"

CAMERA = Camera(position=(0.0, 0.3, 1.05), target=(0.0, 0.19, 0.0), fov=40.0, aperture_radius=0.04, focus_distance=1.05)


def chrome() -> Scene:
    """Defocused reflections, whose position depends on the lens point."""
    builder = Builder()
    _bar(builder)
    _metal(builder)
    _lamps(builder)
    return Scene(
        name="chrome",
        description=DESCRIPTION,
        camera=CAMERA,
        meshes=builder.meshes(),
        materials=tuple(builder.materials),
        environment=sky((-90, (0.02, 0.02, 0.02)), (0, (0.16, 0.17, 0.21)), (90, (0.5, 0.55, 0.7))),
        insets=(Inset(0.0, 0.42, 0.26, 0.5), Inset(0.3, 0.02, 0.4, 0.3), Inset(0.72, 0.02, 0.26, 0.36)),
    )


def _bar(builder: Builder) -> None:
    counter = builder.material("counter", (0.05, 0.03, 0.025), roughness=0.25)
    builder.box(counter, (0.0, -0.03, -0.6), (4.0, 0.06, 3.2))
    wall = builder.material("wall", (0.10, 0.06, 0.05), roughness=0.9)
    builder.add(unit_rectangle(), wall, translate=(0.0, 0.0, -3.6), scale=(7.0, 4.0, 1.0))
    panel = builder.emitter("panel", (20.0, 21.0, 23.0))
    builder.add(unit_rectangle(), panel, translate=(-1.2, 1.2, 0.6), rotate=(40.0, 115.0, 0.0), scale=0.3)


def _metal(builder: Builder) -> None:
    steel = builder.material("chrome", (0.78, 0.79, 0.80), metallic=1.0, roughness=0.06)
    brushed = builder.material("brushed steel", (0.70, 0.70, 0.72), metallic=1.0, roughness=0.18)
    gold = builder.material("gold", (1.0, 0.77, 0.34), metallic=1.0, roughness=0.12)
    copper = builder.material("copper", (0.95, 0.60, 0.46), metallic=1.0, roughness=0.15)
    shaker = [(0.0, 0.0), (0.036, 0.0), (0.039, 0.006), (0.047, 0.12), (0.046, 0.124)]
    shaker += [(0.043, 0.126), (0.040, 0.150), (0.028, 0.172), (0.0205, 0.178), (0.0205, 0.206)]
    shaker += [(0.018, 0.213), (0.010, 0.217), (0.0, 0.218)]
    builder.add(lathe(shaker, 128), steel, translate=(-0.03, 0.0, 0.0))
    builder.add(ring(0.0475, 0.0018, 96), gold, translate=(-0.03, 0.122, 0.0))
    cup = [(0.0, 0.0), (0.03, 0.0), (0.032, 0.003), (0.006, 0.012), (0.005, 0.06), (0.02, 0.07)]
    cup += [(0.04, 0.105), (0.044, 0.135), (0.042, 0.135), (0.037, 0.106), (0.0, 0.074)]
    builder.add(lathe(cup, 128), gold, translate=(0.11, 0.0, -0.03))
    builder.spheres(copper, (0.055, 0.022, 0.09), 0.022)
    builder.spheres(brushed, (-0.125, 0.032, 0.05), 0.032)
    # Objects near the lens. Their feet are below the frame.
    builder.spheres(steel, (-0.20, 0.15, 0.42), 0.095)
    builder.add(ring(0.075, 0.018, 96), copper, translate=(0.19, 0.125, 0.43), rotate=(62, 30, 0))
    # A distant row of urns.
    for number, x in enumerate((-0.75, -0.42, 0.36, 0.70)):
        urn = [(0.0, 0.0), (0.09, 0.0), (0.10, 0.02), (0.12, 0.2), (0.10, 0.33), (0.03, 0.40)]
        urn += [(0.03, 0.43), (0.0, 0.45)]
        metal = (copper, steel, brushed, gold)[number]
        builder.add(lathe(urn, 96), metal, translate=(x, 0.0, -1.35 - 0.1 * number))
    builder.add(rod((-1.4, 0.56, -1.7), (1.4, 0.56, -1.7), 0.018, 64), brushed)


def _lamps(builder: Builder) -> None:
    """Small bulbs in the background, and larger bulbs outside the frame for the reflections."""
    rng = np.random.default_rng(5)
    warm = builder.emitter("bulb", (180.0, 110.0, 48.0))
    cool = builder.emitter("cool bulb", (80.0, 125.0, 180.0))
    x = np.linspace(-1.25, 1.25, 14)
    back = np.stack([x, 0.48 + 0.05 * np.cos(4.0 * x), np.full(14, -2.2)], axis=1)
    low = np.stack([x + 0.08, 0.28 + 0.1 * rng.random(14), rng.uniform(-3.2, -2.4, 14)], axis=1)
    builder.spheres(warm, back, emitter_radius(CAMERA, back, 0.006))
    builder.spheres(cool, low[::2], emitter_radius(CAMERA, low[::2], 0.005))
    builder.spheres(warm, low[1::2], emitter_radius(CAMERA, low[1::2], 0.007))
    for lamp, x in ((warm, -0.9), (cool, -0.3), (warm, 0.35), (cool, 0.95)):
        builder.spheres(lamp, ((x, 1.15, 0.3), (x + 0.2, 0.95, 1.6)), 0.024)
