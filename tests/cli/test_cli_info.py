"""`bokehguide info` with the options of `render`."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from PIL import Image


@pytest.mark.slow
def test_the_result_of_the_options_is_told(bokehguide, tmp_path):
    options = (
        "cutout",
        "--focus-on",
        "glaze",
        "--f-number",
        "1.4",
        "--size",
        "96x54",
        "--json",
        "facts.json",
        "--picture",
        "view.png",
    )
    finished = bokehguide("info", *options)
    assert finished.returncode == 0, finished.stderr
    facts = json.loads((tmp_path / "facts.json").read_text())
    assert facts["camera"]["f_number"] == pytest.approx(1.4)
    assert f"focused at {facts['camera']['focus_distance']:.4g} m" in finished.stdout and "f/1.4" in finished.stdout
    assert facts["film"]["width"] == 96
    near, far = (facts["in_view"][key] for key in ("nearest", "farthest"))
    assert 0.0 < near["depth"] <= facts["camera"]["focus_distance"] <= far["depth"]
    assert facts["objects"] and all(len(entry["low"]) == 3 for entry in facts["objects"])
    with Image.open(tmp_path / "view.png") as view:
        assert abs(view.width / view.height - 96 / 54) < 0.02
        assert len(view.convert("RGB").getcolors(1 << 24)) > 100


@pytest.mark.slow
def test_an_unknown_name_is_one_line(bokehguide):
    finished = bokehguide("info", "cutout", "--focus-on", "glase")
    assert finished.returncode == 2
    *_, error = finished.stderr.splitlines()
    assert error.startswith("bokehguide: error: --focus-on: 'glase' is no object") and "did you mean" in error


@pytest.mark.slow
def test_a_folder_is_created_in_an_existing_one_alone(bokehguide, lamps_file, tmp_path):
    refused = bokehguide("info", lamps_file, "--json", "new/deep/facts.json")
    assert refused.returncode == 2 and "the folder new does not exist" in refused.stderr and not (tmp_path / "new").exists()
    made = bokehguide("info", lamps_file, "--json", "new/facts.json")
    assert made.returncode == 0 and "created the folder new" in made.stderr and (tmp_path / "new/facts.json").exists()


def test_json_goes_to_stdout_alone(bokehguide, lamps_file, tmp_path):
    finished = bokehguide("info", lamps_file, "--json", "-", "--picture", "view.png")
    assert finished.returncode == 0, finished.stderr
    assert json.loads(finished.stdout)["film"]["width"] == 32
    assert "  film:  " in finished.stderr and "wrote view.png" in finished.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["emitters.toml", "view.png"]


def test_files_are_written_where_nobody_reads_the_text(lamps_file, tmp_path):
    command = [sys.executable, "-m", "bokehguide", "info", str(lamps_file), "--json", "facts.json", "--picture", "view.png"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.wait(timeout=60) == 141
    assert json.loads((tmp_path / "facts.json").read_text())["film"]["width"] == 32 and (tmp_path / "view.png").exists()
