"""The scripts of the paper's figures at a tiny size."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bokehguide.evaluation import Comparison, Reference, regions
from bokehguide.evaluation.crops_figure import write_crops
from bokehguide.evaluation.curves_figure import write_convergence
from bokehguide.evaluation.runs import Run
from bokehguide.scene import Camera, FilmSettings, Inset, Scene
from bokehguide.train import MODES, RenderSettings
from tests.support.paths import REPOSITORY

FIGURES = REPOSITORY / "scripts/figures"
METHODS = ["uniform", "area-restir", "lis", "lis-b", "lis-o", "guided"]
DRAWN = {
    "fig6": (["fig6.png"], ["lis, β 0.95", "lis", "lis-b"], []),
    "fig7": (["fig7.png"], ["lis-b", "lis-o"], ["lis-b"]),
    "fig8_9": (["fig8.png", "fig9.png"], METHODS, ["lis", "lis-b", "lis-o"]),
    "fig11": (["fig11.png"], ["uniform", "lis-o, no split", "lis-o", "guided"], ["uniform", "lis-o", "guided"]),
}
"""By script: pictures, columns, and the modes that an earlier script has rendered."""


def draw(folder: Path, name: str, scene: str, *options: str) -> subprocess.CompletedProcess:
    small = ["--size", "16x9", "--spp", "2", "--cache", "cache", "--out", "out"]
    command = [sys.executable, str(FIGURES / f"{name}.py"), scene, *small, *options]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)


def assert_picture(path: Path) -> None:
    """As wide as a page, of a height that fits, and not empty."""
    with Image.open(path) as image:
        assert image.width == 2160 and image.height < 8000
        assert np.asarray(image.convert("L")).std() > 10


@pytest.mark.slow
def test_each_figure_is_a_png_and_a_json_and_shares_its_renders(tmp_path):
    for name, (pictures, modes, kept) in DRAWN.items():
        finished = draw(tmp_path, name, "occluded")
        assert finished.returncode == 0, finished.stderr
        assert [line for line in finished.stdout.splitlines() if "kept" in line] == [f"{mode}: kept, 2 SPP" for mode in kept]
        for picture in pictures:
            assert_picture(tmp_path / "out" / picture)
        scenes = json.loads((tmp_path / f"out/{name}.json").read_text())["scenes"]
        assert scenes.keys() == {"occluded"} and scenes["occluded"]["reference"]["spp"] == 32
        found = scenes["occluded"]["modes"]
        assert list(found) == modes
        assert all(facts["mape"]["insets"] > 0 for facts in found.values())
        assert [mode for mode, facts in found.items() if facts["spp"] != 2] == (["area-restir"] if name == "fig8_9" else [])
        if name == "fig6":
            assert 0.05 < scenes["occluded"]["mean_beta"]["insets"] < 0.95


@pytest.mark.slow
def test_alpha_is_exact_over_an_opaque_background_only_with_the_control_variate(tmp_path):
    finished = draw(tmp_path, "fig12", "fairy-lights", "--size", "64x36", "--spp", "4")
    assert finished.returncode == 0, finished.stderr
    assert_picture(tmp_path / "out/fig12.png")
    alpha = json.loads((tmp_path / "out/fig12.json").read_text())["scenes"]["fairy-lights"]["alpha"]
    errors = {name: facts["frame"]["mean absolute error"] for name, facts in alpha.items()}
    assert list(errors) == ["uniform", "counted", "weighted", "lis-o", "guided"]
    assert max(errors["uniform"], errors["lis-o"], errors["guided"]) < 1e-5 < min(errors["counted"], errors["weighted"])


@pytest.mark.slow
def test_a_mistake_is_one_line(tmp_path):
    finished = draw(tmp_path, "fig6", "ocluded")
    assert (finished.returncode, finished.stdout) == (2, "")
    assert finished.stderr.startswith("fig6: error: ocluded: no such scene; did you mean 'occluded'?")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("width", "height", "insets"),
    [
        (2000, 2, [Inset(0.0, 0.0, 0.5, 0.5)]),
        (2, 2000, [Inset(0.0, 0.0, 0.5, 0.5)]),
        (300, 2000, [Inset(0.0, 0.0, 0.001, 1.0)]),
        (60, 40, [Inset(0.01 * number, 0.0, 0.3, 0.3) for number in range(12)]),
        (1, 1, []),
    ],
)
def test_every_film_fits_on_a_page(width, height, insets, tmp_path):
    camera = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0))
    scene = Scene("bare", camera, (), (), FilmSettings(width, height), insets=tuple(insets))
    image = torch.full((height, width, 3), 0.5)
    errors = {region: {"mape": [0.2, 0.0], "relmse": [0.1, 0.0]} for region in regions(scene)}
    comparison = Comparison(
        scene,
        RenderSettings(spp=2),
        Reference(image, Path("bare.exr"), None, None, {"frame": {"mape": 0.1, "relmse": 0.1}}),
        {mode: Run("a", [0.1, 0.2], [3, 4], errors) for mode in MODES},
        dict.fromkeys(MODES, image),
        {},
    )
    write_crops(tmp_path / "crops.png", [comparison])
    write_convergence(tmp_path / "curves.png", comparison)
    assert_picture(tmp_path / "crops.png")
