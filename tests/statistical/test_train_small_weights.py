"""Draws of little weight count: what an emitter scatters is seen by them alone, as nearly all draws go where emitters are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bokehguide.scene.shapes import transform, transformed, unit_rectangle
from bokehguide.scene.types import FilmSettings, Material, Scene
from bokehguide.train import RenderLoop, RenderSettings
from tests.support import scenes
from tests.support.statistical import SIGNIFICANCE, z_test

EMITTED = (0.5, 0.3, 0.1)
STEPS = 48


def glowing() -> Scene:
    """A parallelogram that emits and scatters, far out of focus before an even sky: all that is seen has the radiance 1."""
    furnace = scenes.furnace(24, 16)
    parallelogram = transformed(unit_rectangle(), transform((0.0, 0.0, -8.0), scale=0.2))
    material = Material("parallelogram", tuple(1.0 - part for part in EMITTED), specular=0.0, emission=EMITTED)
    return replace(
        furnace, meshes=(replace(parallelogram, material=0),), materials=(material,), film=FilmSettings(24, 16, max_depth=2)
    )


def test_what_a_lamp_scatters_counts_in_every_colour():
    """Means of each colour over the frame, step by step."""
    loop = RenderLoop(glowing(), RenderSettings("guided", seed=2, threads=1))
    means, before = [], 0.0
    for step in range(1, STEPS + 1):
        loop.step()
        total = loop.film.radiance().double().mean((0, 1)).numpy() * step
        means.append(total - before)
        before = total
    means = np.array(means)
    assert (loop.mode.lens.candidates.counts() > 0).float().mean() > 0.1
    error = means.std(0, ddof=1) / np.sqrt(STEPS)
    assert error.max() < 0.005
    assert z_test(means.mean(0) - 1.0, error) > SIGNIFICANCE
