"""Analytic radiance of emitters and glass, and checks of renders against it as p-values."""

from __future__ import annotations

import math

import numpy as np
import torch

from bokehguide.render.lens import Lens
from bokehguide.render.random import PixelRandom
from bokehguide.scene.types import Material
from tests.support.statistical import chi_square
from tests.support.tracing import DOWN, UP, emitter, estimates, matte, mean_test, rectangle, scene

LIGHT = np.array([1.0, 2.0, 3.0])
"""Radiance of `tracing.emitter` per unit."""
RECTANGLE = np.array([[-0.2, 1.0, -0.4], [0.8, 1.0, -0.4], [0.8, 1.0, 0.6], [-0.2, 1.0, 0.6]])
"""Corners of the emitter of `under_a_rectangle`."""


def polygon_irradiance(corners: np.ndarray, normal: np.ndarray) -> float:
    """Irradiance at the origin from a polygon of radiance 1 above the horizon (Lambert)."""
    unit = corners / np.linalg.norm(corners, axis=1, keepdims=True)
    total = 0.0
    for a, b in zip(unit, np.roll(unit, -1, axis=0)):
        edge = np.cross(a, b)
        total += math.acos(float(a @ b)) * float(edge @ normal) / np.linalg.norm(edge)
    return abs(total) / 2.0


def under_a_rectangle(material: Material, max_depth: int = 2, light: Material | None = None):
    """A plane y = 0 below a one metre square emitter that hangs off centre at y = 1."""
    ground = rectangle(0, rotate=UP, scale=20.0)
    hung = rectangle(1, (0.3, 1.0, 0.1), DOWN, 0.5)
    return scene([ground, hung], [material, light or emitter(5.0)], max_depth=max_depth)


def direct_light(count: int = 20_000) -> float:
    """p-value of the direct light of a rectangle on a matte plane."""
    expected = 0.7 / math.pi * 5.0 * LIGHT * polygon_irradiance(RECTANGLE, np.array([0.0, 1.0, 0.0]))
    return mean_test(estimates(under_a_rectangle(matte(0.7)), (0, 0.5, 0), (0.0, -1.0, 0.0), count), expected)


def shadow(count: int = 20_000) -> float:
    """p-value of an emitter half hidden by a card that is cut at the emitter's middle as the point sees it."""
    ground, hung = rectangle(0, rotate=UP, scale=20.0), rectangle(1, (0.0, 1.0, 0.0), DOWN, 0.5)
    card = rectangle(2, (-1.0, 0.5, 0.0), UP, 1.0)
    half = polygon_irradiance(RECTANGLE - [0.3, 0.0, 0.1], np.array([0.0, 1.0, 0.0])) / 2.0
    black = matte(0.0)
    samples = estimates(scene([ground, hung, card], [matte(0.7), emitter(5.0), black]), (0.1, 0.05, 0), (-0.1, -0.05, 0.0), count)
    return mean_test(samples, 0.7 / math.pi * 5.0 * LIGHT * half)


def glass(**others) -> Material:
    return Material("glass", (1.0, 1.0, 1.0), roughness=0.0, transmission=1.0, **others)


def reflectance(degrees: float, ior: float) -> float:
    """Unpolarised Fresnel reflectance of one face, from outside."""
    cosine = math.cos(math.radians(degrees))
    transmitted = math.sqrt(1.0 - (1.0 - cosine**2) / ior**2)
    s = (cosine - ior * transmitted) / (cosine + ior * transmitted)
    p = (ior * cosine - transmitted) / (ior * cosine + transmitted)
    return 0.5 * (s * s + p * p)


def lens_uniformity() -> float:
    """p-value of lens points being even over the disc: in cells of equal area, r² by angle."""
    points = Lens(0.7, 1.0).sample(PixelRandom(8, 0, torch.arange(500_000)).uniform(0, 2)).double()
    assert points.norm(dim=0).max() <= 0.7 * (1.0 + 1e-6)
    ring = (points.square().sum(0) / 0.49 * 32).long().clamp(max=31)
    sector = ((torch.atan2(points[1], points[0]) / (2.0 * math.pi) + 0.5) * 64).long().clamp(max=63)
    counts = torch.bincount(ring * 64 + sector, minlength=2048)
    return chi_square(counts.numpy(), np.full(2048, 1.0 / 2048))
