"""Directives of pbrt that change the transform of the graphics state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from bokehguide.scene.pbrt.contents import State
from bokehguide.scene.pbrt.tokens import Place, Tokens
from bokehguide.scene.pbrt.transforms import look_at, rotation, translation


def _placed(state: State, matrix: np.ndarray) -> State:
    """The state with the transform `matrix`, if transforms of this moment count."""
    return replace(state, matrix=matrix) if state.active else state


def _moved(state: State, matrix: np.ndarray) -> State:
    """The state with its transform multiplied by `matrix`."""
    return _placed(state, state.matrix @ matrix)


def _matrix(tokens: Tokens) -> np.ndarray:
    """The 16 numbers of a matrix, which pbrt lists by columns."""
    return np.reshape(tokens.numbers(16, "a transform"), (4, 4)).T


TransformDirective = Callable[[State, Tokens, Place], State]
TRANSFORMS: dict[str, TransformDirective] = {
    "Identity": lambda state, tokens, at: _placed(state, np.eye(4)),
    "Translate": lambda state, tokens, at: _moved(state, translation(*tokens.numbers(3, "Translate"))),
    "Scale": lambda state, tokens, at: _moved(state, np.diag((*tokens.numbers(3, "Scale"), 1.0))),
    "Rotate": lambda state, tokens, at: _moved(state, rotation(*tokens.numbers(4, "Rotate"))),
    "LookAt": lambda state, tokens, at: _moved(state, look_at(tokens.numbers(9, "LookAt"), at)),
    "Transform": lambda state, tokens, at: _placed(state, _matrix(tokens)),
    "ConcatTransform": lambda state, tokens, at: _moved(state, _matrix(tokens)),
}
"""The state after each directive."""
