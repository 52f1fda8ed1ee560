"""Scenes with unusual emitters for lens sampling: near the focal plane, at the poles of a map, and far from the optical axis."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from bokehguide.scene.shapes import transform, transformed, unit_sphere
from bokehguide.scene.types import Camera, Environment, FilmSettings, Scene
from tests.support.scenes import LAMP, constant_sky

EMITTERS = 60


def crowd(width: int, height: int) -> Scene:
    """Long ellipsoids in all directions. Some cross the focal plane, and some are larger on the lens than the lens."""
    generator, meshes = np.random.default_rng(2), []
    for _ in range(EMITTERS):
        depth = 2.0 + generator.uniform(-0.8, 2.0)
        centre = (*(depth * 0.3 * generator.uniform(-1.0, 1.0, 2) * (1.7, 1.0)), -depth)
        shape = transform(centre, tuple(generator.uniform(-180.0, 180.0, 3)), tuple(0.3 * generator.uniform(0.05, 1.0, 3)))
        meshes.append(replace(transformed(unit_sphere(), shape), material=0))
    camera = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=40.0, aperture_radius=0.3, focus_distance=2.0)
    return Scene("crowd", camera, tuple(meshes), (LAMP,), FilmSettings(width, height, max_depth=1), constant_sky(0.1))


def pole(width: int, height: int, degrees: float) -> Scene:
    """A turned map with bright texels and slanted lines, before a wide lens.

    degrees: of the optical axis above the horizon.
    """
    radiance = np.full((48, 96, 3), 0.1, np.float32)
    generator = np.random.default_rng(5)
    for row in (0, 1, 5, 12, 18, 28, 34, 40, 46, 47):
        for column in generator.choice(96, 6, replace=False):
            radiance[row, column] = generator.uniform(100.0, 300.0)
    for row, column in ((7, 22), (20, 60), (25, 85), (36, 40)):  # slanted
        for step in range(8):
            radiance[row + step, column + (step if row % 2 else -step)] = 200.0
    height_of_axis, forward = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
    camera = Camera((0.0, 0.0, 0.0), (0.0, height_of_axis, -forward), fov=110.0, aperture_radius=0.4, focus_distance=1.0)
    meshes = (replace(transformed(unit_sphere(), transform((0.0, 0.0, 9.0), (0.0, 0.0, 0.0), 0.01)), material=0),)
    return Scene("pole", camera, meshes, (LAMP,), FilmSettings(width, height, max_depth=1), Environment(radiance, 70.0))
