"""Absorbing solids against Beer's and Lambert's law."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bokehguide.scene.types import Material
from tests.support.light_checks import (
    LIGHT,
    glass,
    reflectance,
)
from tests.support.rooms import bsdf_sampling_only
from tests.support.statistical import SIGNIFICANCE
from tests.support.tracing import agreement, emitter, estimates, mean_test, rectangle, scene, sky, sphere

COLOR = (0.9, 0.5, 0.2)
WATER = {"attenuation_color": COLOR, "attenuation_distance": 0.3}


def left(distance: float) -> np.ndarray:
    """Share of white light after some metres of `WATER`."""
    return np.array(COLOR) ** (distance / 0.3)


def slab(material: Material, thickness: float = 0.2, max_depth: int = 40):
    """Two faces of a wide slab before a wide emitter."""
    faces = [rectangle(0, scale=50.0), rectangle(0, (0.0, 0.0, -thickness), (0.0, 180.0, 0.0), 50.0)]
    return scene([*faces, rectangle(1, (0.0, 0.0, -1.0), scale=100.0)], [material, emitter()], max_depth=max_depth)


@pytest.mark.parametrize("degrees", [0.0, 60.0])
def test_a_slab_passes_all_orders_between_its_faces(degrees):
    """(1 - R)² t / (1 - R² t²), where t is lost on the bent way through."""
    angle = math.radians(degrees)
    single = reflectance(degrees, 1.5)
    t = left(0.2 / math.sqrt(1.0 - (math.sin(angle) / 1.5) ** 2))
    expected = (1.0 - single) ** 2 * t / (1.0 - (single * t) ** 2) * LIGHT
    ray = ((math.tan(angle), 0.0, 1.0), (-math.sin(angle), 0.0, -math.cos(angle)))
    assert mean_test(estimates(slab(glass(**WATER)), *ray), expected) > SIGNIFICANCE


@pytest.mark.parametrize("others", [{"thin": True} | WATER, {}, {"attenuation_color": COLOR}], ids=["thin", "plain", "endless"])
def test_sheets_and_clear_solids_absorb_nothing(others):
    material = glass(**others)
    single = reflectance(0.0, 1.5)
    passing = (1.0 - single) / (1.0 + single)
    if material.thin:
        passing = passing**2 / (1.0 - (1.0 - passing) ** 2)  # two sheets
    assert mean_test(estimates(slab(material), (0, 0, 1), (0, 0, -1)), passing * LIGHT) > SIGNIFICANCE


def test_a_ball_that_bends_nothing_absorbs_along_each_chord():
    ball = scene([sphere(0)], [glass(ior=1.0, **WATER)], sky(1.0), max_depth=3)
    for height in (0.0, 0.6):
        row_interval = 2.0 * math.sqrt(1.0 - height**2)
        samples = estimates(ball, (height, 0.0, 4.0), (0.0, 0.0, -1.0), 100)
        assert mean_test(samples, left(row_interval), tolerance=0.02) > SIGNIFICANCE


def test_a_camera_inside_looks_through_what_is_left_of_the_way_out():
    ball = scene([sphere(0)], [glass(ior=1.0, **WATER)], sky(1.0), max_depth=2)
    assert mean_test(estimates(ball, (0.0, 0.0, 0.5), (0.0, 0.0, -1.0), 100), left(1.5), tolerance=0.01) > SIGNIFICANCE


def test_both_techniques_agree_within_a_glowing_solid(monkeypatch):
    """Whose inner side is an emitter, seen through what it absorbs."""
    glow = replace(glass(**WATER), roughness=0.5, emission=(1.0, 1.0, 1.0), double_sided=True)
    ball, ray = scene([sphere(0)], [glow], max_depth=4), ((0.0, 0.0, 0.9), (0.1, 0.2, -1.0))
    both = estimates(ball, *ray, 50_000)
    bsdf_sampling_only(monkeypatch)
    assert agreement(both, estimates(ball, *ray, 50_000, 1)) > SIGNIFICANCE


def test_a_black_channel_lets_nothing_through():
    material = replace(glass(ior=1.0), attenuation_color=(1.0, 0.5, 0.0), attenuation_distance=0.01)
    samples = estimates(scene([sphere(0)], [material], sky(1.0), max_depth=2), (0.0, 0.0, 0.5), (0.0, 0.0, -1.0), 100)
    assert (samples[0] > 0.999).all() and not samples[1:].any()
