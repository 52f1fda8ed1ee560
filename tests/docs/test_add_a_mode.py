"""The mode of docs/how-to/add-a-mode.md, run as the page has it."""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.guiding import register_mode
from bokehguide.guiding.modes import MODES
from bokehguide.render.lens import Lens
from bokehguide.render.vector import luminance
from bokehguide.train import RenderLoop, RenderSettings
from tests.support import scenes
from tests.support.paths import REPOSITORY
from tests.support.statistical import SIGNIFICANCE, block_means, chi_square, z_test

PAGE = REPOSITORY / "docs/how-to/add-a-mode.md"
RINGS, SECTORS, DRAWS = 24, 16, 400_000


def block(start: str) -> str:
    """The code of the page's block whose fence begins so."""
    return re.search(re.escape(start) + r"[^\n]*\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL).group(1)


@pytest.fixture
def rim(tmp_path, monkeypatch):
    """The module of the page, which a program has registered."""
    code = block('```python title="rim.py"')
    assert code.count("\n") < 60
    (tmp_path / "rim.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(importlib.sys.modules, "rim", raising=False)
    monkeypatch.setitem(MODES, "rim", None)
    del MODES["rim"]  # the patch removes the mode at the end
    module = importlib.import_module("rim")
    register_mode("rim", module.rim)
    return module


@pytest.mark.slow
def test_the_program_of_the_page_renders(rim, tmp_path):
    (tmp_path / "program.py").write_text(block('```python { no-run="a program'))
    finished = subprocess.run([sys.executable, "program.py"], cwd=tmp_path, capture_output=True, text=True)
    assert finished.returncode == 0, finished.stderr
    assert (tmp_path / "rim.exr").exists()


@pytest.mark.slow
def test_the_package_of_the_page_installs_the_mode(rim, tmp_path):
    pytest.importorskip("setuptools")  # pip would fetch it
    (tmp_path / "pyproject.toml").write_text(block('```toml title="pyproject.toml"'))
    install = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--no-build-isolation", "--target", "installed"]
    finished = subprocess.run([*install, "."], cwd=tmp_path, capture_output=True, text=True)
    assert finished.returncode == 0, finished.stderr
    path = os.pathsep.join((str(tmp_path / "installed"), str(REPOSITORY)))
    command = [sys.executable, "-m", "bokehguide", "render", "cutout", "--mode", "rim", "--size", "32x18", "--spp", "2"]
    away = tmp_path / "away"
    away.mkdir()
    finished = subprocess.run(command, cwd=away, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True)
    assert finished.returncode == 0, finished.stderr
    assert (away / "cutout-rim.png").exists()


def test_a_pinhole_has_the_picture_of_the_uniform_lens(rim):
    """Though the sampler of the page divides by the area of the lens."""
    scene = replace(scenes.emitters(32, 20), camera=replace(scenes.emitters(32, 20).camera, aperture_radius=0.0))
    pictures = []
    for mode in ("rim", "uniform"):
        with RenderLoop(scene, RenderSettings(mode, 2, seed=7, threads=1)) as loop:
            loop.step()
            pictures.append(loop.film.layers()["beauty"])
    assert pictures[0].max() > 0.0
    assert np.array_equal(*pictures)


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
