"""The script that compares modes over seeds."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch
from experiments import seeds
from PIL import Image

from tests.support.paths import REPOSITORY

SCRIPT = REPOSITORY / "scripts/experiments/seeds.py"
MODES = ["uniform", "guided"]


def noisy(scale: float, first: int) -> list[torch.Tensor]:
    """Eight pictures of 64 x 64 pixels about 1, with noise that is `scale` times larger in the first block."""
    pictures = []
    for seed in range(first, first + 8):
        noise = 0.1 * torch.randn(64, 64, 3, generator=torch.Generator().manual_seed(seed))
        noise[:32, :32] *= scale
        pictures.append(1.0 + noise)
    return pictures


def test_a_block_that_is_worse_is_found_and_one_by_chance_is_not():
    reference = torch.ones(64, 64, 3)
    worse = seeds.blocks(noisy(1.2, 0), noisy(1.0, 100), reference, MODES)
    assert worse.startswith("Of 4 blocks") and worse.endswith("1 are above 1.1, 1 of them with 95 % confidence.")
    equal = seeds.blocks(noisy(1.0, 0), noisy(1.0, 100), reference, MODES)
    assert equal.endswith("0 are above 1.1, 0 of them with 95 % confidence.")


def test_intervals_hold_the_quotient_and_narrow_with_seeds():
    one, other = (torch.rand(64, generator=torch.Generator().manual_seed(seed)) + 0.5 for seed in (0, 1))
    ratio, low, high = (
        float(part) for part in seeds.interval(one, other).replace("(", "").replace(")", "").replace("… ", "").split()
    )
    assert ratio == pytest.approx(float(one.mean() / other.mean()), abs=1e-3) and low < ratio < high
    few = seeds.interval(one[:8], other[:8]).replace("(", "").replace(")", "").replace("… ", "").split()
    assert float(few[2]) - float(few[1]) > 1.5 * (high - low)


@pytest.mark.slow
def test_the_table_and_the_picture(tmp_path):
    small = ["--size", "64x36", "--spp", "2", "--seeds", "2", "--modes", ",".join(MODES), "--cache", "cache", "--out", "out"]
    command = [sys.executable, str(SCRIPT), "cutout", *small]
    finished = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=240)
    assert finished.returncode == 0, finished.stderr
    table = (tmp_path / "out/seeds.md").read_text()
    assert finished.stdout.strip() == table.strip()
    lines = table.splitlines()
    assert [line.split("|")[1].strip() for line in lines[:4]] == ["cutout", "---", *MODES]
    uniform, guided = ([float(number) for number in line.split("|")[2:5]] for line in lines[2:4])
    assert guided[2] < uniform[2] and 1.0 <= uniform[1] <= guided[1]  # MAPE; rays
    assert uniform[0] == guided[0] == 2  # SPP
    assert lines[5].startswith("Of 4 blocks of 32 x 32 pixels")
    with Image.open(tmp_path / "out/cutout-first.png") as picture:
        assert picture.size == (3 * 64, 36)


@pytest.mark.slow
def test_at_equal_time_the_other_modes_render_for_the_seconds_of_the_last(tmp_path):
    options = ["--size", "64x36", "--spp", "4", "--seeds", "2", "--modes", "uniform,guided", "--equal-time", "--out", "out"]
    command = [sys.executable, str(SCRIPT), "cutout", *options, "--cache", "cache"]
    finished = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=240)
    assert finished.returncode == 0, finished.stderr
    uniform, guided = (float(line.split("|")[2]) for line in finished.stdout.splitlines()[2:4])
    assert guided == 4 and uniform >= 1
