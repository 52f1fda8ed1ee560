"""Renders that must be equal to the bit."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from bokehguide.train import RenderLoop


def assert_same_layers(found: Mapping[str, np.ndarray], expected: Mapping[str, np.ndarray]) -> None:
    """The arrays of `expected` are in `found`, equal to the bit."""
    for name, layer in expected.items():
        np.testing.assert_array_equal(found[name], layer, err_msg=name)


def assert_same_bits(one: RenderLoop, other: RenderLoop) -> None:
    """The films of two loops and the states of their lens samplers are equal to the bit."""
    assert_same_layers(other.film.layers(), one.film.layers())
    state = other.mode.lens.state_dict()
    for name, value in one.mode.lens.state_dict().items():
        assert torch.equal(value, state[name]), name
