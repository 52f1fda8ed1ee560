"""The mode of docs/how-to/add-a-mode.md, run as the page has it."""

from __future__ import annotations

import importlib
import re

import numpy as np
import pytest
import torch

from bokehguide.guiding.modes import MODES, ModeEntry
from bokehguide.render.lens import Lens
from bokehguide.render.vector import luminance
from bokehguide.train import RenderLoop, RenderSettings
from tests.support import scenes
from tests.support.paths import REPOSITORY
from tests.support.statistical import SIGNIFICANCE, block_means, chi_square, z_test

PAGE = REPOSITORY / "docs/how-to/add-a-mode.md"
RINGS, SECTORS, DRAWS = 24, 16, 400_000


@pytest.fixture
def rim(tmp_path, monkeypatch):
    """The module of the page, with its line in the registry."""
    code = re.search(r'```python title="rim\.py"\n(.*?)```', PAGE.read_text(encoding="utf-8"), re.DOTALL).group(1)
    assert code.count("\n") < 60
    (tmp_path / "rim.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(MODES, "rim", ModeEntry("rim:rim", "half of the lens points prefer the rim"))
    monkeypatch.delitem(importlib.sys.modules, "rim", raising=False)
    return importlib.import_module("rim")


def query_of(rim, lens: Lens, count: int):
    uniforms = torch.rand(3, count, generator=torch.Generator().manual_seed(4))
    focus = torch.zeros(3, count)
    focus[2] = lens.focus_distance
    return rim.RimQuery(lens, focus, uniforms)


@pytest.mark.slow
def test_draws_follow_the_density(rim):
    """Chi-square over rings of equal width and sectors, with the density integrated by its midpoint rule."""
    lens = Lens(0.2, 2.0)
    points = query_of(rim, lens, DRAWS).sample().points.double().numpy()
    ring = np.minimum((np.hypot(*points) / lens.radius * RINGS).astype(int), RINGS - 1)
    sector = np.minimum(((np.arctan2(points[1], points[0]) / (2.0 * np.pi) + 0.5) * SECTORS).astype(int), SECTORS - 1)
    observed = np.bincount(ring * SECTORS + sector, minlength=RINGS * SECTORS)
    fine = (np.arange(RINGS * 64) + 0.5) / (RINGS * 64) * lens.radius
    places = torch.tensor(np.stack((fine, np.zeros_like(fine))), dtype=torch.float32)
    density = query_of(rim, lens, len(fine)).pdf(places).double().numpy() * 2.0 * np.pi * fine * lens.radius / len(fine)
    assert density.sum() == pytest.approx(1.0, abs=1e-3)
    probability = np.repeat(density.reshape(RINGS, 64).sum(1) / SECTORS, SECTORS)
    assert chi_square(observed, probability / probability.sum()) > SIGNIFICANCE


def mean_and_variance(mode: str, spp: int) -> tuple[np.ndarray, np.ndarray]:
    with RenderLoop(scenes.emitters(32, 20), RenderSettings(mode, spp, seed=7, threads=1)) as loop:
        for _ in range(spp):
            loop.step()
        layers = loop.film.layers()
    light = luminance(torch.from_numpy(layers["beauty"]).double().permute(2, 0, 1))
    return light.numpy(), layers["variance"].astype(np.float64)


@pytest.mark.slow
def test_means_agree_with_the_uniform_lens(rim):
    """In luminance, over blocks of 4 × 4 pixels."""
    (found, noise), (expected, other) = mean_and_variance("rim", 512), mean_and_variance("uniform", 4096)
    blocks = [block_means(image, 4) for image in (found - expected, noise + other)]
    assert z_test(blocks[0], np.sqrt(blocks[1] / 16.0)) > SIGNIFICANCE
    assert not np.array_equal(found, expected)
