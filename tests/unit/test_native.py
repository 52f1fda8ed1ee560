"""The native core against the PyTorch code: stage by stage, path by path, and as a fallback."""

import sys

import numpy as np
import pytest
import torch
from torch import Tensor

from bokehguide.render.bsdf.mixture import Scattering
from bokehguide.render.dimensions import MAX_CROSSINGS
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.runtime import native
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene import Overrides, load_scene
from bokehguide.train import RenderLoop, RenderSettings
from tests.support.native_cases import (
    BUILT_IN,
    FEATURES,
    both_tracers,
    core,
    each_instruction_set,
    feature_scene,
    rays,
    rows_of,
    tables,
)

COUNT = 4000
ROUNDING = 2e-3
"""Relative difference that rounding may grow to along a path."""
FAST, LARGE = (*BUILT_IN[:4], "large sheet", "panes"), BUILT_IN[4:]
FLIPS = 1e-3
"""Share of paths that may take another branch where rounding differs."""


def differing(one: torch.Tensor, other: torch.Tensor, tolerance: float = ROUNDING) -> float:
    """Share of columns `[.., N]` with a difference beyond rounding; NaN equals NaN."""
    same = torch.isclose(one, other, rtol=tolerance, atol=1e-5, equal_nan=True)
    return 1.0 - float(same.reshape(-1, same.shape[-1]).all(0).float().mean())


@pytest.mark.parametrize("step", [1, 2, 7, 1000, 2**29])
def test_random_numbers_have_the_same_bits(step, monkeypatch):
    core()
    pixels = torch.tensor([0, 1, 2**31 - 1, -5, 77, 12, 13, 14, 15])
    random, kinds = PixelRandom(3, step, pixels), (("uniform", 2**30, 3), ("uniform", 2, 5), ("stratified", 32, 6))
    copies, first = random.copies(torch.arange(9)), (1 << (step - 1).bit_length() - 1) + 1 if step > 1 else 1

    def numbers() -> list[Tensor]:
        grouped = random.in_groups(torch.arange(9, dtype=torch.int32) // 4, torch.arange(9, dtype=torch.int32) % 4, 4)
        sources = copies, grouped, grouped.copies(torch.arange(9))
        further = [one.stratified(33, 3, begins, number) for one in sources for begins in (1, first) for number in (0, 1, 5)]
        return [getattr(random, kind)(*given) for kind, *given in kinds] + [random.stratified(5, 2, step // 2 + 1), *further]

    found = numbers()
    monkeypatch.setenv(native.SWITCH, "0")
    for one, other in zip(found, numbers()):
        assert torch.equal(one, other)


def test_groups_beyond_the_tables_of_the_core_are_refused():
    with pytest.raises(ValueError, match="64 pixels"):
        core().Random(1, 2, 3, 128)


@pytest.mark.parametrize("name", FEATURES)
def test_surfaces_emission_and_opacity_agree(name):
    _, reference = both_tracers(name)
    origin, direction, _ = rays(name, COUNT)
    hit = reference.geometry.tracer.intersect(origin, direction)
    met = torch.nonzero(hit.triangle >= 0)[:, 0]
    hit = type(hit)(*(values[met].contiguous() for values in hit))
    origin, direction = origin[:, met].contiguous(), direction[:, met].contiguous()
    surface = reference.geometry.surface(origin, direction, hit)
    expected = rows_of(surface)
    rows = torch.empty_like(expected)
    core().surfaces(tables(name), origin, direction, hit.triangle, torch.stack(hit[1:]), rows)
    assert differing(rows, expected, 1e-4) <= FLIPS

    points = origin + torch.randn(origin.shape, generator=torch.Generator().manual_seed(1))
    cosine = direction[0].contiguous()
    out = torch.empty(8, len(met))
    hits = torch.stack((*hit[1:], surface.front, cosine))
    core().emitters(tables(name), points, -direction, hit.triangle, hits, out)
    geometry = reference.geometry
    assert differing(out[0:3], geometry.emission(hit, surface.front, -direction), 1e-4) <= FLIPS
    pdf = reference.light_sampler.triangle_pdf(points, hit.triangle, hit.distance, cosine)
    assert differing(out[3], pdf, 1e-4) <= FLIPS
    if geometry.materials.has_translucent:
        assert differing(out[4], geometry.opacity(hit), 1e-4) <= FLIPS
    passed = geometry.transmittance(hit, surface.front)
    assert passed is None or differing(out[5:8], passed, 1e-4) == 0.0


@pytest.mark.parametrize("name", ("textures", "coats", "glass", "layers", "leaves", "films", "gems", "solids", "extremes"))
def test_bsdfs_agree(name):
    _, reference = both_tracers(name)
    origin, direction, random = rays(name, COUNT, 1)
    hit = reference.geometry.tracer.intersect(origin, direction)
    met = torch.nonzero(hit.triangle >= 0)[:, 0]
    hit = type(hit)(*(values[met].contiguous() for values in hit))
    surface = reference.geometry.surface(origin[:, met], direction[:, met], hit)
    random = random.select(met)
    choice, uniforms = random.uniform(0, 1)[0], random.uniform(1, 3)
    towards = torch.nn.functional.normalize(torch.randn(3, len(met), generator=torch.Generator().manual_seed(2)), dim=0)
    scattering, rows = Scattering(surface, choice), rows_of(surface)
    value, sample = torch.empty(4, len(met)), torch.empty(7, len(met))
    core().evaluate(tables(name), rows, choice, towards, value)
    core().sample(tables(name), rows, choice, uniforms, sample)
    expected, pdf = scattering.evaluate(towards)
    assert differing(value, torch.cat((expected, pdf[None]))) <= FLIPS
    drawn, weight, density = scattering.sample(uniforms)
    assert differing(sample[0:3], drawn) <= FLIPS
    assert differing(sample[3:7], torch.cat((weight, density[None])), 2e-2) <= 5.0 * FLIPS  # near-mirrors amplify rounding


@pytest.mark.parametrize("name", [name for name in FEATURES if name != "dark"])
def test_light_samples_and_their_densities_agree(name):
    _, reference = both_tracers(name)
    points, direction, random = rays(name, COUNT, 2)
    sampler, uniforms = reference.light_sampler, random.uniform(0, 6)
    out = torch.empty(8, COUNT)
    core().lights(tables(name), points, uniforms, out)
    light = sampler.draw(reference.lights.query(points), uniforms)
    assert differing(out, torch.cat((light.direction, light.distance[None], light.radiance, light.pdf[None]))) <= FLIPS
    environment = reference.lights.environment
    if environment is not None:
        sky = torch.empty(5, COUNT)
        core().environment(tables(name), points, direction, sky)
        expected = environment.radiance(direction), environment.alpha(direction), sampler.environment_pdf(points, direction)
        assert differing(sky, torch.cat([value.reshape(-1, COUNT) for value in expected])) <= FLIPS


@pytest.mark.parametrize("name", (*FEATURES, *FAST, *(pytest.param(name, marks=pytest.mark.slow) for name in LARGE)))
def test_paths_agree(name):
    """Radiance and AOVs of the same paths, but for a few that rounding sends elsewhere."""
    tracer, reference = both_tracers(name)
    origin, direction, random = rays(name, COUNT)
    alive = torch.rand(COUNT, generator=torch.Generator().manual_seed(3)) - 0.1
    found, expected = (each.trace(origin, direction, random, PhaseTimer(), alive=alive) for each in (tracer, reference))
    assert differing(found.radiance, expected.radiance) <= 2.0 * FLIPS
    for field in ("distance", "normal", "albedo", "emission", "alpha"):
        assert differing(getattr(found, field), getattr(expected, field)) <= FLIPS, field
    assert (found.triangle != expected.triangle).float().mean() <= FLIPS
    assert abs(found.rays - expected.rays) <= 2.0 * FLIPS * expected.rays


def test_more_sheets_than_a_shadow_ray_crosses_block_it():
    origin, direction, random = rays("many sheets", 200)
    for tracer in both_tracers("many sheets"):
        found = tracer.trace(origin, direction, random, PhaseTimer())
        on_floor = (found.triangle == 0) | (found.triangle == 1)  # fewer sheets lie between a sheet and the lamp
        assert found.rays > MAX_CROSSINGS * 50 and on_floor.sum() > 20 and not found.radiance[:, on_floor].any()


def test_nan_and_infinite_rays_and_throughputs_give_what_pytorch_gives():
    tracer, reference = both_tracers("lamps")
    origin, direction, random = rays("lamps", 16)
    direction[0, 3], direction[:, 4], origin[1, 5] = torch.nan, 0.0, torch.inf
    found, expected = (each.trace(origin, direction, random, PhaseTimer(), max_depth=2) for each in (tracer, reference))
    assert torch.equal(found.triangle, expected.triangle)
    whole = torch.tensor([0, 1, 2, *range(6, 16)])
    assert differing(found.radiance[:, whole], expected.radiance[:, whole]) == 0.0


@pytest.mark.parametrize("name", ("textures", "sheets", "lamps", "fairy-lights"))
def test_a_path_does_not_depend_on_its_batch(name):
    tracer, _ = both_tracers(name)
    origin, direction, random = rays(name, 2500)
    whole = tracer.trace(origin, direction, random, PhaseTimer())
    part = torch.arange(3, 2500, 3)
    alone = tracer.trace(origin[:, part], direction[:, part], random.select(part), PhaseTimer())
    assert torch.equal(alone.radiance, whole.radiance[:, part])
    assert torch.equal(alone.normal, whole.normal[:, part])


@pytest.mark.parametrize("name", ("textures", "glass", "sheets", "lamps"))
def test_all_instruction_sets_give_the_same_bits(name):
    tracer, _ = both_tracers(name)
    origin, direction, random = rays(name, 1001)
    first, *others = each_instruction_set(lambda: tracer.trace(origin, direction, random, PhaseTimer()))
    for other in others:
        for field in ("radiance", "normal", "albedo", "distance"):
            torch.testing.assert_close(getattr(other, field), getattr(first, field), rtol=0.0, atol=0.0, equal_nan=True)


def test_unknown_instruction_sets_are_refused():
    with pytest.raises(ValueError, match="the processor has no instruction set mmx"):
        core().use_instruction_set("mmx")


@pytest.mark.parametrize("mode", ("uniform", "guided", pytest.param("lis-o", marks=pytest.mark.slow)))
def test_threads_change_no_bit(mode):
    core()
    scene = load_scene("fairy-lights", Overrides(width=320, height=180))
    films = []
    for threads in (1, 2):
        with RenderLoop(scene, RenderSettings(mode, threads=threads)) as loop:
            for _ in range(2):
                loop.step()
            films.append(loop.film.layers())
    for name, layer in films[0].items():
        np.testing.assert_array_equal(layer, films[1][name], err_msg=name)


def test_films_of_both_paths_agree(monkeypatch):
    core()
    pictures = []
    for switch in ("1", "0"):
        monkeypatch.setenv(native.SWITCH, switch)
        with RenderLoop(
            load_scene("chrome", Overrides(width=48, height=27)), RenderSettings("lis-o", crop=(3, 2, 40, 21))
        ) as loop:
            for _ in range(4):
                loop.step()
            pictures.append(loop.film.layers())
    for name, layer in pictures[0].items():
        same = np.isclose(layer, pictures[1][name], rtol=ROUNDING, atol=1e-4)
        assert same.mean() > 0.99, name


def test_without_the_extension_pytorch_renders(monkeypatch):
    monkeypatch.setitem(sys.modules, "bokehguide._native", None)
    native._loaded.cache_clear()
    try:
        assert native.core() is None
        tracer = PathTracer(feature_scene("lamps"))
        assert tracer.native is None and tracer.geometry.tracer.native is None
        origin, direction, random = rays("lamps", 100)
        assert tracer.trace(origin, direction, random, PhaseTimer()).radiance.isfinite().all()
    finally:
        monkeypatch.undo()
        native._loaded.cache_clear()


def test_another_embree_is_not_used(monkeypatch):
    core()
    monkeypatch.setattr(native, "VERSIONS", range(1))
    native._loaded.cache_clear()
    try:
        assert native.core() is None
    finally:
        native._loaded.cache_clear()


def test_the_core_rejects_arrays_of_wrong_sizes():
    found, scene = core(), tables("dark")
    origin, direction, random = rays("dark", 10)
    keys = random.core_keys(found)
    good = [origin, direction, None, random.pixel_keys, keys, 2, torch.empty(14, 10), torch.empty(10, dtype=torch.int32)]
    scene.trace(*good)
    for place, wrong in ((0, origin[:, :9].contiguous()), (2, torch.ones(11)), (6, torch.empty(13, 10))):
        given = list(good)
        given[place] = wrong
        with pytest.raises(ValueError, match="entries"):
            scene.trace(*given)
