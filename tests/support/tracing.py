"""Scenes of a few shapes, and the radiance along one ray of them, for tests of the path tracer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from bokehguide.render.geometry import Geometry
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene.shapes import transform, transformed, unit_rectangle, unit_sphere
from bokehguide.scene.types import Camera, Environment, FilmSettings, Material, Mesh, Scene, Texture
from tests.support.statistical import z_test

CAMERA = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0))
UP, DOWN = (-90.0, 0.0, 0.0), (90.0, 0.0, 0.0)
"""Rotations that turn a rectangle's front to +y and to -y."""


def matte(color: float | tuple[float, float, float] = 0.5, **others) -> Material:
    """A pure Lambertian."""
    color = (color,) * 3 if isinstance(color, float) else color
    return Material("matte", color, **({"specular": 0.0} | others))


def emitter(radiance: float = 1.0, **others) -> Material:
    """A black emitter."""
    return Material("emitter", (0.0, 0.0, 0.0), specular=0.0, emission=(radiance, 2.0 * radiance, 3.0 * radiance), **others)


def rectangle(material: int, translate=(0.0, 0.0, 0.0), rotate=(0.0, 0.0, 0.0), scale=1.0) -> Mesh:
    """The 2 × 2 rectangle, moved."""
    return replace(transformed(unit_rectangle(), transform(translate, rotate, scale)), material=material)


def sphere(material: int, centre=(0.0, 0.0, 0.0), radius: float = 1.0) -> Mesh:
    return replace(transformed(unit_sphere(), transform(centre, scale=radius)), material=material)


def inward(mesh: Mesh) -> Mesh:
    """The mesh turned inside out, with flat faces."""
    return replace(mesh, triangles=np.ascontiguousarray(mesh.triangles[:, ::-1]), normals=None)


def scene(meshes, materials, environment: Environment | None = None, max_depth: int = 2) -> Scene:
    return Scene("test", CAMERA, tuple(meshes), tuple(materials), FilmSettings(8, 8, max_depth), environment)


def sky(radiance: float) -> Environment:
    return Environment(np.full((1, 1, 3), radiance, np.float32))


def trace(scene: Scene, origin, direction, count: int, seed: int = 0):
    """The path tracer's samples for `count` copies of a ray."""
    direction = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    rays = (torch.tensor(np.asarray(v), dtype=torch.float32)[:, None].repeat(1, count) for v in (origin, direction))
    with torch.no_grad():
        return PathTracer(scene).trace(*rays, PixelRandom(seed, 0, torch.arange(count)), PhaseTimer())


def estimates(scene: Scene, origin, direction, count: int = 20_000, seed: int = 0) -> np.ndarray:
    """Independent one-sample estimates `[3, count]` of the radiance along a ray."""
    return trace(scene, origin, direction, count, seed).radiance.double().numpy()


def mean_test(samples: np.ndarray, expected, tolerance: float = 0.0) -> float:
    """p-value of the means of `[3, N]` samples being `expected`, known to a relative `tolerance`."""
    expected = np.broadcast_to(np.asarray(expected, np.float64), 3)
    error = samples.std(axis=1, ddof=1) / np.sqrt(samples.shape[1]) + tolerance * expected
    return z_test(samples.mean(axis=1) - expected, error)


def agreement(a: np.ndarray, b: np.ndarray) -> float:
    """p-value of two sets of samples `[3, N]` having the same means."""
    variance = a.var(axis=1, ddof=1) / a.shape[1] + b.var(axis=1, ddof=1) / b.shape[1]
    return z_test(a.mean(axis=1) - b.mean(axis=1), np.sqrt(variance))


def bumpy() -> Texture:
    """A normal map of random bumps."""
    generator = np.random.default_rng(5)
    return Texture(np.append(generator.uniform(0.3, 0.7, (8, 8, 2)), np.ones((8, 8, 1)), axis=2).astype(np.float32))


def found(geometry: Geometry, origins, directions):
    """Hits and surfaces of rays `[N, 3]` that all hit."""
    origins = torch.tensor(np.asarray(origins).T.copy(), dtype=torch.float32)
    directions = torch.nn.functional.normalize(torch.tensor(np.asarray(directions).T.copy(), dtype=torch.float32), dim=0)
    hit = geometry.tracer.intersect(origins, directions)
    assert (hit.triangle >= 0).all()
    return hit, geometry.surface(origins, directions, hit)
