"""Mattes through the lens against closed forms: the defocused edge of an object, and an edge in focus within a pixel."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import pytest
from scipy import stats

from bokehguide.scene.types import Camera, FilmSettings, Material, Scene
from bokehguide.train import RenderLoop, RenderSettings
from tests.support.statistical import SIGNIFICANCE, z_test
from tests.support.tracing import emitter, rectangle

WIDTH, HEIGHT, SPP, RENDERS = 48, 16, 24, 24
RADIUS, FOCUS, FOV, EDGE = 0.25, 2.0, 40.0, 0.01
SLOPE = 2.0 * math.tan(math.radians(FOV / 2.0)) / WIDTH
"""Width of a pixel at unit depth."""


def card(depth: float) -> Scene:
    """A card right of x = EDGE at a depth before or behind the focal plane, a wall behind the card, and a small emitter between
    them, which guided modes sample more often than its share of the lens."""
    half = 5.0
    meshes = (
        rectangle(0, (EDGE + half, 0.0, -depth), scale=half),
        rectangle(1, (0.0, 0.0, -9.0), scale=20.0),
        rectangle(2, (EDGE * 6.0 / depth, 0.0, -6.0), scale=0.08),
    )
    camera = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=FOV, aperture_radius=RADIUS, focus_distance=FOCUS)
    materials = (Material("card"), Material("wall"), emitter(20.0))
    return Scene("card", camera, meshes, materials, FilmSettings(WIDTH, HEIGHT, 2))


def exact(depth: float, radius: float = RADIUS) -> np.ndarray:
    """Share of the lens that sees the card, averaged over each pixel of a row, `[WIDTH]`.

    A ray from the lens point l through x_F on the focal plane is at x = l (1 - d / F) + x_F d / F at the depth d. The card covers
    x > EDGE, so that the lens points form a segment of the disc.
    """
    points = (np.arange(WIDTH)[:, None] + (np.arange(2000) + 0.5) / 2000 - WIDTH / 2) * SLOPE * FOCUS
    if depth == FOCUS:
        return (points > EDGE).mean(1)
    scale = 1.0 - depth / FOCUS
    bound = np.clip((EDGE - points * depth / FOCUS) / scale / radius, -1.0, 1.0)
    below = 0.5 + (bound * np.sqrt(1.0 - bound**2) + np.arcsin(bound)) / math.pi
    return (1.0 - below if scale > 0.0 else below).mean(1)


@lru_cache
def rows(mode: str, depth: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean coverage of the card over the rows of each of RENDERS renders, and the coverage in the middle row."""
    found, middle = [], []
    for seed in range(RENDERS):
        with RenderLoop(card(depth), RenderSettings(mode, seed=seed, threads=1, cryptomatte=True)) as loop:
            for _ in range(SPP):
                loop.step()
        covered = loop.film.covered()["object"]
        share = (covered.share * (covered.numbers == 1)).sum(0).reshape(HEIGHT, WIDTH)
        found.append(share.mean(0).numpy())
        middle.append(share[HEIGHT // 2].numpy())
    return np.stack(found), np.stack(middle)


def p_value(mode: str, depth: float, expected: np.ndarray) -> float:
    """Whether the mean over the renders is `expected` in every column."""
    found, _ = rows(mode, depth)
    error = np.maximum(found.std(0, ddof=1) / math.sqrt(RENDERS), 2e-4)  # a noise of almost 0 has no reliable estimate
    z = stats.norm.isf(stats.t.sf(np.abs(found.mean(0) - expected) / error, RENDERS - 1))
    return z_test(z, np.ones_like(z))


MODES = ("uniform", "lis-o", "guided")


@pytest.mark.parametrize("depth", [1.0, 5.0])
@pytest.mark.parametrize("mode", MODES)
def test_a_defocused_edge_covers_the_segment_of_the_lens_that_sees_it(mode, depth):
    expected = exact(depth)
    assert ((expected > 0.02) & (expected < 0.98)).sum() > 6
    assert p_value(mode, depth, expected) > SIGNIFICANCE
    assert p_value(mode, depth, exact(depth, 1.1 * RADIUS)) < SIGNIFICANCE


@pytest.mark.parametrize("mode", MODES)
def test_an_edge_in_focus_covers_its_part_of_the_pixel(mode):
    expected = exact(FOCUS)
    partial = np.flatnonzero((expected > 0.0) & (expected < 1.0))
    assert len(partial) == 1 and 0.1 < expected[partial[0]] < 0.9
    assert p_value(mode, FOCUS, expected) > SIGNIFICANCE


def test_the_weights_of_guided_modes_vary():
    """Else the tests above would show nothing about weights."""
    _, uniform = rows("uniform", 5.0)
    np.testing.assert_allclose(uniform * SPP, np.round(uniform * SPP), atol=1e-6)
    for mode in MODES[1:]:
        _, guided = rows(mode, 5.0)
        assert (np.abs(guided * SPP - np.round(guided * SPP)) > 0.05).mean() > 0.1


def test_mattes_are_solid_inside_an_object():
    """Where every sample sees the card, the coverage is exactly 1, whatever the weights."""
    for mode in MODES:
        found, _ = rows(mode, 1.0)
        inside = exact(1.0) == 1.0
        assert inside.sum() > 3
        np.testing.assert_allclose(found[:, inside], 1.0, atol=1e-6)
