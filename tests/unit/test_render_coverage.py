"""Coverage of objects: against sums in a dictionary, with more objects than slots, and of the mean of two pictures."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bokehguide.render.coverage import SLOTS, Coverage, Covered
from bokehguide.render.features import ControlVariateFeatures, MeanFeatures, RatioFeatures
from bokehguide.runtime import native

PIXELS, STEPS = 50, 40
OBJECTS = torch.tensor([1, 1, 2, 3, 3, 3, 4, 5, 6, 7, 8, 9, 10], dtype=torch.int32)
"""Objects of 13 triangles."""
ESTIMATORS = (MeanFeatures, RatioFeatures, ControlVariateFeatures)


@pytest.fixture(autouse=True, params=["native", "PyTorch"])
def form(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Each test runs with both forms of the sums."""
    if request.param == "PyTorch":
        monkeypatch.setattr(native, "core", lambda: None)
    elif native.core() is None:
        pytest.skip("the native core is not built")
    return request.param


def draws(triangles: int, seed: int = 3) -> list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Triangles of STEPS samples of each pixel, one in ten a miss; their weights of mean 1; and whether they are kept."""
    random = np.random.default_rng(seed)
    steps = []
    for _ in range(STEPS):
        triangle = np.where(random.random(PIXELS) < 0.1, -1, random.integers(0, triangles, PIXELS)).astype(np.int32)
        weight, kept = random.exponential(size=PIXELS), random.random(PIXELS) < 0.95
        steps.append(tuple(torch.from_numpy(x) for x in (triangle, weight.astype(np.float32), kept.astype(np.float32))))
    return steps


def covered(features: type[MeanFeatures], steps, batches: int = 1) -> list[dict[int, float]]:
    """Coverage by object of each pixel, after all steps in batches of pixels."""
    coverage, count = Coverage(OBJECTS, PIXELS, features), torch.zeros(PIXELS)
    for triangle, weight, kept in steps:
        for part in torch.arange(PIXELS).chunk(batches):
            coverage.add(part, triangle[part], weight[part], kept[part], True)
        count += kept
    found = coverage.covered(count)
    return [as_dictionary(found.numbers[:, pixel], found.share[:, pixel]) for pixel in range(PIXELS)]


def as_dictionary(numbers: torch.Tensor, shares: torch.Tensor) -> dict[int, float]:
    pairs = [(number, share) for number, share in zip(numbers.tolist(), shares.tolist()) if number > 0]
    assert len(dict(pairs)) == len(pairs)  # no object twice
    return dict(pairs)


def expected(features: type[MeanFeatures], steps, pixel: int) -> dict[int, float]:
    """The same from the samples of one pixel in a list: each object by itself."""
    seen = [0 if triangle[pixel] < 0 else int(OBJECTS[triangle[pixel]]) for triangle, _, _ in steps]
    weights, kept = ([float(values[index][pixel]) for values in steps] for index in (1, 2))
    shares = {}
    for number in set(seen) - {0}:
        x = [float(each == number) for each in seen]
        total, squares, moments = 0.0, 0.0, 0.0
        for value, weight, keeps in zip(x, weights, kept):
            if features is ControlVariateFeatures:
                center = moments / squares if squares else 0.0
                total += keeps * (weight * (value - center) + center)
                squares, moments = squares + weight**2, moments + weight**2 * value
            else:
                total += keeps * value * (weight if features is RatioFeatures else 1.0)
        shares[number] = total / sum(k * (w if features is RatioFeatures else 1.0) for w, k in zip(weights, kept))
    return shares


@pytest.mark.parametrize("features", ESTIMATORS)
def test_coverage_is_the_estimate_of_each_object_by_itself(features):
    steps = draws(9)  # six objects
    for pixel, found in enumerate(covered(features, steps)):
        own = expected(features, steps, pixel)
        assert found.keys() == own.keys() and len(own) > 3
        assert list(found.values()) == pytest.approx([own[number] for number in found], abs=1e-5)


@pytest.mark.parametrize("features", ESTIMATORS)
@pytest.mark.parametrize("recenter", [True, False])
def test_both_forms_are_equal_but_for_rounding(features, recenter, monkeypatch):
    """With more objects than slots, misses, and samples that do not count."""

    def sums() -> dict[str, torch.Tensor]:
        coverage = Coverage(OBJECTS, PIXELS, features)
        for number, (triangle, weight, kept) in enumerate(draws(len(OBJECTS))):
            coverage.add(slice(0, PIXELS), triangle, weight, kept, recenter or number % 4 == 0)
        return coverage.sums()

    one = sums()
    monkeypatch.setattr(native, "core", lambda: None)
    for name, value in sums().items():
        assert bool(value.any())
        torch.testing.assert_close(one[name], value, rtol=1e-6, atol=1e-6, msg=lambda text, name=name: f"{name}: {text}")


@pytest.mark.parametrize("features", ESTIMATORS)
def test_batches_change_no_bit(features):
    steps = draws(len(OBJECTS))
    assert covered(features, steps) == covered(features, steps, batches=7)


def test_more_objects_than_slots_keep_the_largest():
    """Objects 1 and 3 have most of the samples among ten objects; the others replace each other."""
    random = np.random.default_rng(5)
    probability = np.where(np.isin(OBJECTS, (1, 3)), 0.15, 0.25 / 8)
    triangles = random.choice(len(OBJECTS), (400, PIXELS), p=probability / probability.sum()).astype(np.int32)
    ones = torch.ones(PIXELS)
    coverage = Coverage(OBJECTS, PIXELS, MeanFeatures)
    for triangle in triangles:
        coverage.add(slice(0, PIXELS), torch.from_numpy(triangle), ones, ones, True)
    found = coverage.covered(400.0 * ones)
    assert int((found.numbers > 0).sum(0).min()) == SLOTS < len(OBJECTS.unique())
    assert bool((found.share.sum(0) < 1.0).all())  # samples of replaced objects are lost
    for number in (1, 3):
        exact = torch.from_numpy(np.isin(triangles, np.flatnonzero(number == OBJECTS)).mean(0))
        torch.testing.assert_close((found.share * (found.numbers == number)).sum(0), exact)
    assert {1, 3} == set(found.ranked(2).numbers.unique().tolist())


def test_samples_outside_the_picture_take_no_slot():
    """Each object of the full slots has one sample in the picture. A ninth object, outside the picture, replaces none of them."""
    coverage, ones = Coverage(OBJECTS, PIXELS, MeanFeatures), torch.ones(PIXELS)
    for triangle in (0, 2, 3, 6, 7, 8, 9, 10):
        coverage.add(slice(0, PIXELS), (triangle * ones).int(), ones, ones, True)
    coverage.add(slice(0, PIXELS), (11.0 * ones).int(), ones, 0.0 * ones, True)
    found = coverage.covered(8.0 * ones)
    assert set(found.numbers.unique().tolist()) == set(range(1, 9))
    assert bool((found.share == 0.125).all())


def test_ranks_are_sorted_clipped_and_sum_to_one_at_most():
    numbers = torch.tensor([[4, 1, 7], [2, 5, 0], [3, 3, 0], [9, 2, 0]], dtype=torch.int32)
    share = torch.tensor([[0.25, -0.5, 0.0], [0.5, 1.5, 0.0], [0.25, 0.5, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    found = Covered(numbers, share).ranked(3)
    assert found.numbers.tolist() == [[2, 5, 0], [3, 3, 0], [4, 0, 0]]
    assert found.share.tolist() == [[0.5, 0.75, 0.0], [0.25, 0.25, 0.0], [0.25, 0.0, 0.0]]


def test_the_mean_of_two_pictures_has_the_objects_of_both():
    one = Covered(torch.tensor([[1, 2], [3, 0]], dtype=torch.int32), torch.tensor([[0.5, 1.0], [0.25, 0.0]], dtype=torch.float64))
    two = Covered(torch.tensor([[3, 2], [4, 1]], dtype=torch.int32), torch.tensor([[0.5, 0.5], [0.5, 0.25]], dtype=torch.float64))
    mean = one.mean(two)
    assert as_dictionary(mean.numbers[:, 0], mean.share[:, 0]) == {1: 0.25, 3: 0.375, 4: 0.25}
    assert as_dictionary(mean.numbers[:, 1], mean.share[:, 1]) == {2: 0.75, 1: 0.125}
    assert not mean.share[mean.numbers == 0].any()  # it would take a rank


def test_a_state_with_an_unknown_object_is_refused():
    coverage = Coverage(OBJECTS, 2, MeanFeatures)
    coverage.sums()["objects"][0, 1] = 11
    with pytest.raises(ValueError, match="an object that the scene has not"):
        coverage.check(coverage.sums()["objects"])
