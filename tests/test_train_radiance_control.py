"""Weights as a control variate: how much of the radiance they explain, learnt block by block, without a trace in the mean."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.ndimage import median_filter
from torch import Tensor

from bokehguide.render.vector import luminance
from bokehguide.scene.types import Aperture, Scene
from bokehguide.train import RenderLoop, RenderSettings
from bokehguide.train.radiance_control import CELL, DOUBT, EVENEST, RadianceControl
from bokehguide.train.ranks import Ranks
from tests.sharing_cases import FLOOR, LAMP, loop_of, shown, terrace
from tests.statistical import SIGNIFICANCE, z_test
from tests.tracing import rectangle

WIDTH, HEIGHT = 14, 11
PIXELS = WIDTH * HEIGHT
COLOR = np.array([0.2126, 0.7152, 0.0722])
BRIGHT = torch.full((3, PIXELS), 1e6)
"""A picture that bounds no slope."""


def control_of(ranks: Ranks | None = None) -> RadianceControl:
    return RadianceControl(WIDTH, HEIGHT, torch.device("cpu"), ranks)


def samples(steps: int, seed: int = 0) -> list[tuple[Tensor, Tensor]]:
    """Radiance `[3, N]` and weights `[N]` of steps of a film whose columns' radiance follows the weights more or less."""
    generator = np.random.default_rng(seed)
    found = []
    for _ in range(steps):
        weight = generator.gamma(4.0, 0.25, PIXELS)
        follows = (np.arange(PIXELS) % WIDTH) / WIDTH
        level = follows * weight + (1.0 - follows) * generator.exponential(1.0, PIXELS)
        color = np.array([[1.0], [0.6], [0.3]]) * (1.0 + np.arange(PIXELS) // WIDTH)
        found.append((torch.from_numpy(color * level).float(), torch.from_numpy(weight).float()))
    return found


def expected_slopes(found: list[tuple[Tensor, Tensor]]) -> np.ndarray:
    """Least squares of the luminance by the weight, cell by cell, times the trust in it: the median of cells around, in the
    cell's mean colour, `[3, N]`."""
    radiance = np.stack([part.double().numpy() for part, _ in found])
    weight = np.stack([part.double().numpy() for _, part in found])
    x, y = np.arange(PIXELS) % WIDTH // CELL, np.arange(PIXELS) // WIDTH // CELL
    slopes, colors = np.zeros((y[-1] + 1, x[-1] + 1)), np.zeros((3, PIXELS))
    for cell in set(zip(x.tolist(), y.tolist())):
        mine = (x == cell[0]) & (y == cell[1])
        light, w = (COLOR @ radiance[:, :, mine].transpose(1, 0, 2).reshape(3, -1)), weight[:, mine].ravel()
        design = np.stack((np.ones_like(w), w), axis=1)
        (_, slope), residuals = np.linalg.lstsq(design, light, rcond=None)[:2]
        squared_error = float(residuals[0]) / len(w) / (w.var() * len(w))
        trust = slope**2 / (slope**2 + DOUBT * squared_error)
        color = radiance[:, :, mine].mean((0, 2))
        slopes[cell[::-1]], colors[:, mine] = slope * trust, (color / (COLOR @ color))[:, None]
    return median_filter(slopes, 3, mode="nearest")[y, x] * colors


def taught(found: list[tuple[Tensor, Tensor]], control: RadianceControl | None = None) -> RadianceControl:
    control = control_of() if control is None else control
    for radiance, weight in found:
        control.add(slice(0, PIXELS), radiance, weight)
    control.update(BRIGHT)
    return control


ALL = slice(0, PIXELS)


def test_slopes_are_those_of_a_regression():
    found = samples(30)
    slopes = taught(found).slope(ALL).numpy()
    expected = expected_slopes(found)
    np.testing.assert_allclose(slopes, expected, rtol=1e-4, atol=1e-6)
    assert 0.5 * 10.0 < slopes[0, -1] < 11.0 and np.ptp(slopes[0]) > 5.0


def test_no_slope_is_larger_than_what_the_pixel_saw():
    """In any channel; negative means of what was seen count for none."""
    found = samples(30)
    control = taught(found)
    free = control.slope(ALL)
    picture = torch.linspace(-1.0, 3.0, 3 * PIXELS).reshape(3, PIXELS)
    control.update(picture)
    most = picture.clamp(min=0.0)
    assert torch.equal(control.slope(ALL), free.clamp(-most, most))
    assert bool((control.slope(ALL) < free).any()) and bool((control.slope(ALL) == free).any())


def test_few_samples_are_hardly_trusted():
    """What two steps show of a radiance that has nothing to do with the weights counts for less than a regression has it."""
    column = slice(0, CELL)
    assert np.abs(taught(samples(2, 3)).slope(column).numpy()).max() < 0.15
    trusted = taught(samples(400, 3)).slope(slice(WIDTH - 2, WIDTH)).numpy()
    assert (trusted > 0.7 * np.array([[1.0], [0.6], [0.3]]) * 12 / WIDTH).all()


def test_all_blocks_so_far_count_and_none_before_it_has_ended():
    found, control = samples(12), control_of()
    assert not control.slope(ALL).any()
    for number, (radiance, weight) in enumerate(found):
        before = control.slope(ALL).clone()
        control.add(ALL, radiance, weight)
        assert torch.equal(control.slope(ALL), before)
        if number in (3, 11):
            control.update(BRIGHT)
            np.testing.assert_allclose(control.slope(ALL).numpy(), expected_slopes(found[: number + 1]), rtol=1e-4, atol=1e-6)


def test_pixels_may_come_in_parts():
    found, parts = samples(5), control_of()
    few = torch.rand(PIXELS, generator=torch.Generator().manual_seed(1)) < 0.5
    for radiance, weight in found:
        for part in (few, ~few):
            places = part.nonzero()[:, 0]
            parts.add(places, radiance[:, places], weight[places])
    parts.update(BRIGHT)
    whole = taught(found)
    torch.testing.assert_close(parts.slope(ALL), whole.slope(ALL), rtol=1e-5, atol=1e-8)
    places = few.nonzero()[:, 0]
    assert torch.equal(whole.slope(places), whole.slope(ALL)[:, places])


@pytest.mark.parametrize("light", [0.0, 2.0])
def test_radiance_that_is_even_has_no_slope(light):
    found = [(torch.full((3, PIXELS), light), weight) for _, weight in samples(10)]
    assert float(taught(found).slope(ALL).abs().max()) <= 1e-6


def test_weights_that_are_even_have_hardly_any():
    """There is nothing to control, and rounding must not be taken for something."""
    found = [(radiance, 1.0 + 1e-6 * weight) for radiance, weight in samples(10)]
    control = taught(found)
    assert bool(control.slope(ALL).isfinite().all())
    assert float(control.slope(ALL).abs().max()) < 1e-6 / EVENEST
    assert not taught([(radiance, torch.ones(PIXELS)) for radiance, _ in found]).slope(ALL).abs().gt(1e-6).any()


def test_samples_that_are_not_finite_count_for_none():
    found = samples(8)
    spoilt, left = control_of(), control_of()
    bad = torch.zeros(PIXELS, dtype=torch.bool)
    bad[torch.arange(0, PIXELS, 7)] = True
    good = (~bad).nonzero()[:, 0]
    for number, (radiance, weight) in enumerate(found):
        left.add(good, radiance[:, good], weight[good])
        radiance, weight = radiance.clone(), weight.clone()
        if number % 4 == 3:
            weight[bad] = math.nan if number == 3 else math.inf
        else:
            radiance[number % 3, bad] = (math.nan, math.inf, -math.inf, 3e38)[number % 4]
        spoilt.add(ALL, radiance, weight)
    assert torch.equal(spoilt.sums, left.sums) and bool(left.sums.any())


class OneOfTwo(Ranks):
    """One of two ranks in one process: what the other one has is told beforehand."""

    def __init__(self, other: Tensor | None = None):
        super().__init__()
        self.count, self.other = 2, other

    def total(self, values: Tensor) -> Tensor:
        return values + self.other if values.shape == self.other.shape else values


def test_two_ranks_know_what_one_alone_would():
    """Each has added up its own bands; after a second block no sample counts twice."""
    found = samples(6)
    halves = [torch.arange(0, 8 * WIDTH), torch.arange(8 * WIDTH, PIXELS)]
    ranks = [OneOfTwo(), OneOfTwo()]
    controls = [control_of(rank) for rank in ranks]
    alone = control_of()
    for number, (radiance, weight) in enumerate(found):
        alone.add(ALL, radiance, weight)
        for control, mine in zip(controls, halves):
            control.add(mine, radiance[:, mine], weight[mine])
        if number in (1, 5):
            for rank, other in zip(ranks, reversed(controls)):
                rank.other = other.mine.clone()
            for control in (*controls, alone):
                control.update(BRIGHT)
            for control in controls:
                torch.testing.assert_close(control.sums, alone.sums, rtol=1e-12, atol=1e-12)
                torch.testing.assert_close(control.slopes, alone.slopes, rtol=1e-6, atol=1e-9)


def test_state_dicts_hold_what_was_learnt():
    found = samples(6)
    learnt, other = taught(found[:3]), control_of()
    learnt.add(ALL, *found[3])
    other.load_state_dict(learnt.state_dict())
    assert torch.equal(other.slope(ALL), learnt.slope(ALL))
    for control in (learnt, other):
        control.add(ALL, *found[4])
        control.update(BRIGHT)
    assert torch.equal(other.slope(ALL), learnt.slope(ALL))


def bright_and_even() -> Scene:
    """An even wall out of focus, and a small lamp before it to which lens points are guided: all noise is in the weights."""
    meshes = [rectangle(0, (0.0, 0.2, -4.0), scale=9.0), rectangle(1, (0.1, 0.3, -2.6), scale=0.1)]
    wall = replace(FLOOR, base_color=(0.0, 0.0, 0.0), specular=0.0, emission=(1.0, 0.8, 0.6))
    return shown(meshes, (wall, LAMP), 24, 16, sky=False)


def without(loop: RenderLoop) -> None:
    loop.control = None


def by_the_same_block(loop: RenderLoop) -> None:
    """Slopes of the step's own samples alone, and as large as a regression has them."""
    control = loop.control
    add = control.add

    def added(places, radiance: Tensor, weight: Tensor) -> None:
        add(places, radiance, weight)
        light, cells = luminance(radiance).double(), control._cells(places)
        for cell in cells.unique():
            mine = cells == cell
            w, v = weight[mine].double(), light[mine]
            slope = ((w - w.mean()) * (v - v.mean())).sum() / ((w - w.mean()).square().sum()).clamp(min=1e-9)
            control.slopes[:, cell] = slope

    control.add = added


@lru_cache
def renders(change=None, count: int = 30, steps: int = 5) -> np.ndarray:
    """Pictures of some seeds, `[count, 3, H, W]`."""
    found = []
    for seed in range(count):
        loop = loop_of(bright_and_even(), seed)
        if change is not None:
            change(loop)
        for _ in range(steps):
            loop.step()
        found.append(loop.film.radiance().permute(2, 0, 1).double().numpy())
    return np.stack(found)


def agree(one: np.ndarray, other: np.ndarray) -> float:
    """p-value of means by column being the same, of pictures of the same seeds."""
    difference = (one - other).mean(2).reshape(len(one), -1)
    t = difference.mean(0) / (difference.std(0, ddof=1) / math.sqrt(len(one))).clip(1e-7)
    z = stats.norm.isf(stats.t.sf(np.abs(t), len(one) - 1))
    return z_test(z, np.ones_like(z))


def test_the_controlled_picture_has_the_mean_of_the_uncontrolled():
    controlled, plain = renders(), renders(without)
    assert not np.array_equal(controlled, plain)
    assert agree(controlled, plain) > SIGNIFICANCE


def test_what_is_even_comes_out_as_it_is():
    """Where the lamp is out of sight, on average, and with 1% more or less than one for the weights' mean no longer."""
    difference = renders()[:, :, :, :8].mean((2, 3)) - np.array([1.0, 0.8, 0.6])
    error = difference.std(0, ddof=1) / math.sqrt(len(difference))
    assert z_test(difference.mean(0), error) > SIGNIFICANCE
    assert (error < 0.001).all()


def test_slopes_of_the_same_block_would_show():
    assert agree(renders(by_the_same_block), renders(without)) < SIGNIFICANCE


def test_it_pays():
    """Where what is seen is even."""
    controlled, plain = renders()[:, :, :, :8], renders(without)[:, :, :, :8]
    assert controlled.var(0).mean() < 0.7 * plain.var(0).mean()


def test_vignetted_lenses_and_other_modes_have_none():
    """Mean weights of the former are less than 1 away from the middle."""
    scene = terrace(12, 10)
    assert loop_of(scene).control is not None
    for aperture, has in ((Aperture(blades=5, edge=0.5), True), (Aperture(cat_eye=0.5), False)):
        loop = loop_of(replace(scene, camera=replace(scene.camera, aperture=aperture)))
        assert loop.sharing is not None and (loop.control is not None) == has
        loop.step()
    for mode in ("uniform", "lis-o"):
        other = RenderLoop(scene, RenderSettings(mode, threads=1))
        assert other.control is None and other.sharing is None


def test_it_learns_at_the_ends_of_blocks_only():
    loop, seen = loop_of(terrace(12, 10)), []
    for _ in range(9):
        loop.step()
        seen.append(loop.control.slopes.clone())
    changed = [not torch.equal(one, other) for one, other in zip([torch.zeros_like(seen[0]), *seen], seen)]
    assert [step for step, new in enumerate(changed, 1) if new] == [1, 2, 4, 8]
