"""A wooden angel and parcels on a table, with strings of lamps and a lit tree in the background."""

from __future__ import annotations

import numpy as np

from bokehguide.scene.builtin.parts import Builder, cable, emitter_radius, hanging, lathe, ring
from bokehguide.scene.environments import sky
from bokehguide.scene.shapes import unit_rectangle, unit_sphere
from bokehguide.scene.types import Camera, Inset, Scene, Vector

DESCRIPTION = "a wooden angel in focus before strings of small coloured lamps"

CAMERA = Camera(position=(0.0, 0.27, 0.95), target=(0.0, 0.145, 0.0), fov=40.0, aperture_radius=0.04, focus_distance=0.95)

WARM, AMBER, RED, GREEN, BLUE = (
    (170.0, 105.0, 45.0),
    (190.0, 80.0, 18.0),
    (190.0, 22.0, 14.0),
    (35.0, 150.0, 45.0),
    (40.0, 75.0, 190.0),
)


def fairy_lights() -> Scene:
    """The scene of `make render`."""
    builder = Builder()
    _room(builder)
    _angel(builder, x=-0.085)
    _parcels(builder)
    _tree(builder)
    _strings(builder)
    return Scene(
        name="fairy-lights",
        description=DESCRIPTION,
        camera=CAMERA,
        meshes=builder.meshes(),
        materials=tuple(builder.materials),
        environment=sky((-90, (0.02, 0.02, 0.025)), (0, (0.04, 0.045, 0.06)), (90, (0.05, 0.06, 0.09))),
        insets=(Inset(0.02, 0.05, 0.26, 0.4), Inset(0.45, 0.03, 0.25, 0.4), Inset(0.7, 0.2, 0.28, 0.4)),
    )


def _room(builder: Builder) -> None:
    table = builder.material("table", (0.28, 0.13, 0.06), roughness=0.45)
    builder.box(table, (0.0, -0.02, -0.2), (2.2, 0.04, 1.3))
    wall = builder.material("wall", (0.10, 0.12, 0.16), roughness=0.9)
    builder.add(unit_rectangle(), wall, translate=(0.0, 0.0, -3.4), scale=(6.0, 3.0, 1.0))
    # A dim window to the left of the camera lights the front of the objects.
    window = builder.emitter("window", (13.0, 11.0, 9.0))
    builder.add(unit_rectangle(), window, translate=(-1.1, 0.9, 1.0), rotate=(30.0, 130.0, 0.0), scale=0.35)


def _angel(builder: Builder, x: float) -> None:
    robe = builder.material("robe", (0.75, 0.70, 0.62), roughness=0.6)
    skin = builder.material("wood", (0.72, 0.48, 0.30), roughness=0.5)
    gold = builder.material("gold", (1.0, 0.77, 0.34), metallic=1.0, roughness=0.25)
    wing = builder.material("wing", (0.62, 0.40, 0.22), roughness=0.55)
    skirt = [(0.0, 0.0), (0.052, 0.0), (0.054, 0.004), (0.046, 0.04), (0.036, 0.08)]
    skirt += [(0.027, 0.115), (0.019, 0.14), (0.012, 0.152), (0.0, 0.154)]
    builder.add(lathe(skirt), robe, translate=(x, 0.0, 0.0))
    builder.add(ring(0.0465, 0.004), gold, translate=(x, 0.036, 0.0))
    builder.add(unit_sphere(), skin, translate=(x, 0.174, 0.0), scale=0.026)
    builder.add(ring(0.024, 0.0025), gold, translate=(x, 0.212, -0.006), rotate=(14, 0, 0))
    for side in (-1.0, 1.0):
        builder.add(
            unit_sphere(),
            wing,
            translate=(x + 0.048 * side, 0.135, -0.022),
            rotate=(0.0, 20.0 * side, -38.0 * side),
            scale=(0.018, 0.05, 0.006),
        )
        builder.add(
            unit_sphere(),
            robe,
            translate=(x + 0.026 * side, 0.122, 0.016),
            rotate=(-50.0, 0.0, 28.0 * side),
            scale=(0.011, 0.032, 0.011),
        )


def _parcels(builder: Builder) -> None:
    red = builder.material("red paper", (0.55, 0.04, 0.04), roughness=0.35)
    blue = builder.material("blue paper", (0.05, 0.14, 0.32), roughness=0.35)
    ribbon = builder.material("ribbon", (0.85, 0.68, 0.30), roughness=0.3, metallic=0.6)
    bauble = builder.material("bauble", (0.85, 0.12, 0.10), metallic=1.0, roughness=0.12)
    silver = builder.material("silver", (0.9, 0.9, 0.92), metallic=1.0, roughness=0.1)
    _parcel(builder, red, ribbon, (0.06, 0.0, -0.03), (0.11, 0.075, 0.09), 24.0)
    _parcel(builder, blue, ribbon, (0.175, 0.0, -0.09), (0.10, 0.12, 0.10), -18.0)
    builder.spheres(bauble, (0.005, 0.024, 0.075), 0.024)
    builder.spheres(silver, (0.145, 0.019, 0.055), 0.019)
    builder.spheres(bauble, (-0.21, 0.03, -0.1), 0.03)


def _parcel(builder: Builder, paper: int, ribbon: int, foot: Vector, size: Vector, turn: float) -> None:
    """A box that stands on `foot`, with two slightly larger crossing bands as its ribbon."""
    width, height, depth = size
    centre = np.add(foot, (0.0, height / 2.0, 0.0))
    rotate = (0.0, turn, 0.0)
    builder.box(paper, centre, size, rotate=rotate)
    builder.box(ribbon, centre, (0.16 * width, height + 0.003, depth + 0.003), rotate=rotate)
    builder.box(ribbon, centre, (width + 0.003, height + 0.003, 0.16 * depth), rotate=rotate)
    top = np.add(foot, (0.0, height + 0.010, 0.0))
    for tilt in (-45.0, 45.0):
        loop = ring(0.012, 0.003, sections=32)
        builder.add(loop, ribbon, translate=top, rotate=(90.0, turn + tilt, 0.0), scale=(1.5, 1, 0.8))


def _tree(builder: Builder) -> None:
    """Three stacked cones with lamps on a spiral."""
    needles = builder.material("needles", (0.03, 0.10, 0.05), roughness=0.8)
    foot, top = np.array([0.62, -0.5, -1.75]), 1.55
    for base, peak, radius in ((0.25, 0.95, 0.52), (0.6, 1.25, 0.40), (0.95, top, 0.28)):
        cone = lathe([(0.0, base), (radius, base), (0.0, peak)])
        builder.add(cone, needles, translate=foot)
    height = np.linspace(0.3, 1.5, 24)
    angle = 2.399963 * np.arange(24)  # the golden angle distributes the lamps evenly
    distance = 0.47 * (top + 0.03 - height) / 1.25
    centres = foot + np.stack([distance * np.sin(angle), height, np.abs(distance * np.cos(angle)) + 0.03], axis=1)
    for color, chosen in ((WARM, slice(0, None, 2)), (RED, slice(1, None, 4)), (BLUE, slice(3, None, 4))):
        _lamps(builder, color, centres[chosen], 0.006)


def _strings(builder: Builder) -> None:
    wire = builder.material("wire", (0.02, 0.03, 0.02), roughness=0.6)
    strings = (
        (hanging((-1.5, 0.75, -2.3), (0.5, 0.85, -2.6), 0.22, 17), (WARM, AMBER), 0.007),
        (hanging((-1.2, 0.30, -1.7), (0.3, 0.48, -2.1), 0.14, 13), (AMBER, GREEN, WARM), 0.004),
        (hanging((-0.6, 0.02, -1.4), (0.45, 0.10, -1.5), 0.06, 9), (WARM, RED, BLUE), 0.005),
        (hanging((-0.21, 0.24, 0.42), (-0.07, 0.105, 0.50), 0.01, 4), (WARM,), 0.008),
        (hanging((0.08, 0.11, 0.49), (0.22, 0.17, 0.42), 0.01, 3), (AMBER, GREEN), 0.008),
    )
    for points, colors, coverage in strings:
        builder.add(cable(points + (0.0, 0.004, 0.0), 0.0008), wire)
        for number, color in enumerate(colors):
            _lamps(builder, color, points[number :: len(colors)], coverage)


def _lamps(builder: Builder, color: Vector, centres: np.ndarray, coverage: float) -> None:
    """Lamps that cover the fraction `coverage` of the lens."""
    builder.spheres(builder.emitter("lamp", color), centres, emitter_radius(CAMERA, centres, coverage))
