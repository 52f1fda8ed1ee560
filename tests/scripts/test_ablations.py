"""The script of the ablations at a tiny size."""

import json
import math
import subprocess
import sys
from pathlib import Path

import ablations
import pytest
import torch

from bokehguide.render.path_tracer import PathTracer
from bokehguide.scene import Overrides, Scene, load_scene
from bokehguide.train import RenderSettings
from tests.support.paths import REPOSITORY

SCRIPT = REPOSITORY / "scripts/ablations.py"


def run(folder: Path, *options: str) -> subprocess.CompletedProcess:
    small = ["--size", "32x18", "--spp", "4", "--cache", "cache", "--out", "out"]
    command = [sys.executable, str(SCRIPT), "fairy-lights", *small, *options]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)


@pytest.mark.slow
def test_the_table_and_what_is_kept(tmp_path):
    finished = run(tmp_path, "--only", "fixed-beta,degree", "--seeds", "2")
    assert finished.returncode == 0, finished.stderr
    table = (tmp_path / "out/ablations.md").read_text()
    assert finished.stdout.strip() == table.strip()
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
    assert lines[0] == ["change", "to", "mode", "fairy-lights", "all"]
    assert [line[:3] for line in lines[2:]] == [
        ["none: MAPE", "", "lis"],
        ["none: MAPE", "", "lis-o"],
        *(["fixed β", value, "lis"] for value in ("0.5", "0.65", "0.9")),
        *(["polynomial degree", value, "lis-o"] for value in ("0", "1", "3")),
    ]
    for line in lines[4:]:
        value, error = line[3].split(" ± ")
        assert 0.3 < float(value) < 3.0 and float(error) >= 0.0 and line[4] == value

    path = tmp_path / "out/ablations.json"
    kept = json.loads(path.read_text())
    assert len(kept) == 2 * (2 + 6)
    path.write_text(json.dumps(dict.fromkeys(kept, 0.5)))
    assert run(tmp_path, "--only", "fixed-beta", "--seeds", "1").stdout.count("| 1.000 ± - | 1.000 |") == 3
    assert json.loads(path.read_text()).keys() == kept.keys()


@pytest.mark.parametrize("text", ["{", "[]", '{"a": "b"}', '{"a": NaN}', "\xff"])
def test_damage_is_one_line(text, tmp_path):
    path = tmp_path / "ablations.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(ablations.BokehguideError, match=r"ablations\.json: is damaged or no ablations'; remove it or choose"):
        ablations.read_kept(path)


@pytest.mark.slow
def test_a_mistake_is_one_line(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/ablations.json").write_text("{")
    for options, told in (((), "ablations.json: is damaged"), (("--only", "alfa"), "'alfa' is unknown; choose of alpha, ")):
        finished = run(tmp_path, *options)
        assert (finished.returncode, finished.stdout, finished.stderr.count("\n")) == (2, "", 1)
        assert "error: " in finished.stderr and told in finished.stderr


def picture(scene: Scene, change: ablations.Change, tracer: PathTracer, spp: int) -> torch.Tensor:
    found = ablations.rendered(scene, change.settings(RenderSettings(spp=spp, threads=1)), tracer)
    assert found.isfinite().all()
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name, modes", [("glitter", ("lis", "lis-b", "lis-o")), ("chrome", ("guided",))])
def test_every_kind_of_change_changes_the_picture(name, modes):
    """On a scene with emitters at many depths, and on one with their reflections."""
    scene = load_scene(name, Overrides(width=64, height=36))
    tracer = PathTracer(scene)
    defaults = {mode: picture(scene, ablations.Change("default", mode, mode), tracer, 10) for mode in modes}
    for change in [changes[-1] for changes in ablations.CHANGES.values() if changes[-1].mode in modes]:
        assert not torch.equal(picture(scene, change, tracer, 10), defaults[change.mode]), f"{change} changes nothing"


@pytest.mark.slow
def test_every_part_of_guided_that_is_left_out_changes_the_picture():
    """On a scene with emitters of a map, parallelograms and reflections."""
    scene = load_scene("night-street", Overrides(width=64, height=36))
    tracer = PathTracer(scene)
    default = picture(scene, ablations.Change("default", "guided", "guided"), tracer, 6)
    for change in ablations.CHANGES["guided"]:
        assert not torch.equal(picture(scene, change, tracer, 6), default), f"{change.what} changes nothing"


@pytest.mark.slow
def test_every_part_of_guided_that_is_added_to_none_changes_the_picture():
    """Added to none, or to the parts that it needs."""
    scene = load_scene("night-street", Overrides(width=64, height=36))
    tracer, before = PathTracer(scene), {}
    for part in ablations.PARTS:
        needed = ablations.NEEDED.get(part, ())
        if needed not in before:
            before[needed] = picture(scene, ablations.guided_with("some parts", needed), tracer, 6)
        assert not torch.equal(picture(scene, ablations.alone(part), tracer, 6), before[needed]), f"{part} changes nothing"


def test_the_standard_error_is_that_of_repeated_quotients():
    generator = torch.Generator().manual_seed(1)
    changed = 0.5 + 0.02 * torch.randn(4000, 3, generator=generator)
    default = 0.4 + 0.03 * torch.randn(4000, 3, generator=generator)
    found = [ablations.ratio(*pair) for pair in zip(changed, default)]
    values, errors = torch.tensor(found).T
    assert float(values.mean()) == pytest.approx(1.25, rel=0.01)
    assert math.sqrt(float(errors.square().mean())) == pytest.approx(float(values.std()), rel=0.05)
    assert ablations.ratio(torch.tensor([0.5]), torch.tensor([0.25])) == (2.0, None)
