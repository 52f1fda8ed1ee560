"""Lights are as bright as in Cycles."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scenes

LIGHTS = {
    "point": {"kind": "POINT", "shadow_soft_size": 0.1},
    "large point": {"kind": "POINT", "shadow_soft_size": 0.5, "use_soft_falloff": False, "color": (1.0, 0.4, 0.1)},
    "spot": {"kind": "SPOT", "shadow_soft_size": 0.05, "spot_size": math.radians(50), "spot_blend": 0.15},
    "soft spot": {"kind": "SPOT", "shadow_soft_size": 0.05, "spot_size": math.radians(70), "spot_blend": 0.8},
    "hard spot": {"kind": "SPOT", "shadow_soft_size": 0.02, "spot_size": math.radians(50), "spot_blend": 0.0},
    "square": {"kind": "AREA", "shape": "SQUARE", "size": 0.8},
    "rectangle": {"kind": "AREA", "shape": "RECTANGLE", "size": 1.2, "size_y": 0.3},
    "disk": {"kind": "AREA", "shape": "DISK", "size": 0.8},
    "ellipse": {"kind": "AREA", "shape": "ELLIPSE", "size": 1.2, "size_y": 0.4, "color": (0.2, 0.5, 1.0)},
    "sun": {"kind": "SUN", "energy": 3.0, "angle": math.radians(5)},
    "exposure": {"kind": "POINT", "shadow_soft_size": 0.1, "exposure": -1.0},
    "temperature": {"kind": "AREA", "size": 0.5, "use_temperature": True, "temperature": 3000.0},
    "point not normalised": {"kind": "POINT", "shadow_soft_size": 0.2, "use_soft_falloff": False, "normalize": False},
    "ellipse not normalised": {"kind": "AREA", "shape": "ELLIPSE", "size": 1.2, "size_y": 0.4, "normalize": False},
    "spot not normalised": {
        "kind": "SPOT",
        "shadow_soft_size": 0.2,
        "use_soft_falloff": False,
        "normalize": False,
        "spot_size": math.radians(70),
    },
}


@pytest.mark.parametrize("name", LIGHTS)
def test_brightness(scene, tmp_path, name):
    options = dict(LIGHTS[name])
    kind = options.pop("kind")
    try:
        item = scenes.light(kind, (1.0, -0.5, 2.5), **options)
    except AttributeError:
        pytest.skip("this release of Blender lacks the setting")
    item.scale = (1.5, 0.8, 1.0) if kind == "AREA" else (1.0, 1.0, 1.0)
    scenes.mesh("plane", size=10)
    scenes.camera((0, -1.5, 1.5), lens=30)
    check(*scenes.both(tmp_path, samples=256))


def test_losses_are_told(scene, tmp_path, capfd):
    """A negative light darkens nothing, and is told; so are angles and spreads that are not those of Blender."""
    for kind, values in (
        ("POINT", {"energy": -5.0}),
        ("SUN", {"energy": -1.0}),
        ("SUN", {"energy": 1.0, "angle": math.radians(120)}),
        ("AREA", {"spread": 1.0}),
        ("AREA", {"spread": 2.0}),
        ("SPOT", {"use_square": True}),
    ):
        scenes.light(kind, **values)
    scenes.camera((0, -4, 30))
    scenes.render("BOKEHGUIDE", tmp_path, samples=1)
    said = "".join(capfd.readouterr())
    assert "lights of negative power or colour are left out: point, sun" in said
    assert "the angles of suns are limited to 0.01° … 90°: sun.001" in said
    assert "the spread of area lights is ignored; these lights shine in all directions of their front: area, area.001" in said
    assert "the square cones of spotlights become round: spot" in said


def test_lights_within_the_limits_are_not_told(scene, tmp_path, capfd):
    for angle in (0.01, 0.5, 90.0):
        scenes.light("SUN", energy=1.0, angle=math.radians(angle))
    scenes.light("POINT", energy=0.0)
    scenes.light("AREA")
    scenes.camera((0, -4, 30))
    scenes.render("BOKEHGUIDE", tmp_path, samples=1)
    said = "".join(capfd.readouterr())
    assert "are limited" not in said
    assert "left out" not in said
    assert "spread" not in said


def check(cycles, ours):
    """The means of each channel agree, and the pictures do."""
    means = ours[..., :3].mean((0, 1)) / cycles[..., :3].mean((0, 1))
    print("ratio of means", means)
    np.testing.assert_allclose(means, 1.0, atol=0.02)
    np.testing.assert_allclose(ours[..., :3].mean(1), cycles[..., :3].mean(1), rtol=0.1, atol=0.02 * cycles[..., :3].max())
