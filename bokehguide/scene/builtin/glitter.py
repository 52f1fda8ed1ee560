"""A porcelain swan among glowing specks at depths from close to the lens to the far background."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from bokehguide.scene.builtin.parts import Builder, cable, emitter_radius, lathe
from bokehguide.scene.environments import sky
from bokehguide.scene.shapes import unit_rectangle, unit_sphere
from bokehguide.scene.types import Camera, Inset, Scene

DESCRIPTION = "hundreds of bright specks at many depths, overlapping on the raster"

CAMERA = Camera(position=(0.0, 0.24, 1.0), target=(0.0, 0.13, 0.0), fov=40.0, aperture_radius=0.04, focus_distance=1.0)

SMALLEST = 0.0006
"""Smallest radius in metres; near the focal plane, the radius for a given coverage tends to 0."""


def glitter() -> Scene:
    """Highlights of different depths that overlap in one pixel."""
    builder = Builder()
    _stage(builder)
    _swan(builder)
    _specks(builder)
    return Scene(
        name="glitter",
        description=DESCRIPTION,
        camera=CAMERA,
        meshes=builder.meshes(),
        materials=tuple(builder.materials),
        environment=sky((-90, (0.02, 0.02, 0.03)), (0, (0.05, 0.04, 0.08)), (90, (0.07, 0.06, 0.12))),
        insets=(Inset(0.03, 0.05, 0.3, 0.42), Inset(0.42, 0.02, 0.3, 0.3), Inset(0.72, 0.3, 0.26, 0.4)),
    )


def _stage(builder: Builder) -> None:
    floor = builder.material("lacquer", (0.035, 0.02, 0.06), roughness=0.3)
    builder.box(floor, (0.0, -0.02, -1.0), (8.0, 0.04, 3.6))
    curtain = builder.material("curtain", (0.06, 0.03, 0.10), roughness=0.95, specular=0.0)
    builder.add(unit_rectangle(), curtain, translate=(0.0, 0.0, -2.8), scale=(6.0, 3.0, 1.0))
    softbox = builder.emitter("softbox", (24.0, 23.0, 22.0))
    builder.add(unit_rectangle(), softbox, translate=(0.9, 1.1, 0.9), rotate=(-40, -135, 0), scale=0.35)


def _swan(builder: Builder) -> None:
    """A swan of ellipsoids and rods on a low plinth."""
    china = builder.material("porcelain", (0.82, 0.80, 0.78), roughness=0.22)
    black = builder.material("black", (0.02, 0.02, 0.02), roughness=0.3)
    beak = builder.material("beak", (0.80, 0.28, 0.06), roughness=0.4)
    plinth = [(0.0, 0.0), (0.115, 0.0), (0.115, 0.014), (0.106, 0.02), (0.0, 0.02)]
    builder.add(lathe(plinth, 96), black)
    builder.add(unit_sphere(), china, translate=(0.0, 0.066, 0.0), scale=(0.088, 0.05, 0.055))
    builder.add(unit_sphere(), china, translate=(0.085, 0.09, 0.0), rotate=(0, 0, 35), scale=(0.05, 0.018, 0.025))
    for side in (-1.0, 1.0):
        builder.add(
            unit_sphere(),
            china,
            translate=(0.018, 0.098, 0.04 * side),
            rotate=(14.0 * side, 0.0, 18.0),
            scale=(0.078, 0.042, 0.012),
        )
    t = np.linspace(0.0, 1.0, 40)
    angle = np.pi * (1.35 * t - 0.42)
    neck = np.stack([-0.086 - 0.026 * np.cos(angle) + 0.014 * t, 0.085 + 0.115 * t + 0.016 * np.sin(angle), 0 * t], axis=1)
    for start, end in pairwise(neck):
        builder.add(cable(np.array([start, end]), 0.0135, 24), china)
    builder.spheres(china, neck, 0.0135)
    head = neck[-1]
    builder.add(unit_sphere(), china, translate=head + (-0.008, 0.0, 0), rotate=(0, 0, 20), scale=(0.024, 0.016, 0.016))
    builder.add(unit_sphere(), beak, translate=head + (-0.034, -0.010, 0), rotate=(0, 0, 22), scale=(0.016, 0.005, 0.006))
    builder.spheres(black, head + [[-0.014, 0.004, 0.0135], [-0.014, 0.004, -0.0135]], 0.0028)


def _specks(builder: Builder) -> None:
    """200 specks in a horizontal band of the frame, at depths from 0.45 m to 3.6 m."""
    rng = np.random.default_rng(21)
    count = 200
    depth = np.exp(rng.uniform(np.log(0.45), np.log(3.6), count))
    across = rng.uniform(-0.42, 0.42, count)
    up = rng.normal(0.03, 0.09, count)
    # Specks between the lens and the swan stay beside the swan.
    beside = np.where(across < 0.0, -1.0, 1.0) * rng.uniform(0.2, 0.42, count)
    across = np.where(depth < 1.0, beside, across)
    height = CAMERA.position[1] + (up - 0.11) * depth
    height = np.maximum(height, rng.uniform(0.01, 0.03, count))
    centres = np.stack([across * depth, height, CAMERA.position[2] - depth], axis=1)
    radii = np.maximum(emitter_radius(CAMERA, centres, rng.uniform(0.003, 0.008, count)), SMALLEST)
    colors = ((95.0, 58.0, 20.0), (95.0, 28.0, 45.0), (24.0, 62.0, 88.0), (65.0, 60.0, 52.0))
    kinds = rng.integers(0, len(colors), count)
    for number, color in enumerate(colors):
        chosen = kinds == number
        builder.spheres(builder.emitter("speck", color), centres[chosen], radii[chosen])
