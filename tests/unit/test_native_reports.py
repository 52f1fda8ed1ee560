"""Agreement of the native core and PyTorch on pixels and their rays, and on what batches report to the guides of the lens."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from bokehguide.guiding.emitter_guide import MAX_RATIO, EmitterGuide
from bokehguide.guiding.gaussian_guide import GaussianGuide
from bokehguide.guiding.success_rates import SuccessRates
from bokehguide.models.base import LensDensity, LensMixture
from bokehguide.render import dimensions
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.film import NO_DEPTH
from bokehguide.render.random import PixelRandom
from bokehguide.render.tracer import MISS_DISTANCE
from bokehguide.runtime import native
from bokehguide.runtime.indexing import Pixels
from bokehguide.scene import Overrides, load_scene
from bokehguide.train import RenderLoop, RenderSettings
from tests.support.guides import pixel_batch
from tests.support.native_cases import each_instruction_set

WIDTH, HEIGHT = 83, 37
COUNT = WIDTH * HEIGHT
SOME = torch.arange(COUNT)[torch.arange(COUNT) % 7 != 3]
NOT_FINITE = (torch.nan, torch.inf, -torch.inf)


@pytest.fixture
def both(monkeypatch) -> Callable[[Callable[[], Any]], tuple[Any, Any]]:
    """A function that returns the results of another one in the native core and in PyTorch."""

    def run(work: Callable[[], Any]) -> tuple[Any, Any]:
        results = []
        for form in ("1", "0"):
            monkeypatch.setenv(native.SWITCH, form)
            results.append(work())
        return results[0], results[1]

    return run


def camera() -> ThinLensCamera:
    return ThinLensCamera(load_scene("chrome").camera, WIDTH, HEIGHT)


def numbers(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("seed", (0, 7, -3, 2**40 + 1))
@pytest.mark.parametrize("pixels", (slice(100, 1901), SOME, SOME[:0], slice(5, 6)), ids=("slice", "indices", "none", "one"))
@pytest.mark.parametrize("step", (1, 2, 9, 700))
def test_film_positions_have_the_same_bits(both, seed, pixels, step):
    def positions() -> list[Tensor]:
        random = PixelRandom(seed, step, pixels)
        return [random.pixel_keys, *camera().film_positions(pixels, random)]

    for found, expected in zip(*both(positions)):
        assert torch.equal(found, expected)


def test_film_positions_lie_in_their_pixels():
    raster, subpixel, focus = camera().film_positions(SOME, PixelRandom(3, 5, SOME))
    corner = torch.stack((SOME % WIDTH, SOME // WIDTH))
    assert torch.equal(raster.floor().long(), corner) and torch.equal(subpixel, raster - corner)
    torch.testing.assert_close(focus, camera().focus_points(raster))


@pytest.mark.parametrize("step, first", ((9, 9), (12, 9), (30, 9), (1, 1)))
def test_stratified_numbers_replace_those_of_some_pixels(both, step, first):
    replaced = numbers(COUNT, seed=1) < 0.3

    def stratified() -> Tensor:
        found = numbers(2, COUNT)
        PixelRandom(4, step, slice(0, COUNT)).stratify(found, replaced, dimensions.LENS, first)
        return found

    found, expected = both(stratified)
    assert torch.equal(found, expected) and torch.equal(found[:, ~replaced], numbers(2, COUNT)[:, ~replaced])
    assert (found[:, replaced] != numbers(2, COUNT)[:, replaced]).float().mean() > 0.99


def test_lens_points_and_depths_agree(both):
    lens, uniforms = camera().lens, numbers(2, COUNT)
    found, expected = both(lambda: lens.sample(uniforms))
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6 * lens.radius)
    distance, directions = 10.0 * numbers(COUNT), numbers(3, COUNT, seed=2) - 0.5
    distance[::5], distance[7], directions[1, 8] = MISS_DISTANCE, torch.nan, torch.inf
    found, expected = both(lambda: camera().depth(distance, directions))
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5, equal_nan=True)
    assert (found[::5] == NO_DEPTH).all() and found[7] == NO_DEPTH


@cache
def guide(mode: str) -> EmitterGuide | GaussianGuide:
    """A guide that has learned for some steps."""
    with RenderLoop(load_scene("fairy-lights", Overrides(width=WIDTH, height=HEIGHT)), RenderSettings(mode, threads=1)) as loop:
        for _ in range(10):
            loop.step()
    assert isinstance(loop.mode.lens, (EmitterGuide, GaussianGuide))
    return loop.mode.lens


def reported(mode: str, pixels: Pixels = slice(0, COUNT)) -> tuple[Any, Tensor]:
    """Samples of a batch, some of them not finite or not on the film, and which are on the film."""
    learned = guide(mode)
    batch = pixel_batch(learned, pixels)
    query = learned.query(batch)
    drawn, count = query.sample(), batch.focus.shape[1]
    generator = torch.Generator().manual_seed(5)
    radiance = torch.exp(4.0 * torch.randn(3, count, generator=generator))
    radiance[:, ::4], good, weight = 0.0, numbers(count, seed=6) < 0.9, drawn.weight.clone()
    for place, value in enumerate(NOT_FINITE):
        radiance[place, 50 + place], weight[60 + place] = value, value
    known = torch.tensor([True]) if isinstance(learned, GaussianGuide) else learned._proposals.triangles
    triangle = torch.randint(len(known), (count,), generator=generator).int()
    triangle[::3], triangle[1::9] = -1, known.nonzero()[0, 0].int()
    emission = radiance * (torch.rand(count, generator=generator) < 0.5)
    paths = SimpleNamespace(radiance=radiance, emission=emission, triangle=triangle)
    drawn = drawn._replace(weight=weight)
    return SimpleNamespace(batch=batch, query=query, drawn=drawn, paths=paths), good


@pytest.mark.parametrize("pixels", (slice(0, COUNT), slice(83, 2001), SOME), ids=("frame", "slice", "indices"))
@pytest.mark.parametrize("mode", ("lis-o", "guided"))
def test_weights_ratios_and_light_agree(both, mode, pixels):
    learned, (samples, good) = guide(mode), reported(mode, pixels)
    query = samples.query
    assert 100 < int(query.mixture.guided.sum()) < len(good)
    found, expected = both(lambda: learned._weights_and_ratios(samples, good, query))
    assert torch.equal(found[0], expected[0]) and not found[0][60:63].any() and not found[0][~good].any()
    torch.testing.assert_close(found[1], expected[1], rtol=1e-6, atol=0.0)
    assert int((found[1] > 0.0).sum()) > 500
    torch.testing.assert_close(found[2], expected[2], rtol=1e-4, atol=1e-4 * float(expected[1].sum()))
    assert torch.equal(found[2][:2], expected[2][:2])
    alone = both(lambda: learned._weights_and_ratios(samples, good, None))
    assert torch.equal(alone[0][0], alone[1][0]) and not alone[0][2].any()
    found, expected = both(lambda: learned.recorded_light(samples.paths, good))
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)
    assert found.isfinite().all() and not found[~good].any() and int((found > 0.0).sum()) > 500


@pytest.mark.parametrize("whole_environment", (False, True))
def test_the_record_leaves_out_known_emitters_and_the_environment(both, monkeypatch, whole_environment):
    learned, (samples, good) = guide("guided"), reported("guided")
    assert isinstance(learned, EmitterGuide)
    monkeypatch.setattr(learned, "_proposals", replace(learned._proposals, whole_environment=whole_environment))
    found, expected = both(lambda: learned.recorded_light(samples.paths, good))
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)
    missed = (samples.paths.triangle < 0) & good & (samples.paths.radiance[0] > 0.0)
    assert int(missed.sum()) > 100 and bool((found[missed] == 0.0).all()) == whole_environment
    lit = good & (samples.paths.triangle >= 0) & (samples.paths.emission[1] > 0.0)
    known = learned._proposals.triangles[samples.paths.triangle.long()]
    assert int((lit & known).sum()) > 20 and not found[lit & known].any() and bool((found[lit & ~known] > 0.0).all())


@pytest.mark.parametrize("pixels", (slice(0, COUNT), slice(83, 2001), SOME), ids=("frame", "slice", "indices"))
def test_moments_and_draws_of_emitters_agree(both, pixels):
    learned, (samples, good) = guide("guided"), reported("guided", pixels)
    assert isinstance(learned, EmitterGuide)
    ratio = learned._weights_and_ratios(samples, good, samples.query)[1]
    for place, value in enumerate((torch.inf, torch.nan, 1e30)):
        drawn = (samples.drawn.candidate >= 0).nonzero()[place, 0]
        ratio[drawn] = value

    def learn() -> tuple[Tensor, Tensor, Tensor]:
        learned.moments.zero_()
        slots, squared = learned.learn_from(samples, samples.query, ratio)
        return learned.moments.nan_to_num(-1.0), slots, squared

    found, expected = both(learn)
    for one, other in zip(found, expected):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=0.0)
    assert len(found[1]) == int((samples.drawn.candidate >= 0).sum()) > 100
    assert float(found[2].max()) == pytest.approx(MAX_RATIO**2) and int((found[0] > 0.0).sum()) > 200


@pytest.mark.parametrize("pixels", (slice(0, COUNT), slice(83, 2001), SOME), ids=("frame", "slice", "indices"))
def test_success_rates_of_candidates_agree(both, pixels):
    learned = guide("guided")
    assert isinstance(learned, EmitterGuide) and learned.candidates is not None
    given = learned.candidates.batch(pixels)
    (slots, rates), expected = both(lambda: learned.success_rates.of_candidates(pixels, *given))
    assert torch.equal(slots, expected[0]) and torch.equal(rates, expected[1])
    assert len(slots.unique()) > 100 and len(rates.unique()) > 20


def test_emitters_have_no_slot_of_other_components(both):
    """In a table of 16 slots, some hashes are 0."""
    rates, pixels, emitters = SuccessRates(ThinLensCamera(load_scene("chrome").camera, 7, 4), 40), 28, 40
    rates.rates.copy_(numbers(len(rates.rates), seed=8))
    start, component = torch.arange(0, 20 * pixels + 1, 20), (60.0 * numbers(20 * pixels)).long()
    (slots, found), expected = both(lambda: rates.of_candidates(slice(0, pixels), start, component))
    assert torch.equal(slots, expected[0]) and torch.equal(found, expected[1])
    assert len(rates.rates) == 16 and torch.equal(slots > 0, component < emitters)


@pytest.mark.parametrize("mode", ("lis-o", "guided"))
def test_weights_of_lens_points_agree(mode):
    learned = guide(mode)
    query = learned.query(pixel_batch(learned, slice(0, COUNT)))
    mixture = query.mixture
    points = 1.2 * mixture.lens.radius * (2.0 * numbers(2, COUNT) - 1.0)
    at = mixture.evaluate(points)
    at = LensDensity(at.points, at.components, at.mixture, at.density * (numbers(COUNT, seed=3) < 0.9))
    found, expected = mixture.weights(at), LensMixture.weights(mixture, at)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=0.0)
    assert (found[~mixture.guided] == 1.0).all() and int((found == 0.0).sum()) > 100


def test_all_instruction_sets_give_the_same_bits():
    def all_results() -> list[Tensor]:
        learned, random = guide("guided"), PixelRandom(1, 3, SOME)
        samples, good = reported("guided")
        weight, ratio, figures = learned._weights_and_ratios(samples, good, samples.query)
        results = [*camera().film_positions(SOME, random), camera().lens.sample(random.uniform(0, 2)), weight, ratio, figures]
        assert isinstance(learned, EmitterGuide)
        learned.moments.zero_()
        results += [*learned.learn_from(samples, samples.query, ratio), learned.moments.clone()]
        return [*results, learned.recorded_light(samples.paths, good)]

    first, *others = each_instruction_set(all_results)
    for other in others:
        assert all(torch.equal(one.nan_to_num(-1.0), another.nan_to_num(-1.0)) for one, another in zip(first, other))
