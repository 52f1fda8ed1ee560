"""Weights as a control variate: coefficients are learned epoch by epoch, and leave the mean of the radiance unchanged."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.ndimage import median_filter
from torch import Tensor

from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.control_variate import CELL, MIN_WEIGHT_VARIANCE, ControlVariate, NoControlVariate
from bokehguide.guiding.pixel_reuse import PixelReuse
from bokehguide.render.vector import luminance
from bokehguide.runtime.distributed import Ranks
from bokehguide.scene.types import Aperture, Scene
from bokehguide.train import RenderLoop, RenderSettings
from tests.support.guides import film_context
from tests.support.sharing_cases import FLOOR, LAMP, loop_of, scene_of, terrace
from tests.support.statistical import SIGNIFICANCE, z_test
from tests.support.tracing import rectangle

WIDTH, HEIGHT = 14, 11
PIXELS = WIDTH * HEIGHT
COLOR = np.array([0.2126, 0.7152, 0.0722])
BRIGHT = torch.full((3, PIXELS), 1e6)
"""A picture that bounds no coefficient."""
ALL = slice(0, PIXELS)


def control_variate(ranks: Ranks | None = None) -> ControlVariate:
    return ControlVariate(film_context(WIDTH, HEIGHT, ranks), GuidedConfig.control_shrinkage)


def samples(steps: int, seed: int = 0) -> list[tuple[Tensor, Tensor]]:
    """Radiance `[3, N]` and weights `[N]` of steps. The radiance follows the weights more in columns farther right."""
    generator = np.random.default_rng(seed)
    found = []
    for _ in range(steps):
        weight = generator.gamma(4.0, 0.25, PIXELS)
        follows = (np.arange(PIXELS) % WIDTH) / WIDTH
        level = follows * weight + (1.0 - follows) * generator.exponential(1.0, PIXELS)
        color = np.array([[1.0], [0.6], [0.3]]) * (1.0 + np.arange(PIXELS) // WIDTH)
        found.append((torch.from_numpy(color * level).float(), torch.from_numpy(weight).float()))
    return found


def expected_coefficients(found: list[tuple[Tensor, Tensor]]) -> np.ndarray:
    """Slopes of a linear regression of the luminance by the weight, cell by cell, times the trust in them, `[3, N]`.

    Of each cell and the cells around it the median, in the cell's mean colour.
    """
    radiance = np.stack([part.double().numpy() for part, _ in found])
    weight = np.stack([part.double().numpy() for _, part in found])
    x, y = np.arange(PIXELS) % WIDTH // CELL, np.arange(PIXELS) // WIDTH // CELL
    coefficients, colors = np.zeros((y[-1] + 1, x[-1] + 1)), np.zeros((3, PIXELS))
    for cell in set(zip(x.tolist(), y.tolist())):
        mine = (x == cell[0]) & (y == cell[1])
        light, w = (COLOR @ radiance[:, :, mine].transpose(1, 0, 2).reshape(3, -1)), weight[:, mine].ravel()
        design = np.stack((np.ones_like(w), w), axis=1)
        (_, coefficient), residuals = np.linalg.lstsq(design, light, rcond=None)[:2]
        squared_error = float(residuals[0]) / len(w) / (w.var() * len(w))
        trust = coefficient**2 / (coefficient**2 + GuidedConfig.control_shrinkage * squared_error)
        color = radiance[:, :, mine].mean((0, 2))
        coefficients[cell[::-1]], colors[:, mine] = coefficient * trust, (color / (COLOR @ color))[:, None]
    return median_filter(coefficients, 3, mode="nearest")[y, x] * colors


def trained(found: list[tuple[Tensor, Tensor]], control: ControlVariate | None = None) -> ControlVariate:
    control = control_variate() if control is None else control
    for radiance, weight in found:
        control.add(slice(0, PIXELS), radiance, weight)
    control.update(lambda: BRIGHT)
    return control


def test_coefficients_are_the_slopes_of_a_regression():
    found = samples(30)
    coefficients = trained(found).coefficient(ALL).numpy()
    expected = expected_coefficients(found)
    np.testing.assert_allclose(coefficients, expected, rtol=1e-4, atol=1e-6)
    assert 0.5 * 10.0 < coefficients[0, -1] < 11.0 and np.ptp(coefficients[0]) > 5.0


def test_no_coefficient_is_larger_than_the_mean_radiance_of_the_pixel():
    """In any channel; a negative mean allows none."""
    found = samples(30)
    control = trained(found)
    free = control.coefficient(ALL)
    picture = torch.linspace(-1.0, 3.0, 3 * PIXELS).reshape(3, PIXELS)
    control.update(lambda: picture)
    most = picture.clamp(min=0.0)
    assert torch.equal(control.coefficient(ALL), free.clamp(-most, most))
    assert bool((control.coefficient(ALL) < free).any()) and bool((control.coefficient(ALL) == free).any())


def test_few_samples_are_hardly_trusted():
    """A coefficient from two steps of a radiance independent of the weights is less than a regression's."""
    column = slice(0, CELL)
    assert np.abs(trained(samples(2, 3)).coefficient(column).numpy()).max() < 0.15
    trusted = trained(samples(400, 3)).coefficient(slice(WIDTH - 2, WIDTH)).numpy()
    assert (trusted > 0.7 * np.array([[1.0], [0.6], [0.3]]) * 12 / WIDTH).all()


def test_all_earlier_epochs_count_and_the_present_one_does_not():
    found, control = samples(12), control_variate()
    assert not control.coefficient(ALL).any()
    for number, (radiance, weight) in enumerate(found):
        before = control.coefficient(ALL).clone()
        control.add(ALL, radiance, weight)
        assert torch.equal(control.coefficient(ALL), before)
        if number in (3, 11):
            control.update(lambda: BRIGHT)
            np.testing.assert_allclose(
                control.coefficient(ALL).numpy(), expected_coefficients(found[: number + 1]), rtol=1e-4, atol=1e-6
            )


def test_pixels_may_be_added_in_parts():
    found, parts = samples(5), control_variate()
    few = torch.rand(PIXELS, generator=torch.Generator().manual_seed(1)) < 0.5
    for radiance, weight in found:
        for part in (few, ~few):
            places = part.nonzero()[:, 0]
            parts.add(places, radiance[:, places], weight[places])
    parts.update(lambda: BRIGHT)
    whole = trained(found)
    torch.testing.assert_close(parts.coefficient(ALL), whole.coefficient(ALL), rtol=1e-5, atol=1e-8)
    places = few.nonzero()[:, 0]
    assert torch.equal(whole.coefficient(places), whole.coefficient(ALL)[:, places])


@pytest.mark.parametrize("light", [0.0, 2.0])
def test_even_radiance_has_no_coefficient(light):
    found = [(torch.full((3, PIXELS), light), weight) for _, weight in samples(10)]
    assert float(trained(found).coefficient(ALL).abs().max()) <= 1e-6


def test_even_weights_have_hardly_any_coefficient():
    """Their variance is rounding error."""
    found = [(radiance, 1.0 + 1e-6 * weight) for radiance, weight in samples(10)]
    control = trained(found)
    assert bool(control.coefficient(ALL).isfinite().all())
    assert float(control.coefficient(ALL).abs().max()) < 1e-6 / MIN_WEIGHT_VARIANCE
    assert not trained([(radiance, torch.ones(PIXELS)) for radiance, _ in found]).coefficient(ALL).abs().gt(1e-6).any()


def test_samples_that_are_not_finite_do_not_count():
    found = samples(8)
    spoilt, left = control_variate(), control_variate()
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
    """One of two ranks in one process. other: the sums of the other rank."""

    def __init__(self, other: Tensor | None = None):
        super().__init__()
        self.count, self.other = 2, other

    def total(self, values: Tensor) -> Tensor:
        return values + self.other if values.shape == self.other.shape else values


def test_two_ranks_learn_as_one_does():
    """Each adds up its own bands; after a second epoch no sample counts twice."""
    found = samples(6)
    halves = [torch.arange(0, 8 * WIDTH), torch.arange(8 * WIDTH, PIXELS)]
    ranks = [OneOfTwo(), OneOfTwo()]
    controls = [control_variate(rank) for rank in ranks]
    alone = control_variate()
    for number, (radiance, weight) in enumerate(found):
        alone.add(ALL, radiance, weight)
        for control, mine in zip(controls, halves):
            control.add(mine, radiance[:, mine], weight[mine])
        if number in (1, 5):
            for rank, other in zip(ranks, reversed(controls)):
                rank.other = other.mine.clone()
            for control in (*controls, alone):
                control.update(lambda: BRIGHT)
            for control in controls:
                torch.testing.assert_close(control.sums, alone.sums, rtol=1e-12, atol=1e-12)
                torch.testing.assert_close(control.coefficients, alone.coefficients, rtol=1e-6, atol=1e-9)


def test_state_dicts_hold_the_coefficients():
    found = samples(6)
    saved, other = trained(found[:3]), control_variate()
    saved.add(ALL, *found[3])
    other.load_state_dict(saved.state_dict())
    assert torch.equal(other.coefficient(ALL), saved.coefficient(ALL))
    for control in (saved, other):
        control.add(ALL, *found[4])
        control.update(lambda: BRIGHT)
    assert torch.equal(other.coefficient(ALL), saved.coefficient(ALL))


def bright_and_even() -> Scene:
    """An even wall out of focus, and a small emitter before it to which lens points are guided: only weights are noisy."""
    meshes = [rectangle(0, (0.0, 0.2, -4.0), scale=9.0), rectangle(1, (0.1, 0.3, -2.6), scale=0.1)]
    wall = replace(FLOOR, base_color=(0.0, 0.0, 0.0), specular=0.0, emission=(1.0, 0.8, 0.6))
    return scene_of(meshes, (wall, LAMP), 24, 16, sky=False)


def from_the_same_epoch(loop: RenderLoop) -> None:
    """Give the loop coefficients from the step's own samples alone."""
    control = loop.mode.reuse.control_variate
    corrected, width = control.corrected, loop.film.width

    def corrected_by_itself(places: slice, radiance: Tensor, weight: Tensor) -> Tensor:
        light, numbers = luminance(radiance).double(), torch.arange(places.start, places.stop)
        cells = numbers // width // CELL * (width // CELL) + numbers % width // CELL
        for cell in cells.unique():
            mine = cells == cell
            w, v = weight[mine].double(), light[mine]
            w, v = w - w.mean(), v - v.mean()
            control.coefficients[:, cell] = (w * v).sum() / w.square().sum().clamp(min=1e-9)
        return corrected(places, radiance, weight)

    control.corrected = corrected_by_itself


CONTROLLED, UNCONTROLLED = GuidedConfig(), GuidedConfig(control_variate=False)


@lru_cache
def renders(config: GuidedConfig, change=None, count: int = 30, steps: int = 5) -> np.ndarray:
    """Pictures of some seeds, `[count, 3, H, W]`; change: applied to each loop before its first step."""
    found = []
    for seed in range(count):
        with loop_of(bright_and_even(), seed, config=config) as loop:
            if change is not None:
                change(loop)
            for _ in range(steps):
                loop.step()
        found.append(loop.film.radiance().permute(2, 0, 1).double().numpy())
    return np.stack(found)


def agree(one: np.ndarray, other: np.ndarray) -> float:
    """p-value of equal means by column, from pictures of the same seeds."""
    difference = (one - other).mean(2).reshape(len(one), -1)
    t = difference.mean(0) / (difference.std(0, ddof=1) / math.sqrt(len(one))).clip(1e-7)
    z = stats.norm.isf(stats.t.sf(np.abs(t), len(one) - 1))
    return z_test(z, np.ones_like(z))


@pytest.mark.slow
def test_the_controlled_picture_has_the_mean_of_the_uncontrolled():
    controlled, plain = renders(CONTROLLED), renders(UNCONTROLLED)
    assert not np.array_equal(controlled, plain)
    assert agree(controlled, plain) > SIGNIFICANCE


@pytest.mark.slow
def test_even_radiance_keeps_its_mean():
    """Where the emitter is out of sight. The standard error is below 0.1 %."""
    difference = renders(CONTROLLED)[:, :, :, :8].mean((2, 3)) - np.array([1.0, 0.8, 0.6])
    error = difference.std(0, ddof=1) / math.sqrt(len(difference))
    assert z_test(difference.mean(0), error) > SIGNIFICANCE
    assert (error < 0.001).all()


@pytest.mark.slow
def test_coefficients_of_the_same_epoch_fail_the_test_of_means():
    assert agree(renders(CONTROLLED, from_the_same_epoch), renders(UNCONTROLLED)) < SIGNIFICANCE


@pytest.mark.slow
def test_the_variance_falls_where_the_radiance_is_even():
    controlled, plain = renders(CONTROLLED)[:, :, :, :8], renders(UNCONTROLLED)[:, :, :, :8]
    assert controlled.var(0).mean() < 0.7 * plain.var(0).mean()


def test_vignetted_lenses_and_other_modes_have_no_control_variate():
    """The mean weight of a vignetted lens is less than 1 away from the middle of the frame."""
    scene = terrace(12, 10)
    assert isinstance(loop_of(scene).mode.reuse.control_variate, ControlVariate)
    for aperture, kind in ((Aperture(blades=5, edge=0.5), ControlVariate), (Aperture(cat_eye=0.5), NoControlVariate)):
        with loop_of(replace(scene, camera=replace(scene.camera, aperture=aperture))) as loop:
            assert isinstance(loop.mode.reuse, PixelReuse) and isinstance(loop.mode.reuse.control_variate, kind)
            loop.step()
    for mode in ("uniform", "lis-o"):
        assert not isinstance(RenderLoop(scene, RenderSettings(mode, threads=1)).mode.reuse, PixelReuse)


def test_coefficients_change_at_the_ends_of_epochs_only():
    seen = []
    with loop_of(terrace(12, 10)) as loop:
        for _ in range(9):
            loop.step()
            seen.append(loop.mode.reuse.control_variate.coefficients.clone())
    changed = [not torch.equal(one, other) for one, other in pairwise([torch.zeros_like(seen[0]), *seen])]
    assert [step for step, new in enumerate(changed, 1) if new] == [1, 2, 4, 8]


@pytest.mark.parametrize("group, used", [(16, "control_shrinkage"), (1, "unshared_control_shrinkage")])
def test_groups_of_one_pixel_have_a_shrinkage_of_their_own(group, used):
    """A picture of several epochs depends on the shrinkage of its groups alone."""

    def picture(**fields) -> Tensor:
        with loop_of(terrace(12, 10), config=GuidedConfig(reuse_group=group, **fields)) as loop:
            for _ in range(6):
                loop.step()
            return loop.film.radiance()

    for name in ("control_shrinkage", "unshared_control_shrinkage"):
        assert torch.equal(picture(), picture(**{name: 1e18})) == (name != used)
