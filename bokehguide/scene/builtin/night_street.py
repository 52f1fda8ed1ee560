"""A wet street at night: the distant city is an environment map, the near lamps are geometry."""

from __future__ import annotations

import numpy as np

from bokehguide.scene.builtin.parts import Builder, emitter_radius, lathe, ring, rod
from bokehguide.scene.environments import gradient
from bokehguide.scene.shapes import unit_rectangle
from bokehguide.scene.types import Camera, Environment, Inset, Scene

DESCRIPTION = "a hydrant on a wet street; lamps and windows from a map and from geometry"

CAMERA = Camera(position=(0.0, 0.95, 3.0), target=(0.0, 0.66, 0.0), fov=40.0, aperture_radius=0.12, focus_distance=3.0)

SODIUM, WHITE, RED, GREEN = ((190.0, 105.0, 35.0), (150.0, 140.0, 115.0), (190.0, 18.0, 10.0), (25.0, 150.0, 85.0))

MAP_HEIGHT = 1024
"""Rows. A texel is 0.18° wide, so that 2 × 2 texels cover 0.75 % of the lens."""


def night_street() -> Scene:
    """Emitters at infinity and nearby, above a street that reflects them."""
    builder = Builder()
    _street(builder)
    _hydrant(builder)
    _houses(builder)
    _lamp_posts(builder)
    _traffic(builder)
    return Scene(
        name="night-street",
        description=DESCRIPTION,
        camera=CAMERA,
        meshes=builder.meshes(),
        materials=tuple(builder.materials),
        environment=Environment(city_map()),
        insets=(Inset(0.03, 0.05, 0.3, 0.4), Inset(0.40, 0.08, 0.2, 0.3), Inset(0.66, 0.05, 0.3, 0.4)),
    )


def city_map() -> np.ndarray:
    """The distant city, float32 `[1024, 2048, 3]`: dusk, dark blocks, windows and lamps."""
    rng = np.random.default_rng(2)
    stops = ((-90, (0.01,) * 3), (-1, (0.02,) * 3), (1, (0.10, 0.07, 0.07)), (12, (0.03, 0.035, 0.06)))
    city = gradient((*stops, (90, (0.008, 0.01, 0.025))), MAP_HEIGHT)
    horizon, width = MAP_HEIGHT // 2, 2 * MAP_HEIGHT
    left = 0
    while left < width:
        block, height = int(rng.integers(24, 60)), int(rng.integers(18, 85))
        city[horizon - height : horizon + 4, left : left + block] = (0.012, 0.013, 0.018)
        _light_windows(city, rng, left, min(left + block, width), horizon - height, horizon - 5)
        left += block + int(rng.integers(0, 14))
    for color, count, highest in ((SODIUM, 70, 16), (WHITE, 50, 30), (RED, 24, 90), (GREEN, 14, 12)):
        rows = horizon - rng.integers(2, highest, count)
        for row, column in zip(rows, rng.integers(0, width - 2, count)):
            city[row : row + 2, column : column + 2] = color
    return city


def _light_windows(city: np.ndarray, rng: np.random.Generator, left: int, right: int, top: int, bottom: int) -> None:
    """Light one in seven windows of a block, each with its own tint."""
    for row in range(top + 3, bottom, 7):
        for column in range(left + 3, right - 2, 6):
            if rng.random() < 0.14:
                warmth = rng.uniform(0.35, 1.0)
                tint = (1.0, 0.55 + 0.3 * warmth, 0.2 + 0.6 * warmth)
                city[row : row + 2, column : column + 1] = rng.uniform(20.0, 70.0) * np.array(tint)


def _street(builder: Builder) -> None:
    asphalt = builder.material("wet asphalt", (0.03, 0.03, 0.032), roughness=0.22)
    paving = builder.material("paving", (0.16, 0.15, 0.14), roughness=0.45)
    paint = builder.material("paint", (0.55, 0.55, 0.50), roughness=0.5)
    front = builder.emitter("shop front", (3.5, 3.0, 2.4))
    builder.add(unit_rectangle(), front, translate=(-3.0, 2.2, 4.0), rotate=(25.0, 142.0, 0.0), scale=(1.2, 0.7, 1))
    builder.add(unit_rectangle(), asphalt, translate=(0.0, 0.0, -40.0), rotate=(-90, 0, 0), scale=(60, 60, 1))
    builder.box(paving, (0.0, 0.06, 1.1), (9.0, 0.12, 3.6))
    builder.box(paving, (-6.6, 0.06, -30.0), (3.0, 0.12, 50.0))
    builder.box(paving, (6.6, 0.06, -30.0), (3.0, 0.12, 50.0))
    for z in np.arange(-4.0, -40.0, -3.0):
        builder.box(paint, (-0.2, 0.003, z), (0.14, 0.006, 1.4))


def _hydrant(builder: Builder) -> None:
    red = builder.material("red enamel", (0.60, 0.035, 0.03), roughness=0.25)
    brass = builder.material("brass", (0.91, 0.72, 0.34), metallic=1.0, roughness=0.3)
    iron = builder.material("chain", (0.35, 0.35, 0.36), metallic=1.0, roughness=0.4)
    foot = np.array([-0.22, 0.12, 0.05])
    body = [(0.0, 0.0), (0.15, 0.0), (0.15, 0.035), (0.105, 0.05), (0.10, 0.34), (0.125, 0.36)]
    body += [(0.125, 0.395), (0.105, 0.41), (0.09, 0.47), (0.055, 0.525), (0.03, 0.54)]
    body += [(0.028, 0.58), (0.0, 0.58)]
    builder.add(lathe(body, 96), red, translate=foot)
    for end, radius, metal in (((0.18, 0, 0), 0.05, brass), ((-0.18, 0, 0), 0.05, brass)):
        middle = foot + (0.0, 0.27, 0.0)
        builder.add(rod(middle, middle + end, radius, 48), red)
        builder.add(rod(middle + np.multiply(0.86, end), middle + np.multiply(1.1, end), 0.06, 6), metal)
    front = foot + (0.0, 0.25, 0.0)
    builder.add(rod(front, front + (0, 0, 0.15), 0.065, 48), red)
    builder.add(rod(front + (0, 0, 0.13), front + (0, 0, 0.175), 0.078, 6), brass)
    for number in range(8):
        angle = 2.0 * np.pi * number / 8
        bolt = foot + (0.128 * np.sin(angle), 0.035, 0.128 * np.cos(angle))
        builder.add(rod(bolt, bolt + (0, 0.02, 0), 0.013, 6), brass)
    post = np.array([0.62, 0.12, -0.1])
    builder.add(rod(post, post + (0.0, 0.72, 0.0), 0.035, 48), iron)
    builder.spheres(iron, post + (0.0, 0.75, 0.0), 0.05)
    builder.add(ring(0.037, 0.008, 48), brass, translate=post + (0.0, 0.6, 0.0))


def _houses(builder: Builder) -> None:
    """Dark houses along both pavements, with a few lit windows."""
    brick = builder.material("brick", (0.14, 0.08, 0.06), roughness=0.9)
    shop = builder.emitter("shop window", (2.2, 1.5, 0.8))
    rng = np.random.default_rng(9)
    for side in (-1.0, 1.0):
        for z in (-11.0, -19.0, -28.0):
            height = 4.0 + 2.0 * rng.random()
            builder.box(brick, (9.0 * side, height / 2, z), (2.0, height, 7.0))
            builder.add(
                unit_rectangle(), shop, translate=(7.98 * side, 1.5, z + 1.0), rotate=(0, -90 * side, 0), scale=(1.2, 0.5, 1)
            )


def _lamp_posts(builder: Builder) -> None:
    iron = builder.material("iron", (0.04, 0.045, 0.05), roughness=0.5)
    sodium = builder.emitter("sodium lamp", SODIUM)
    heads = []
    for z in (-5.0, -9.5, -15.0, -22.0):
        for side in (-1.0, 1.0):
            x = side * (1.6 + 0.16 * abs(z))
            builder.add(rod((x, 0.0, z), (x, 2.2 + 0.06 * abs(z), z), 0.05), iron)
            heads.append((x - 0.12 * side, 2.2 + 0.06 * abs(z), z))
            heads.append((x + 0.12 * side, 2.2 + 0.06 * abs(z), z))
    heads = np.array(heads)
    builder.spheres(sodium, heads, emitter_radius(CAMERA, heads, 0.007))


def _traffic(builder: Builder) -> None:
    """One oncoming car, two leaving cars, and traffic lights."""
    paint = builder.material("car", (0.05, 0.06, 0.09), roughness=0.2)
    white, red, green = (
        builder.emitter(name, color) for name, color in (("headlamp", WHITE), ("tail lamp", RED), ("signal", GREEN))
    )
    for x, z, lamp in ((-2.0, -9.0, white), (1.6, -7.0, red), (2.2, -16.0, red)):
        builder.box(paint, (x, 0.55, z - 2.0), (1.6, 0.5, 3.6))
        builder.box(paint, (x, 0.95, z - 2.2), (1.4, 0.4, 2.0))
        pair = np.array([(x - 0.6, 0.6, z - 0.1), (x + 0.6, 0.6, z - 0.1)])
        builder.spheres(lamp, pair, emitter_radius(CAMERA, pair, 0.008))
    signals = np.array([(0.75, 2.3, -12.0), (-1.1, 2.0, -18.0)])
    builder.spheres(green, signals, emitter_radius(CAMERA, signals, 0.008))
