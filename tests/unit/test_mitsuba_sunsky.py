"""The emitter `sunsky`: radiance of the sky and irradiance of the sun are Mitsuba's."""

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

from bokehguide.errors import BokehguideError
from bokehguide.scene import load_scene

MITSUBA_VARIANT = "scalar_rgb"
BODY = (
    '<scene version="3.0.0"><sensor type="perspective"><float name="fov" value="40"/></sensor><shape type="sphere"/>'
    '<emitter type="sunsky" id="day">{}'
    '<transform name="to_world"><rotate x="1" angle="-90"/></transform></emitter></scene>'
)
MORNING = (
    '<vector name="sun_direction" value="0.8 0.36 -0.48"/><float name="turbidity" value="4"/>'
    '<float name="sky_scale" value="3"/><float name="sun_scale" value="{}"/><float name="sun_aperture" value="2"/>'
)


def read(folder, values: str):
    path = folder / "scene.xml"
    path.write_text(BODY.format(values))
    return load_scene(str(path))


def test_the_sky_is_mitsubas(tmp_path):
    scene = read(tmp_path, MORNING.format(0))
    assert scene.suns == () and scene.warnings == ()
    (sky,) = mi.load_file(str(tmp_path / "scene.xml")).emitters()
    at, radiance = mi.SurfaceInteraction3f(), scene.environment.radiance
    height, width = radiance.shape[:2]
    for direction in ((0.0, 1.0, 0.0), (0.0, 0.6, -0.8), (0.8, 0.6, 0.0), (-0.48, 0.6, 0.64), (0.0, -0.6, 0.8)):
        at.wi = mi.Vector3f(*(-x for x in direction))
        row = int(np.arccos(direction[1]) / np.pi * height)
        column = int((0.5 + np.arctan2(direction[0], -direction[2]) / (2.0 * np.pi)) * width) % width
        np.testing.assert_allclose(radiance[row, column], np.ravel(np.array(sky.eval(at))), rtol=0.05)
    assert radiance[height // 4].min() > 0.0 and not radiance[height // 2 :].any()


def test_the_sun_is_mitsubas(tmp_path):
    """The irradiance is an integral over the disc of Mitsuba's radiance with the sun minus that without the sun."""
    (sun,) = read(tmp_path, MORNING.format(5)).suns
    assert sun.angle == 2.0 and sun.direction == pytest.approx((0.8, 0.36, -0.48), abs=1e-3)
    pair = []
    for scale in (5, 0):
        read(tmp_path, MORNING.format(scale))
        pair += mi.load_file(str(tmp_path / "scene.xml")).emitters()
    centre, at, total, count = np.array((0.8, 0.36, -0.48)), mi.SurfaceInteraction3f(), np.zeros(3), 60
    side = np.cross(centre, (0.0, 1.0, 0.0))
    side /= np.linalg.norm(side)
    up, most = np.cross(centre, side), np.radians(1.0)
    for ring in (np.arange(count) + 0.5) / count:
        for turn in np.arange(16) * np.pi / 8.0:
            angle = most * np.sqrt(ring)
            where = np.cos(angle) * centre + np.sin(angle) * (np.cos(turn) * side + np.sin(turn) * up)
            at.wi = mi.Vector3f(*(-where))
            light, dark = (np.ravel(np.array(emitter.eval(at))) for emitter in pair)
            total += (light - dark) / (16 * count)
    np.testing.assert_allclose(sun.irradiance, total * np.pi * most**2, rtol=0.03)


def test_a_time_gives_the_sun(tmp_path):
    day, night = (read(tmp_path, f'<float name="hour" value="{hour}"/>') for hour in (12, 23))
    assert day.suns[0].direction[1] > 0.8 and night.suns == ()


def test_mistakes(tmp_path):
    with pytest.raises(BokehguideError, match=r"sunsky \(day\).*ranges"):
        read(tmp_path, '<float name="turbidity" value="40"/>')
    scene = read(tmp_path, '<float name="sunRadiusScale" value="4"/>')
    assert [line for line in scene.warnings if "of sunsky: left out (day)" in line]


def test_rough_diffuse_surfaces_keep_their_colour(tmp_path):
    path = tmp_path / "scene.xml"
    bsdf = '<bsdf type="roughdiffuse" id="clay"><rgb name="reflectance" value="0.1 0.2 0.3"/></bsdf>'
    path.write_text(f'<scene version="3.0.0"><sensor type="thinlens"/><shape type="sphere">{bsdf}</shape></scene>')
    scene = load_scene(str(path))
    assert scene.materials[scene.meshes[0].material].base_color == (0.1, 0.2, 0.3)
    assert "scene.xml: roughness of diffuse BSDFs: left out (clay)" in scene.warnings
