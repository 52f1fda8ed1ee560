"""Area ReSTIR in the training loop and on the command line."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from bokehguide.baselines.restir import spatial_reuse
from bokehguide.cli import main
from bokehguide.errors import BokehguideError
from bokehguide.guiding.uniform import UniformLens
from bokehguide.image import read_exr, read_metadata
from bokehguide.render.shadow_roulette import ShadowRoulette
from bokehguide.scene.types import Environment
from bokehguide.train import LENS_MODES, MODES, RenderLoop, RenderSettings
from tests.support.restir_cases import HEIGHT, WIDTH, loop_of, scene

RESTIR_MODES = tuple(mode for mode in MODES if mode not in LENS_MODES)


@pytest.fixture
def few_neighbours(monkeypatch):
    monkeypatch.setattr(spatial_reuse, "NEIGHBOURS", 4)


def rendered(mode: str, threads: int = 1, steps: int = 3) -> RenderLoop:
    loop = loop_of(mode, threads=threads)
    for _ in range(steps):
        loop.step()
    return loop


@pytest.mark.parametrize("mode", RESTIR_MODES)
def test_any_number_of_threads_gives_the_same_bits(mode, few_neighbours, monkeypatch):
    """Of a frame cut into several batches, which take samples from each other."""
    monkeypatch.setattr("bokehguide.train.scheduler.OVERHEAD", 1)
    one, two = rendered(mode).film.layers(), rendered(mode, threads=2).film.layers()
    for name, layer in one.items():
        np.testing.assert_array_equal(layer, two[name], err_msg=name)


def test_what_is_no_radiance_is_that_of_the_initial_samples(few_neighbours):
    """Alpha, depth, normal, albedo and emission have the bits of a render without reuse."""
    plain, reused = rendered("uniform").film.layers(), rendered("area-restir").film.layers()
    for name in ("alpha", "depth", "normal", "albedo", "emission", "sample_count"):
        np.testing.assert_array_equal(plain[name], reused[name], err_msg=name)
    assert (plain["beauty"] != reused["beauty"]).mean() > 0.9


def test_the_guide_learns_from_the_initial_samples_only(few_neighbours):
    """Its records are those of the mode that draws them, step by step."""
    guided, reused = loop_of("lis-o"), loop_of("area-restir+lis")
    for _ in range(2):  # later the mean luminance of the film, by which spots are found, is another one
        guided.step()
        reused.step()
        assert torch.equal(guided.mode.lens.record_buffer.sums, reused.mode.lens.record_buffer.sums)
    assert rendered("area-restir+lis", steps=10).mode.lens.offsets is not None
    assert isinstance(loop_of("area-restir").mode.lens, UniformLens)


def test_rays_of_both_passes_count(few_neighbours):
    plain, reused = loop_of("uniform").step(), loop_of("area-restir").step()
    assert 3 * plain.rays < reused.rays < 10 * plain.rays  # eight shifts a pixel, of which some fail before they trace
    assert reused.samples == plain.samples == WIDTH * HEIGHT


def test_constant_radiance_comes_out_exactly_where_nothing_is_out_of_reach(few_neighbours, monkeypatch):
    """With lens copies in an even environment all weights sum to 1 sample by sample."""
    monkeypatch.setattr(spatial_reuse, "copied_share", lambda coc, radius: torch.ones_like(coc))
    shown = scene(max_depth=1)
    even = replace(shown, meshes=shown.meshes[2:3], environment=Environment(np.full((1, 1, 3), 0.5, np.float32)))
    away = replace(even, camera=replace(even.camera, target=(0.0, 0.0, 1.0)))
    loop = loop_of("area-restir", shown=away)
    for _ in range(3):
        loop.step()
    np.testing.assert_allclose(loop.film.layers()["beauty"], 0.5, rtol=1e-5)


def test_a_pinhole_copies_only():
    pinhole = replace(scene(), camera=replace(scene().camera, aperture_radius=0.0))
    loop = loop_of("area-restir+lis", shown=pinhole)
    assert isinstance(loop.mode.lens, UniformLens) and bool((loop.mode.reuse.spatial._copied == spatial_reuse.NEIGHBOURS).all())
    loop.step()
    assert float(loop.film.radiance().mean()) > 0.05


def test_a_frame_of_one_pixel_has_no_neighbours():
    alone, plain = loop_of("area-restir", shown=scene(1, 1)), loop_of("uniform", shown=scene(1, 1))
    plain.shadow_roulette = ShadowRoulette(1, 1, cell=0)  # as in Area ReSTIR
    for _ in range(4):
        assert alone.step().rays == plain.step().rays
    torch.testing.assert_close(alone.film.radiance(), plain.film.radiance())


def test_a_bad_initial_sample_is_reported_in_its_pixel_and_reused_nowhere(few_neighbours):
    loop = loop_of("area-restir")
    trace = loop.tracer.trace

    def spoilt(*arguments, **keywords):
        loop.tracer.trace = trace  # the first pass only
        samples = trace(*arguments, **keywords)
        samples.radiance[:, ::5] = torch.nan
        return samples

    loop.tracer.trace = spoilt
    loop.step()
    assert loop.film.bad_count == len(range(0, WIDTH * HEIGHT, 5))
    assert bool(loop.film.radiance().isfinite().all())
    counts = loop.film.layers()["sample_count"].ravel()
    assert not counts[::5].any() and counts.sum() == WIDTH * HEIGHT - loop.film.bad_count


def test_a_bad_shift_is_reported(few_neighbours):
    loop = loop_of("area-restir")
    trace, calls = loop.tracer.trace, []

    def spoilt(*arguments, **keywords):
        samples = trace(*arguments, **keywords)
        calls.append(len(calls))
        if len(calls) == 3:
            samples.radiance[:, 10] = torch.inf
        return samples

    loop.tracer.trace = spoilt
    loop.step()
    assert loop.film.bad_count == 1
    assert bool(loop.film.radiance().isfinite().all())


@pytest.mark.parametrize("radius", [0.0, -3.0, 1e6, float("nan")])
def test_a_radius_out_of_range_is_named(radius):
    with pytest.raises(BokehguideError, match=r"^reuse_radius: .* is out of range; give pixels from 1 to 65536"):
        RenderSettings("area-restir", reuse_radius=radius)


def test_the_paper_radius_is_the_default():
    assert RenderSettings("area-restir").reuse_radius == 50.0


@pytest.mark.slow
def test_the_command_line_from_end_to_end(bokehguide, lamps_file, tmp_path, monkeypatch, capsys):
    options = ("render", str(lamps_file), "--mode", "area-restir+lis", "--reuse-radius", "4")
    options += ("--spp", "4", "--size", "24x16")
    finished = bokehguide(*options, "--logdir", "logs", "--json", "a.json", "--out", "a.exr")
    assert finished.returncode == 0, finished.stderr
    facts = read_metadata(tmp_path / "a.exr")
    assert facts["mode"] == "area-restir+lis" and "--reuse-radius=4.0" in facts["command"]
    assert json.loads(facts["settings"])["reuse_radius"] == 4.0
    assert (read_exr(tmp_path / "a.exr")["samples.Y"] == 4).all()
    assert json.loads((tmp_path / "a.json").read_text())["mode"] == "area-restir+lis"
    log = EventAccumulator(str(tmp_path / "logs/emitters/area-restir+lis")).Reload()
    assert {"error/relative_noise", "guide/gaussians", "speed/samples_per_second"} <= set(log.Tags()["scalars"])

    monkeypatch.chdir(tmp_path)
    assert main([*options, "--out", "b.exr", "--threads", "2"]) == 0
    one, two = read_exr(tmp_path / "a.exr"), read_exr(tmp_path / "b.exr")
    for name in one:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)

    capsys.readouterr()
    assert main(["render", str(lamps_file), "--mode", "area-restir", "--reuse-radius", "0.5"]) == 2
    assert capsys.readouterr().err == "bokehguide: error: --reuse-radius: 0.5 is out of range; give pixels from 1 to 65536\n"
