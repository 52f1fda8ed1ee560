"""A porcelain swan in a swirl of glowing specks that runs from the lens to far behind."""

from __future__ import annotations

import numpy as np

from bokehguide.scene.builtin.parts import Builder, cable, lamp_radius, lathe, sky
from bokehguide.scene.shapes import unit_rectangle, unit_sphere
from bokehguide.scene.types import Camera, Inset, Scene

DESCRIPTION = "hundreds of bright specks at many depths, overlapping on the raster"

CAMERA = Camera(
    position=(0.0, 0.24, 1.0),
    target=(0.0, 0.13, 0.0),
    fov=40.0,
    aperture_radius=0.04,
    focus_distance=1.0,
)

SMALLEST = 0.0006
"""Metres; near the focal plane no size covers a small share of the lens."""


def glitter() -> Scene:
    """Highlights of different depths that share a pixel."""
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
        insets=(
            Inset(0.03, 0.05, 0.3, 0.42),
            Inset(0.42, 0.02, 0.3, 0.3),
            Inset(0.72, 0.3, 0.26, 0.4),
        ),
    )


def _stage(builder: Builder) -> None:
    floor = builder.material("lacquer", (0.035, 0.02, 0.06), roughness=0.3)
    builder.box(floor, (0.0, -0.02, -1.0), (8.0, 0.04, 3.6))
    curtain = builder.material("curtain", (0.06, 0.03, 0.10), roughness=0.95, specular=0.0)
    builder.add(unit_rectangle(), curtain, translate=(0.0, 0.0, -2.8), scale=(6.0, 3.0, 1.0))
    softbox = builder.lamp("softbox", (5.0, 4.8, 4.6))
    builder.add(
        unit_rectangle(), softbox, translate=(0.9, 1.1, 0.9), rotate=(-40, -135, 0), scale=0.35
    )


def _swan(builder: Builder) -> None:
    """Body, neck and head of turned and bent bodies, on a low plinth."""
    china = builder.material("porcelain", (0.82, 0.80, 0.78), roughness=0.22)
    black = builder.material("black", (0.02, 0.02, 0.02), roughness=0.3)
    beak = builder.material("beak", (0.80, 0.28, 0.06), roughness=0.4)
    plinth = [(0.0, 0.0), (0.115, 0.0), (0.115, 0.014), (0.106, 0.02), (0.0, 0.02)]
    builder.add(lathe(plinth, 96), black)
    builder.add(unit_sphere(), china, translate=(0.0, 0.066, 0.0), scale=(0.088, 0.05, 0.055))
    builder.add(
        unit_sphere(), china, translate=(0.085, 0.09, 0.0), rotate=(0, 0, 35), scale=(0.05, 0.018, 0.025)
    )
    for side in (-1.0, 1.0):
        builder.add(
            unit_sphere(), china,
            translate=(0.018, 0.098, 0.04 * side),
            rotate=(14.0 * side, 0.0, 18.0),
            scale=(0.078, 0.042, 0.012),
        )
    t = np.linspace(0.0, 1.0, 40)
    angle = np.pi * (1.35 * t - 0.42)
    neck = np.stack(
        [-0.086 - 0.026 * np.cos(angle) + 0.014 * t, 0.085 + 0.115 * t + 0.016 * np.sin(angle), 0 * t],
        axis=1,
    )
    for start, end in zip(neck[:-1], neck[1:]):
        builder.add(cable(np.array([start, end]), 0.0135, 24), china)
    builder.balls(china, neck, 0.0135)
    head = neck[-1]
    builder.add(
        unit_sphere(), china, translate=head + (-0.008, 0.0, 0), rotate=(0, 0, 20), scale=(0.024, 0.016, 0.016)
    )
    builder.add(
        unit_sphere(), beak, translate=head + (-0.034, -0.010, 0), rotate=(0, 0, 22), scale=(0.016, 0.005, 0.006)
    )
    builder.balls(black, head + [[-0.014, 0.004, 0.0135], [-0.014, 0.004, -0.0135]], 0.0028)


def _specks(builder: Builder) -> None:
    """240 specks on a rising spiral around the swan and along the line of sight."""
    rng = np.random.default_rng(21)
    count = 240
    depth = 1.0 / rng.uniform(1.0 / 3.6, 1.0 / 0.42, count)
    turn = 4.2 * np.log(depth) + rng.normal(0.0, 0.8, count)
    turn += np.where(rng.random(count) < 0.5, 0.0, np.pi)
    spread = depth * rng.uniform(0.16, 0.44, count)
    # The line of sight falls 0.11 m a metre; the spiral follows it, a little above.
    height = 0.25 - 0.08 * depth + 0.42 * spread * np.sin(turn)
    centres = np.stack([spread * np.cos(turn), height, 1.0 - depth], axis=1)
    # Nothing sinks into the floor, and nothing hides the swan.
    centres[:, 1] = np.maximum(centres[:, 1], 0.012 + 0.01 * rng.random(count))
    near = np.abs(depth - 1.0) < 0.16
    centres[near, 0] += np.where(centres[near, 0] < 0.0, -0.16, 0.16)
    radii = np.maximum(lamp_radius(CAMERA, centres, rng.uniform(0.003, 0.008, count)), SMALLEST)
    colors = ((85.0, 52.0, 18.0), (85.0, 26.0, 42.0), (22.0, 58.0, 80.0), (60.0, 55.0, 48.0))
    kinds = rng.integers(0, len(colors), count)
    for number, color in enumerate(colors):
        chosen = kinds == number
        builder.balls(builder.lamp("speck", color), centres[chosen], radii[chosen])
