"""The scene's world for an environment map that does not stand upright, as in files of programs whose vertical is z."""

from __future__ import annotations

import numpy as np

from bokehguide.scene.mitsuba_xml.tree import Plugin

TILT = 1e-3
"""Sine of the largest tilt of a map that counts as upright."""


def scene_from_world(root: Plugin) -> np.ndarray:
    """The rotation `[4, 4]` after which the environment map stands upright; the identity for an upright map or none.

    The rotation is about a horizontal axis, along the shortest arc.
    """
    up, turn = np.array((0.0, 1.0, 0.0)), np.eye(4)
    for emitter in root.inner("emitter"):
        if emitter.type == "envmap":
            up = emitter.matrix()[:3, 1] / max(np.linalg.norm(emitter.matrix()[:3, 1]), 1e-12)
    axis = np.array((-up[2], 0.0, up[0]))  # up × y
    sine = float(np.linalg.norm(axis))
    if sine > TILT or up[1] < 0.0:
        turn[:3, :3] = _rotation(axis / sine if sine > TILT else np.array((1.0, 0.0, 0.0)), sine, up[1])
    return turn


def _rotation(axis: np.ndarray, sine: float, cosine: float) -> np.ndarray:
    """The rotation `[3, 3]` about a unit axis, by Rodrigues' formula."""
    cross = np.cross(np.eye(3), axis)  # cross @ v = axis × v
    return np.eye(3) + sine * cross + (1.0 - cosine) * cross @ cross
