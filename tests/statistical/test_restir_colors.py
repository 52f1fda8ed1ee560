"""Area ReSTIR in each colour: which sample a pixel takes says nothing of its luminance, but all of its colour."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.baselines.restir import spatial_reuse
from bokehguide.render.film import Film
from bokehguide.scene.types import Environment, Scene
from tests.support.restir_cases import HEIGHT, WIDTH, loop_of, same_means, scene
from tests.support.statistical import SIGNIFICANCE, sidak

STEPS, NEIGHBOURS = 24, 6


@pytest.fixture(autouse=True)
def few_neighbours(monkeypatch):
    monkeypatch.setattr(spatial_reuse, "NEIGHBOURS", NEIGHBOURS)


def coloured() -> Scene:
    """Under a sky of stripes, blue ones and bright red ones, with a yellow emitter."""
    lit = scene()
    sky = np.full((16, 64, 3), (0.02, 0.05, 0.8), np.float32)
    sky[:, ::4] = 3.0, 0.3, 0.05
    return replace(lit, environment=Environment(sky))


def colours_by_step(mode: str) -> np.ndarray:
    """Each step's picture alone, `[3, steps, H, W]`."""
    loop, pictures = loop_of(mode, seed=7, shown=coloured()), []
    for _ in range(STEPS):
        loop.film = Film(WIDTH, HEIGHT)
        loop.step()
        pictures.append(loop.film.radiance().permute(2, 0, 1))
    return torch.stack(pictures, dim=1).double().numpy()


@pytest.mark.slow
def test_means_of_each_colour_are_those_of_the_uniform_lens():
    expected = colours_by_step("uniform")
    found = [colours_by_step(mode) for mode in ("area-restir", "area-restir+lis")]
    assert sidak([same_means(one, other) for picture in found for one, other in zip(picture, expected)]) > SIGNIFICANCE
