"""Small scenes and comparisons for tests of the integrator in Mitsuba."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from scipy.stats import t

from tests.support.statistical import SIGNIFICANCE, sidak

PATH = {"type": "path", "max_depth": 4}


def lamps(width: int = 32, height: int = 18, sensor: dict[str, Any] | None = None, **film: Any) -> dict[str, Any]:
    """A ground and a ball in focus, three far lamps (a sphere, a rectangle, a mesh), and a dim sky."""
    transform = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}, "pixel_format": "rgb"} | film
    lens = {
        "type": "thinlens",
        "fov": 40.0,
        "aperture_radius": 0.15,
        "focus_distance": 3.0,
        "to_world": transform.look_at([0.0, 0.6, 3.0], [0.0, 0.3, 0.0], [0.0, 1.0, 0.0]),
        "film": film,
    }
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": [400.0, 300.0, 200.0]}}
    return {
        "type": "scene",
        "sensor": lens | (sensor or {}),
        "ground": {"type": "rectangle", "to_world": transform.rotate([1, 0, 0], -90).scale(20)},
        "ball": {"type": "sphere", "center": [0.0, 0.3, 0.0], "radius": 0.3, "bsdf": {"type": "plastic"}},
        "round": {"type": "sphere", "center": [-1.2, 1.2, -5.0], "radius": 0.04, "emitter": lamp},
        "square": {
            "type": "rectangle",
            "to_world": transform.translate([1.5, 1.5, -6.0]).scale(0.05),
            "emitter": lamp,
        },
        "cube": {"type": "cube", "to_world": transform.translate([0.2, 1.9, -7.0]).scale(0.04), "emitter": lamp},
        "sky": {"type": "constant", "radiance": 0.2},
    }


def blocks(picture: Any, size: int = 2) -> np.ndarray:
    """Means of squares of `size` pixels of the luminance, flattened."""
    values = np.array(picture, np.float64)[..., :3].mean(axis=2)
    height, width = (side // size * size for side in values.shape)
    return values[:height, :width].reshape(height // size, size, width // size, size).mean(axis=(1, 3)).ravel()


def guided(mode: str = "guided", nested: dict = PATH) -> mi.Integrator:
    """The integrator of this package."""
    return mi.load_dict({"type": "guided_thinlens", "mode": mode, "nested": nested})


def runs(scene: mi.Scene, integrator: mi.Integrator, spp: int, count: int = 8, seed: int = 0) -> np.ndarray:
    """Block means of independent renders, `[count, blocks]`."""
    return np.stack([blocks(mi.render(scene, integrator=integrator, spp=spp, seed=seed + number)) for number in range(count)])


def agree(ours: np.ndarray, theirs: np.ndarray) -> bool:
    """Whether the means of two sets of runs `[runs, ...]` agree, up to rounding."""
    rounding = 1e-4 * np.abs(theirs).max(axis=0) + 1e-9
    error = np.sqrt(ours.var(axis=0, ddof=1) / len(ours) + theirs.var(axis=0, ddof=1) / len(theirs) + rounding**2)
    found = np.abs(ours.mean(axis=0) - theirs.mean(axis=0)) / error
    return sidak(2.0 * t.sf(found, min(len(ours), len(theirs)) - 1)) > SIGNIFICANCE
