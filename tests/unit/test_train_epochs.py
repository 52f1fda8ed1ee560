"""Lens points stratified over blocks of steps: which pixels, when, and why the mean stays what it is."""

import math
from dataclasses import replace

import torch

from bokehguide.guiding.protocols import PixelBatch
from bokehguide.models import CandidateList
from bokehguide.render import dimensions
from bokehguide.render.epochs import epoch_number, epoch_of, starts_epoch
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import luminance
from bokehguide.scene.shapes import transform, transformed, unit_rectangle
from bokehguide.scene.types import Camera, FilmSettings, Scene
from bokehguide.train import RenderLoop, RenderSettings
from tests.support import scenes
from tests.support.guides import mixture_query, pixel_batch
from tests.support.statistical import SIGNIFICANCE, z_test

WIDTH, HEIGHT, STEPS = 320, 200, 16
PIXELS = WIDTH * HEIGHT
OPEN = (math.acos(0.5) - 0.5 * math.sqrt(0.75)) / math.pi
"""Share of a disc beyond a row_interval at half its radius."""


def mostly_blocked() -> Scene:
    """Radiance 1 through the lens right of half its radius; a black card hides the rest."""
    camera = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=10.0, aperture_radius=0.1, focus_distance=2.0)
    card = transformed(unit_rectangle(), transform(translate=(-0.95, 0.0, -1e-5)))
    return Scene("blocked", camera, (card,), (scenes.BLACK,), FilmSettings(WIDTH, HEIGHT, max_depth=1), scenes.constant_sky(1.0))


def test_epochs_begin_so_that_their_lengths_are_powers_of_two():
    assert [step for step in range(1, 70) if starts_epoch(step)] == [1, 2, 3, 5, 9, 17, 33, 65]
    assert [epoch_number(step) for step in range(1, 10)] == [0, 1, 2, 2, 3, 3, 3, 3, 4]
    assert all(epoch_number(epoch_of(step)) == epoch_number(step) for step in range(1, 70))


def guide_by_own_samples(loop: RenderLoop, respects_epochs: bool) -> None:
    """From now on a pixel is guided as soon as one of its own samples was bright."""
    guide = loop.mode.lens
    guide.field.assign(torch.tensor([[0.0], [0.0], [6.0]]), torch.tensor([0.5]), torch.tensor([0.25]), torch.tensor([1.0]))

    def refit(mean_luminance: float) -> None:
        seen = luminance(loop.film.radiance().reshape(-1, 3).T) > 0.0
        if respects_epochs:
            seen &= ~guide.uniform
        else:
            guide.uniform.copy_(~seen)
        start = torch.cat((torch.zeros(1, dtype=torch.int64), seen.cumsum(0)))
        guide.candidates = CandidateList(start, torch.zeros(int(start[-1]), dtype=torch.int32))

    guide.refit = refit


def mean_check(respects_epochs: bool) -> float:
    """p-value of the frame's mean against OPEN."""
    loop = RenderLoop(mostly_blocked(), RenderSettings("lis", seed=5, threads=1))
    guide_by_own_samples(loop, respects_epochs)
    for _ in range(STEPS):
        loop.step()
    assert 0 < len(loop.mode.lens.candidates.gaussian) < PIXELS or not respects_epochs
    error = math.sqrt(float(loop.film.variance().double().mean()) / PIXELS)
    return z_test(loop.film.mean_luminance() - OPEN, error)


def test_a_pixel_that_learns_from_its_own_samples_keeps_its_mean():
    assert mean_check(respects_epochs=True) > SIGNIFICANCE


def test_without_the_wait_for_the_end_of_an_epoch_the_mean_is_wrong():
    assert mean_check(respects_epochs=False) < SIGNIFICANCE


def test_uniform_pixels_take_the_numbers_of_their_epoch():
    loop = RenderLoop(mostly_blocked(), RenderSettings("lis", seed=3, threads=1))
    guide = loop.mode.lens
    guide.uniform[100:200] = True
    guide.epoch.fill_(5)
    places = slice(50, 250)
    random = PixelRandom(3, 7, torch.arange(50, 250))
    raster = torch.zeros(2, 200)
    batch = PixelBatch(7, places, places, raster, raster, torch.ones(3, 200), random, 1.0)
    uniforms, independent = guide.query(batch).uniforms, random.uniform(dimensions.LENS, dimensions.LENS_COUNT)[2:4]
    expected = random.stratified(dimensions.LENS, 2, first=5)
    assert torch.equal(uniforms[:, 50:150], expected[:, 50:150])
    assert torch.equal(uniforms[:, :50], independent[:, :50]) and torch.equal(uniforms[:, 150:], independent[:, 150:])


def test_weights_of_stratified_samples_are_independent_of_earlier_steps_at_the_start_of_an_epoch_only():
    guide = RenderLoop(scenes.emitters(8, 5), RenderSettings("guided", threads=1)).mode.lens
    guide.epoch.fill_(5)
    assert [guide.is_independent(step) for step in (5, 6, 7, 8)] == [True, False, False, False]


def test_emitters_are_sampled_by_the_numbers_of_their_epoch():
    guide = RenderLoop(scenes.emitters(64, 36), RenderSettings("guided", threads=1)).mode.lens
    guide.epoch.fill_(5)
    random = PixelRandom(0, 7, torch.arange(64 * 36))
    query = mixture_query(guide, replace(pixel_batch(guide), step=7, random=random))
    assert torch.equal(query.uniforms, random.stratified(dimensions.LENS, 3, first=5).roll(1, 0))


def test_a_pixel_without_candidates_waits_for_the_end_of_its_epoch():
    """A pixel with candidates keeps learning meanwhile."""
    loop = RenderLoop(scenes.emitters(64, 36), RenderSettings("lis", threads=1))
    found, uniform = [], []
    for _ in range(9):
        loop.step()
        start = loop.mode.lens.candidates.start
        found.append(start[1:] > start[:-1])
        uniform.append(loop.mode.lens.uniform.clone())
    for step in (3, 5, 6, 7):  # no epoch begins after these
        assert torch.equal(uniform[step - 1], uniform[step - 2])
        assert not (found[step - 1] & uniform[step - 1]).any()
    for step in (2, 4, 8):
        assert torch.equal(uniform[step - 1], ~found[step - 1])
    assert found[8].any() and uniform[8].any()
