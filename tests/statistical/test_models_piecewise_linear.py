"""Piecewise linear densities on circles: their integrals against plain sums, and the inverse of these."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bokehguide.models.emitters.piecewise_linear import PiecewiseLinear

PERIOD = 8
WEIGHTS = {
    "one": {3: 2.0},
    "first": {0: 1.5},
    "last": {7: 0.5, 6: 1e-3},
    "across the end": {7: 1.0, 0: 3.0},
    "with gaps": {1: 1.0, 2: 4.0, 5: 2.0, 7: 1e-6},
    "all": {position: 1.0 + position % 3 for position in range(PERIOD)},
    "none": {},
}
GROUPS = list(WEIGHTS)
BY_GROUP = pytest.mark.parametrize("name", GROUPS)


def piecewise_linear() -> PiecewiseLinear:
    entries = np.array([(number, place, weight) for number, name in enumerate(GROUPS) for place, weight in WEIGHTS[name].items()])
    group, position = entries[:, :2].T.astype(np.int64)
    return PiecewiseLinear(len(GROUPS), group, position, entries[:, 2], PERIOD, torch.device("cpu"))


def below(name: str, x: np.ndarray) -> np.ndarray:
    """Integrals `[N]` from 0 to x of the density, as sums of those of tents, turn by turn."""

    def tent(x: np.ndarray) -> np.ndarray:
        x = np.clip(x, -1.0, 1.0)
        return 0.5 + x - 0.5 * x * np.abs(x)

    tents = [
        weight * (tent(x - position - turn * PERIOD) - tent(np.zeros(1) - position - turn * PERIOD))
        for position, weight in WEIGHTS[name].items()
        for turn in range(-4, 5)
    ]
    return np.sum(tents, axis=0) if tents else np.zeros_like(x)


@BY_GROUP
def test_integrals_are_sums_of_tents(name):
    x = np.linspace(-2.0 * PERIOD, 2.0 * PERIOD, 997)
    found = piecewise_linear().integral(torch.full((len(x),), GROUPS.index(name)), torch.from_numpy(x))
    np.testing.assert_allclose(found.numpy(), below(name, x), atol=1e-12)


def test_totals_are_the_sums_of_weights():
    np.testing.assert_allclose(piecewise_linear().total.numpy(), [sum(weights.values()) for weights in WEIGHTS.values()])


@pytest.mark.parametrize("name", GROUPS[:-1])
def test_places_have_what_was_asked_for_below_them(name):
    density = piecewise_linear()
    group = torch.full((1001,), GROUPS.index(name))
    asked = torch.linspace(-1.3, 2.4, 1001, dtype=torch.float64) * float(density.total[group[0]])
    np.testing.assert_allclose(density.integral(group, density.inverse(group, asked)).numpy(), asked.numpy(), atol=1e-9)


@BY_GROUP
def test_knots_are_those_before_a_place(name):
    """And lead in lines to the next: between them the density is what their weights say."""
    x = torch.linspace(0.0, PERIOD - 1e-6, 499, dtype=torch.float64)
    density = piecewise_linear()
    knot, beyond = density.find(torch.full((len(x),), GROUPS.index(name)), x)
    np.testing.assert_allclose((density.position[knot] + beyond).numpy(), x.numpy())
    assert (beyond >= 0.0).all()
    near = np.array([position for place in WEIGHTS[name] for position in (place, (place - 1) % PERIOD)])
    assert (beyond.numpy()[np.isin(np.floor(x.numpy()), near)] <= 1.0).all()
