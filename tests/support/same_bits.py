"""Renders that must be equal to the bit."""

from __future__ import annotations

import numpy as np
import torch

from bokehguide.train import RenderLoop


def assert_same_bits(one: RenderLoop, other: RenderLoop) -> None:
    """The films of two loops and the states of their lens samplers are equal to the bit."""
    layers = other.film.layers()
    for name, layer in one.film.layers().items():
        np.testing.assert_array_equal(layer, layers[name], err_msg=name)
    state = other.mode.lens.state_dict()
    for name, value in one.mode.lens.state_dict().items():
        assert torch.equal(value, state[name]), name
