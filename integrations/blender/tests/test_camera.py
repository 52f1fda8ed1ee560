"""Framing, focus, aperture and passes agree with Cycles."""

from __future__ import annotations

import math

import bpy
import numpy as np
import pytest
import scenes

FRAMINGS = {
    "landscape": ((96, 64), {}),
    "portrait": ((60, 100), {}),
    "portrait horizontal": ((60, 100), {"sensor_fit": "HORIZONTAL", "sensor_width": 24.0}),
    "landscape vertical": ((96, 64), {"sensor_fit": "VERTICAL", "sensor_width": 30.0, "sensor_height": 20.0}),
    "portrait vertical": ((60, 100), {"sensor_fit": "VERTICAL", "sensor_height": 30.0}),
    "shift": ((96, 64), {"shift_x": 0.2, "shift_y": -0.1}),
    "portrait shift": ((60, 100), {"shift_x": -0.15, "shift_y": 0.05}),
    "long lens": ((96, 64), {"lens": 135.0}),
}


def cubes():
    """Cubes at several places, before a transparent background."""
    scenes.transparent()
    scenes.world((1.0, 1.0, 1.0))
    for x, z, size in ((-1.2, 0.4, 0.5), (0.1, -0.5, 0.7), (0.9, 0.8, 0.3), (0.2, 0.2, 0.2)):
        scenes.mesh("cube", size=size, location=(x, 0.5 * x, z))


@pytest.mark.parametrize("name", FRAMINGS)
def test_framing(scene, tmp_path, name):
    size, options = FRAMINGS[name]
    cubes()
    scenes.camera((0.5, -6, 1.5), **({"lens": 60.0} | options))
    cycles, ours = scenes.both(tmp_path, size=size, samples=64)
    assert cycles.shape == ours.shape
    assert 0.02 < cycles[..., 3].mean() < 0.9
    assert np.abs(ours[..., 3] - cycles[..., 3]).mean() < 0.004


def test_border_and_percentage(scene, tmp_path):
    cubes()
    scenes.camera((0.5, -6, 1.5), lens=60.0)
    scene.render.use_border, scene.render.resolution_percentage = True, 150
    scene.render.border_min_x, scene.render.border_max_x = 0.21, 0.77
    scene.render.border_min_y, scene.render.border_max_y = 0.33, 0.9
    for crop in (False, True):
        scene.render.use_crop_to_border = crop
        cycles, ours = scenes.both(tmp_path, samples=64)
        assert cycles.shape == ours.shape
        assert cycles[..., 3].max() == 1.0
        assert np.abs(ours[..., 3] - cycles[..., 3]).mean() < 0.004


def defocused(**options):
    """A small emissive sphere behind the focal plane."""
    scenes.transparent()
    scenes.mesh("ico_sphere", scenes.material(emission=400.0), subdivisions=4, radius=0.04, location=(0.15, 5.0, 0.1))
    scenes.camera((0, 0, 0), (0, 1, 0), **({"use_dof": True, "focus_distance": 1.5, "aperture_fstop": 0.15} | options))


DISCS = {
    "distance": {},
    "f-stop": {"aperture_fstop": 0.3},
    "before focus": {"focus_distance": 40.0, "aperture_fstop": 0.1},
    "portrait": {"size": (100, 150)},
    "vertical": {"sensor_fit": "VERTICAL", "sensor_height": 20.0, "aperture_fstop": 0.25},
}


@pytest.mark.parametrize("name", DISCS)
def test_disc(scene, tmp_path, name):
    options = dict(DISCS[name])
    size = options.pop("size", (150, 100))
    defocused(**options)
    cycles, ours = scenes.both(tmp_path, size=size, samples=1024)
    (across, middle), (our_across, our_middle) = scenes.disc(cycles[..., 1]), scenes.disc(ours[..., 1])
    print("diameters", across, our_across, "middles", middle, our_middle)
    assert across > 15.0
    assert our_across == pytest.approx(across, rel=0.01)
    np.testing.assert_allclose(our_middle, middle, atol=0.3)
    assert ours[..., 1].sum() == pytest.approx(cycles[..., 1].sum(), rel=0.02)


def test_focus_object(scene, tmp_path):
    target = bpy.data.objects.new("target", None)
    scene.collection.objects.link(target)
    target.location = (1.0, 1.5, 0.3)
    defocused(focus_object=target, focus_distance=4.0)
    (across, _), (our_across, _) = (scenes.disc(each[..., 1]) for each in scenes.both(tmp_path, size=(150, 100), samples=1024))
    assert our_across == pytest.approx(across, rel=0.01)


OPENINGS = {
    "blades": {"aperture_blades": 3},
    "rotation": {"aperture_blades": 3, "aperture_rotation": 0.4},
    "ratio": {"aperture_ratio": 1.7},
    "all": {"aperture_blades": 5, "aperture_rotation": 0.2, "aperture_ratio": 1.4},
    "wide": {"aperture_blades": 5, "aperture_rotation": 1.0, "aperture_ratio": 0.6},
    "two blades": {"aperture_blades": 2},
}


@pytest.mark.parametrize("name", OPENINGS)
def test_opening(scene, tmp_path, name):
    defocused(**OPENINGS[name])
    cycles, ours = (scenes.blurred(each[..., 1]) for each in scenes.both(tmp_path, size=(120, 80), samples=1024))
    difference = np.abs(cycles - ours).sum()
    print("difference", difference)
    assert difference < 0.12
    if name in ("blades", "rotation"):
        assert np.abs(cycles[::-1, ::-1] - ours).sum() > 0.3


def test_passes(scene, tmp_path):
    cubes()
    scenes.camera((0.5, -6, 1.5), lens=60.0)
    layer = scene.view_layers[0]
    layer.use_pass_z = layer.use_pass_normal = scene.bokehguide.use_pass_albedo = True
    cycles, ours = (scenes.render(engine, tmp_path, samples=64) for engine in ("CYCLES", "BOKEHGUIDE"))
    inside = (cycles["Combined.A"] == 1.0) & (ours["Combined.A"] == 1.0)
    assert inside.sum() > 300
    np.testing.assert_allclose(ours["Depth.Z"][inside], cycles["Depth.Z"][inside], rtol=0.02)
    for axis in "XYZ":
        assert np.abs(ours[f"Normal.{axis}"] - cycles[f"Normal.{axis}"])[inside].mean() < 0.02
    assert ours["Albedo.R"][inside].mean() == pytest.approx(0.5, abs=0.01)


def test_denoise_and_time_limit(scene, tmp_path):
    cubes()
    scenes.camera((0.5, -6, 1.5), lens=60.0)
    noisy = scenes.colors(scenes.render("BOKEHGUIDE", tmp_path, samples=4))
    scene.bokehguide.use_denoise, scene.bokehguide.time_limit = True, 0.001
    smooth = scenes.colors(scenes.render("BOKEHGUIDE", tmp_path, samples=64))
    assert not np.array_equal(noisy, smooth)
    assert smooth.mean() == pytest.approx(noisy.mean(), rel=0.1)
    assert math.isfinite(smooth.sum())
