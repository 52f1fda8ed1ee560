"""A vase with lit twigs on a transparent background."""

from __future__ import annotations

import numpy as np

from bokehguide.scene.builtin.parts import Builder, cable, emitter_radius, lathe, ring
from bokehguide.scene.shapes import unit_rectangle
from bokehguide.scene.types import Camera, Inset, Scene

DESCRIPTION = "a vase and lit twigs over an empty background: alpha below one"

CAMERA = Camera(position=(0.0, 0.27, 1.1), target=(0.0, 0.21, 0.0), fov=40.0, aperture_radius=0.045, focus_distance=1.1)


def cutout() -> Scene:
    """Highlights on a background without radiance and alpha."""
    builder = Builder()
    _vase(builder)
    _twigs(builder)
    _drifting(builder)
    return Scene(
        name="cutout",
        description=DESCRIPTION,
        camera=CAMERA,
        meshes=builder.meshes(),
        materials=tuple(builder.materials),
        insets=(Inset(0.02, 0.1, 0.28, 0.45), Inset(0.36, 0.02, 0.28, 0.3), Inset(0.7, 0.1, 0.28, 0.45)),
    )


def _vase(builder: Builder) -> None:
    glaze = builder.material("glaze", (0.06, 0.22, 0.30), roughness=0.18)
    stone = builder.material("stone", (0.55, 0.53, 0.50), roughness=0.8)
    gold = builder.material("gold", (1.0, 0.77, 0.34), metallic=1.0, roughness=0.2)
    base = [(0.0, 0.0), (0.15, 0.0), (0.15, 0.022), (0.145, 0.028), (0.0, 0.028)]
    builder.add(lathe(base, 96), stone)
    vase = [(0.0, 0.028), (0.034, 0.028), (0.048, 0.045), (0.055, 0.07), (0.048, 0.10)]
    vase += [(0.026, 0.128), (0.021, 0.145), (0.029, 0.158), (0.026, 0.159), (0.018, 0.146)]
    vase += [(0.018, 0.13), (0.0, 0.12)]
    builder.add(lathe(vase, 96), glaze)
    builder.add(ring(0.0545, 0.0028, 96), gold, translate=(0.0, 0.074, 0.0))
    builder.spheres(gold, ((0.105, 0.046, 0.05), (-0.112, 0.043, 0.04)), (0.018, 0.015))
    for x, radiance in ((-1.0, (12.0, 11.3, 10.5)), (1.2, (4.5, 5.3, 7.0))):
        softbox = builder.emitter("softbox", radiance)
        builder.add(
            unit_rectangle(), softbox, translate=(x, 0.9, 1.0), rotate=(40.0, 180.0 - 45.0 * np.sign(-x), 0.0), scale=0.35
        )


def _twigs(builder: Builder) -> None:
    """Twigs that lean out of the focal plane, with luminous buds every few centimetres."""
    bark = builder.material("bark", (0.16, 0.09, 0.05), roughness=0.8)
    bulbs = [builder.emitter("bud", color) for color in ((170, 110, 50), (180, 75, 40))]
    rng = np.random.default_rng(8)
    for number in range(11):
        turn = 2.399963 * number
        lean = rng.uniform(0.3, 1.0)
        length = rng.uniform(0.16, 0.24)
        t = np.linspace(0.0, 1.0, 10)[:, None]
        out = np.array([np.sin(turn), 0.0, 1.4 * np.cos(turn) - 0.6])
        path = (0.0, 0.14, 0.0) + length * (t * (0, 1.0, 0) + lean * t**1.6 * out)
        path += 0.004 * rng.normal(size=path.shape) * (t > 0.1)
        builder.add(cable(path, 0.0018, 10), bark)
        buds = path[3:] + (0.0, 0.003, 0.0)
        depth = CAMERA.position[2] - buds[:, 2]
        buds = buds[np.abs(depth - CAMERA.focus_distance) > 0.05]
        if len(buds):
            builder.spheres(bulbs[number % 2], buds, emitter_radius(CAMERA, buds, 0.009))


def _drifting(builder: Builder) -> None:
    """Lamps in mid-air, far behind the focal plane and close to the lens."""
    rng = np.random.default_rng(13)
    for color, count, near, far in (
        ((125.0, 76.0, 34.0), 16, 2.0, 3.6),
        ((42.0, 80.0, 125.0), 12, 2.0, 3.6),
        ((120.0, 42.0, 75.0), 6, 0.5, 0.62),
    ):
        depth = rng.uniform(near, far, count)
        side = np.where(np.arange(count) % 2, 1.0, -1.0)
        across = side * rng.uniform(0.13, 0.36, count)
        centres = np.stack([across * depth, 0.24 + depth * rng.uniform(-0.12, 0.18, count), 1.1 - depth], axis=1)
        radii = emitter_radius(CAMERA, centres, rng.uniform(0.003, 0.008, count))
        builder.spheres(builder.emitter("lamp", color), centres, radii)
