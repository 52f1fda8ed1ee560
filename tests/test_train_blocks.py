"""Lens points stratified over blocks of steps: which pixels, when, and why the mean stays what it is."""

import math

import scenes
import torch
from statistical import SIGNIFICANCE, z_test

from bokehguide.models import CandidateList
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import luminance
from bokehguide.scene.shapes import transform, transformed, unit_rectangle
from bokehguide.scene.types import Camera, Film, Scene
from bokehguide.train import RenderLoop, RenderSettings
from bokehguide.train.guide import LENS_DIMENSION, starts_block

WIDTH, HEIGHT, STEPS = 320, 200, 16
PIXELS = WIDTH * HEIGHT
OPEN = (math.acos(0.5) - 0.5 * math.sqrt(0.75)) / math.pi
"""Share of a disc beyond a chord at half its radius."""


def mostly_blocked() -> Scene:
    """Radiance 1 through the lens right of half its radius; a black card hides the rest."""
    camera = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=10.0, aperture_radius=0.1, focus_distance=2.0)
    card = transformed(unit_rectangle(), transform(translate=(-0.95, 0.0, -1e-5)))
    return Scene("blocked", camera, (card,), (scenes.BLACK,), Film(WIDTH, HEIGHT, max_depth=1), scenes.constant_sky(1.0))


def test_blocks_begin_so_that_their_lengths_are_powers_of_two():
    assert [step for step in range(1, 70) if starts_block(step)] == [1, 2, 3, 5, 9, 17, 33, 65]


def guide_by_own_samples(loop: RenderLoop, respects_blocks: bool) -> None:
    """From now on a pixel is guided as soon as a sample of its own was bright: the past could not tell more."""
    guide = loop.guide
    guide.field.assign(torch.tensor([[0.0], [0.0], [6.0]]), torch.tensor([0.5]), torch.tensor([0.25]), torch.tensor([1.0]))

    def refit(mean_luminance: float) -> None:
        seen = luminance(loop.film.radiance().reshape(-1, 3).T) > 0.0
        if respects_blocks:
            seen &= ~guide.held
        else:
            guide.held.copy_(~seen)
        start = torch.cat((torch.zeros(1, dtype=torch.int64), seen.cumsum(0)))
        guide.candidates = CandidateList(start, torch.zeros(int(start[-1]), dtype=torch.int32))

    guide.refit = refit


def mean_check(respects_blocks: bool) -> float:
    """p-value of the frame's mean against OPEN."""
    loop = RenderLoop(mostly_blocked(), RenderSettings("lis", seed=5, threads=1))
    guide_by_own_samples(loop, respects_blocks)
    for _ in range(STEPS):
        loop.step()
    assert 0 < len(loop.guide.candidates.gaussian) < PIXELS or not respects_blocks
    error = math.sqrt(float(loop.film.variance().double().mean()) / PIXELS)
    return z_test(loop.film.mean_luminance() - OPEN, error)


def test_a_pixel_that_learns_from_its_own_samples_keeps_its_mean():
    assert mean_check(respects_blocks=True) > SIGNIFICANCE


def test_without_the_wait_for_the_end_of_a_block_the_mean_is_wrong():
    assert mean_check(respects_blocks=False) < SIGNIFICANCE


def test_held_pixels_take_the_numbers_of_their_block():
    loop = RenderLoop(mostly_blocked(), RenderSettings("lis", seed=3, threads=1))
    guide = loop.guide
    guide.held[100:200] = True
    guide.block.fill_(5)
    random = PixelRandom(3, 7, torch.arange(50, 250))
    uniforms = random.uniform(LENS_DIMENSION, 5)
    independent = uniforms.clone()
    guide.stratify(slice(50, 250), random, uniforms)
    expected = random.stratified(LENS_DIMENSION, 2, first=5)
    assert torch.equal(uniforms[2:4, 50:150], expected[:, 50:150])
    uniforms[2:4, 50:150] = independent[2:4, 50:150]
    assert torch.equal(uniforms, independent)


def test_a_pixel_without_candidates_waits_for_the_end_of_its_block():
    """One that has some keeps learning meanwhile."""
    loop = RenderLoop(scenes.lamps(64, 36), RenderSettings("lis", threads=1))
    found, held = [], []
    for _ in range(9):
        loop.step()
        start = loop.guide.candidates.start
        found.append(start[1:] > start[:-1])
        held.append(loop.guide.held.clone())
    for step in (3, 5, 6, 7):  # after these no block begins
        assert torch.equal(held[step - 1], held[step - 2])
        assert not (found[step - 1] & held[step - 1]).any()
    for step in (2, 4, 8):
        assert torch.equal(held[step - 1], ~found[step - 1])
    assert found[8].any() and held[8].any()
