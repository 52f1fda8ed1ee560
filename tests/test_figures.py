"""The scripts of the paper's figures at a tiny size."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image

FIGURES = Path(__file__).parent.parent / "scripts/figures"
DRAWN = {
    "fig6": (["fig6.png"], ["lis", "lis-b"], []),
    "fig7": (["fig7.png"], ["lis-b", "lis-o"], ["lis-b"]),
    "fig8_9": (["fig8.png", "fig9.png"], ["uniform", "lis", "lis-b", "lis-o"], ["lis", "lis-b", "lis-o"]),
}
"""By script: pictures, modes (among others), and those that an earlier script has rendered."""


def draw(folder: Path, name: str, *options: str) -> subprocess.CompletedProcess:
    command = [sys.executable, str(FIGURES / f"{name}.py"), *options, "--size", "16x9", "--spp", "2", "--cache", "cache"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)


def test_each_figure_is_a_png_and_a_json_and_shares_its_renders(tmp_path):
    for name, (pictures, modes, kept) in DRAWN.items():
        finished = draw(tmp_path, name, "occluded", "--out", "out")
        assert finished.returncode == 0, finished.stderr
        assert [line for line in finished.stdout.splitlines() if "kept" in line] == [f"{mode}: kept, 2 SPP" for mode in kept]
        for picture in pictures:
            with Image.open(tmp_path / "out" / picture) as image:
                assert image.width == 2160
                assert np.asarray(image.convert("L")).std() > 10
        scenes = json.loads((tmp_path / f"out/{name}.json").read_text())["scenes"]
        assert scenes.keys() == {"occluded"} and scenes["occluded"]["reference"]["spp"] == 64
        found = {mode: facts for mode, facts in scenes["occluded"]["modes"].items() if mode in modes}
        assert list(found) == modes
        assert all(facts["mape"]["insets"] > 0 for facts in found.values())


def test_a_mistake_is_one_line(tmp_path):
    finished = draw(tmp_path, "fig6", "ocluded")
    assert (finished.returncode, finished.stdout) == (2, "")
    assert finished.stderr.startswith("fig6: error: ocluded: no such scene; did you mean 'occluded'?")
