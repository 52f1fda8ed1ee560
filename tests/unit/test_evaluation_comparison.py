"""What a comparison keeps from an earlier one, and errors at equal cost."""

import json
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch

from bokehguide.evaluation import LongRender, compare, given_reference, made_reference, references
from bokehguide.evaluation.comparison import interpolated
from bokehguide.evaluation.tables import report
from bokehguide.image import read_exr, read_rgb, write_exr
from bokehguide.scene import Inset, load_scene
from bokehguide.train import RenderSettings

SETTINGS = RenderSettings("uniform", 2, 7)


@pytest.fixture
def emitters(lamps_file, tmp_path, monkeypatch, capfd):
    """Compare on the emitters against an even grey; gives what `metrics.json` holds and what was said."""
    monkeypatch.chdir(tmp_path)
    scene = load_scene(str(lamps_file))

    def run(*modes, scene=scene, settings=SETTINGS, grey=0.1):
        write_exr("grey.exr", {"beauty": np.full((20, 32, 3), grey, np.float32)})
        reference = given_reference(Path("grey.exr"), scene)
        compare(scene, [replace(settings, mode=mode) for mode in modes], reference, Path())
        return json.loads(Path("metrics.json").read_text()), capfd.readouterr().out

    run.scene = scene
    return run


def test_a_made_reference_has_no_negative_pixels(emitters, monkeypatch):
    """The metrics refuse a reference with negative pixels, which the control variate may leave at few SPP."""
    monkeypatch.setattr(references, "read_rgb", lambda file: read_rgb(file) - 0.05)
    made = made_reference(emitters.scene, RenderSettings(spp=2, threads=1), Path("made.exr"), Path("cache"))
    assert float(made.radiance.min()) == 0.0 < float(made.radiance.max())
    np.testing.assert_array_equal(read_rgb("made.exr"), made.radiance.numpy())


def test_nothing_changed_nothing_rendered(emitters):
    first, said = emitters("uniform", "lis")
    assert said == ""
    second, said = emitters("uniform", "lis")
    assert said.splitlines() == ["uniform: kept, 2 SPP", "lis: kept, 2 SPP"]
    assert second == first


def test_the_reference_is_checked_by_uniform_sampling(emitters):
    lone, _ = emitters("lis")
    assert lone["reference_over_uniform"] == {}
    both, _ = emitters("lis", "uniform")
    channels = read_exr("uniform.exr")
    light = 0.2126 * channels["R"] + 0.7152 * channels["G"] + 0.0722 * channels["B"]
    error = np.sqrt(channels["variance.Y"].sum()) / light.size
    found = both["reference_over_uniform"]["frame"]
    assert found["ratio"] == pytest.approx(0.1 / light.mean(), rel=1e-5)
    assert found["standard_error"] == pytest.approx(error / light.mean(), rel=1e-5)
    assert found["z"] == pytest.approx((0.1 - light.mean()) / error, rel=1e-4)


@pytest.mark.parametrize("grey, wrong", [(0.1, False), (50.0, True)])
def test_a_reference_that_uniform_sampling_contradicts_is_told_of(grey, wrong, emitters):
    write_exr("grey.exr", {"beauty": np.full((20, 32, 3), grey, np.float32)})
    reference = given_reference(Path("grey.exr"), emitters.scene)
    text = report(compare(emitters.scene, [SETTINGS], reference, Path()))
    assert "Its mean luminance over that of uniform sampling: " in text
    assert ("one of the two is wrong" in text) == wrong


@pytest.mark.parametrize(
    ("halves", "spp", "remedy"),
    [
        (1.6, {"spp": 64}, "render at least {spp:,} SPP, with --reference-spp {spp}"),
        (1.6, {}, "give a reference with more SPP"),
        (0.01, {"spp": 64}, ""),
    ],
)
def test_a_reference_with_a_large_error_of_its_own_is_told_with_the_remedy(halves, spp, remedy, emitters):
    """Its error falls with the square root of its SPP."""
    facts = {"between_halves": json.dumps({"mape": halves, "relmse": 1.0})} | spp
    write_exr("grey.exr", {"beauty": np.full((20, 32, 3), 0.1, np.float32)}, facts)
    comparison = compare(emitters.scene, [SETTINGS], given_reference(Path("grey.exr"), emitters.scene), Path())
    error = comparison.runs["uniform"].errors["frame"]["mape"][-1]
    needed = math.ceil(64 * (3.0 * halves / 2 / error) ** 2)
    told = (
        f"The reference's own error over the frame, {halves / 2:.4f}, is more than a third of the error of uniform, {error:.4f}; "
    )
    text = report(comparison)
    assert (told + remedy.format(spp=needed) + "." in text) == bool(remedy)
    assert ("more than a third" in text) == bool(remedy)


def changes(scene):
    brighter = replace(scene.materials[1], emission=(40.0, 30.0, 20.5))
    yield "its material", {"scene": replace(scene, materials=(scene.materials[0], brighter))}
    yield "its camera", {"scene": replace(scene, camera=replace(scene.camera, fov=41.0))}
    yield "its insets", {"scene": replace(scene, insets=(Inset(0.0, 0.0, 0.5, 0.5),))}
    yield "its seed", {"settings": replace(SETTINGS, seed=8)}
    yield "its threads, which its seconds depend on", {"settings": replace(SETTINGS, threads=3)}
    yield "the reference", {"grey": 0.2}


@pytest.mark.slow
def test_what_a_run_depends_on_decides_whether_it_is_kept(emitters):
    for what, changed in changes(emitters.scene):
        emitters("uniform")
        _, said = emitters("uniform", **changed)
        assert said.startswith("uniform: rendered again, as the scene, the reference, the insets or the settings"), what


@pytest.mark.slow
def test_only_what_reuses_samples_depends_on_the_radius(emitters):
    emitters("uniform", "area-restir")
    _, said = emitters("uniform", "area-restir", settings=replace(SETTINGS, reuse_radius=4.0))
    assert said.splitlines()[0] == "uniform: kept, 2 SPP" and "area-restir: rendered again" in said


@pytest.mark.parametrize("spp", [1, 3])
def test_another_number_of_samples_is_rendered_from_the_start(spp, emitters):
    emitters("uniform")
    found, said = emitters("uniform", settings=replace(SETTINGS, spp=spp))
    assert said == "uniform: rendered again, as it has 2 SPP and cannot be continued exactly\n"
    assert len(found["runs"]["uniform"]["rays"]) == found["modes"]["uniform"]["spp"] == spp


def test_modes_are_added_to_those_that_are_there(emitters):
    emitters("uniform")
    found, said = emitters("lis")
    assert said == "" and list(found["modes"]) == ["lis"] and found["runs"].keys() == {"uniform", "lis"}
    found, said = emitters("lis", "uniform")
    assert said.count("kept") == 2 and list(found["modes"]) == ["lis", "uniform"]
    found, _ = emitters("lis", settings=replace(SETTINGS, spp=3))
    assert found["runs"].keys() == {"lis"}, "a run of 2 SPP is not to be compared with one of 3"


def another_picture(path):
    write_exr(path, {"beauty": np.ones((20, 32, 3), np.float32)})


@pytest.mark.slow
@pytest.mark.parametrize("damage", [os.unlink, lambda path: os.truncate(path, 900), another_picture])
def test_a_mode_without_its_picture_is_rendered_again(damage, emitters):
    emitters("uniform", "lis")
    whole = read_rgb("uniform.exr")
    damage("uniform.exr")
    _, said = emitters("uniform", "lis")
    assert said.splitlines() == ["uniform: rendered again, as its image is missing or damaged", "lis: kept, 2 SPP"]
    np.testing.assert_array_equal(read_rgb("uniform.exr"), whole)


def test_a_power_law_is_a_line():
    cost = [1.0, 3.0, 10.0, 40.0]
    error = [2.0 * x**-0.5 for x in cost]
    for budget in (1.0, 2.0, 17.0, 40.0):
        assert interpolated(cost, error, budget) == pytest.approx(2.0 * budget**-0.5, rel=1e-12)
    assert interpolated(cost, error, 0.9) is None
    assert interpolated(cost, [0.0, 0.0, 0.0, 0.0], 17.0) == pytest.approx(0.0, abs=1e-20)


class Flat(NamedTuple):
    """A film of one pixel."""

    light: float
    noise: float

    def radiance(self) -> torch.Tensor:
        return torch.full((1, 1, 3), self.light, dtype=torch.float64)

    def variance(self) -> torch.Tensor:
        return torch.full((1, 1), self.noise, dtype=torch.float64)


def test_a_long_render_is_the_mean_of_all_samples_with_the_variance_of_this_mean():
    """Chunks of different SPP whose samples all have the variance 6, so that their mean has 6 / SPP."""
    kept = LongRender(torch.zeros(1, 1, 3, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64))
    for spp, light in ((2, 1.0), (3, 5.0), (7, 0.5)):
        kept = kept.plus(Flat(light, 6.0 / spp), spp)
    assert (kept.spp, kept.chunks) == (12, 3)
    assert float(kept.variance) == pytest.approx(6.0 / 12)
    assert kept.radiance.flatten().tolist() == pytest.approx([(2 * 1.0 + 3 * 5.0 + 7 * 0.5) / 12] * 3)
