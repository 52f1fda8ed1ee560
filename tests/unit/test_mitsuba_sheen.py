"""The sheen of Mitsuba's `principled`: the albedo and the colour are Mitsuba's, and exported sheens come back."""

from dataclasses import replace

import numpy as np
import pytest
import torch

mi = pytest.importorskip("mitsuba")

from bokehguide.export import export_mitsuba
from bokehguide.export.mitsuba_materials import lost_terms, mitsuba_bsdf
from bokehguide.render.bsdf.sheen import albedo_table, sheen_albedo
from bokehguide.scene import load_scene
from bokehguide.scene.disney_sheen import from_disney
from bokehguide.scene.shapes import spheres
from bokehguide.scene.types import Camera, FilmSettings, Material, Scene, Texture

NODES, WEIGHTS = np.polynomial.legendre.leggauss(24)
HEIGHTS, ANGLES = 0.5 * (NODES + 1.0), np.pi * (NODES + 1.0)
MITSUBA_VARIANT = "scalar_rgb"
CAMERA = Camera((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), aperture_radius=0.1, focus_distance=4.0)


def theirs(cosine: float, base=(0.0, 0.0, 0.0), **values: float) -> np.ndarray:
    """Albedo of Mitsuba's sheen, by the difference of the BSDFs with and without, RGB."""
    plain = {"type": "principled", "base_color": {"type": "rgb", "value": list(base)}, "specular": 0.0}
    plain["metallic"] = values.pop("metallic", 0.0)
    pair = [mi.load_dict(plain | values), mi.load_dict(plain)]
    at = mi.SurfaceInteraction3f()
    at.wi = mi.Vector3f((1.0 - cosine**2) ** 0.5, 0.0, cosine)
    total = np.zeros(3)
    for height, up in zip(HEIGHTS, 0.5 * WEIGHTS):
        for angle, around in zip(ANGLES, np.pi * WEIGHTS):
            away = (1.0 - height**2) ** 0.5
            out = mi.Vector3f(away * np.cos(angle), away * np.sin(angle), height)
            sheen, without = (np.ravel(np.array(bsdf.eval(mi.BSDFContext(), at, out))) for bsdf in pair)
            total += up * around * (sheen - without)
    return total


def ours(cosine: float, *parameters) -> np.ndarray:
    """Albedo of the sheen that `from_disney` gives, RGB."""
    fields = from_disney(*parameters)
    white = sheen_albedo(albedo_table(), torch.tensor([cosine]), torch.tensor([fields["sheen_roughness"]]))
    return np.array(fields["sheen_color"]) * float(white)


def test_albedos_are_mitsubas():
    cosines = np.linspace(0.1, 1.0, 10)
    found = np.array([ours(cosine, 1.0, 0.0, (0.0, 0.0, 0.0), 0.0)[0] for cosine in cosines])
    wanted = np.array([theirs(cosine, sheen=1.0)[0] for cosine in cosines])
    np.testing.assert_allclose(found, wanted, atol=0.003)
    assert (cosines * found).sum() == pytest.approx((cosines * wanted).sum(), rel=0.02)


def test_colours_are_mitsubas():
    base = (0.2, 0.4, 0.6)
    wanted, found = theirs(0.3, base, sheen=0.5, sheen_tint=0.7, metallic=0.25), ours(0.3, 0.5, 0.7, base, 0.25)
    np.testing.assert_allclose(found, wanted, rtol=0.08)
    np.testing.assert_allclose(found / found.sum(), wanted / wanted.sum(), rtol=1e-3)


@pytest.mark.parametrize("values", [(1.0, 0.0, 0.0), (0.6, 0.4, 0.0), (0.3, 1.0, 0.5)])
def test_exported_sheens_come_back(tmp_path, values):
    sheen, tint, metallic = values
    base = (0.7, 0.4, 0.2)
    material = Material(
        "cloth", base, metallic=metallic, single_scattering=metallic > 0.0, **from_disney(sheen, tint, base, metallic)
    )
    scene = Scene("one", CAMERA, (spheres(np.zeros((1, 3)), np.ones(1), 0, 1),), (material,), FilmSettings(16, 9))
    assert export_mitsuba(scene, tmp_path) == []
    back = load_scene(str(tmp_path / "scene.xml"))
    found = back.materials[back.meshes[0].material]
    assert found.sheen_color == pytest.approx(material.sheen_color, rel=1e-3) and max(found.sheen_color) > 0.01
    assert found.sheen_roughness == material.sheen_roughness and back.warnings == ()


def test_a_matte_sheen_has_no_coat():
    material = Material("felt", specular_color=(0.0, 0.0, 0.0), **from_disney(0.5, 0.0, (0.8, 0.8, 0.8), 0.0))
    bsdf = mitsuba_bsdf(material)["bsdf"]
    assert (bsdf["type"], bsdf["eta"], bsdf["sheen"]) == ("principled", 1.0, pytest.approx(0.5))


def test_sheens_beyond_disneys_are_told():
    cloth = Material("cloth", (0.7, 0.4, 0.2), **from_disney(1.0, 0.0, (0.7, 0.4, 0.2), 0.0))
    assert lost_terms(cloth) == []
    texture = Texture(np.ones((2, 2, 3), np.float32))
    for other in (
        {"sheen_color": (0.5, 0.5, 0.5)},
        {"sheen_roughness": 0.7},
        {"sheen_color": (0.02, 0.02, 0.08)},
        {"metallic": 1.0},
        {"sheen_color_texture": texture},
        {"transmission": 1.0},
    ):
        assert "sheen" in lost_terms(replace(cloth, **other)), other
    assert "sheen" not in lost_terms(Material("plain"))


def test_a_tint_by_a_texture_is_told(tmp_path):
    from PIL import Image

    Image.new("RGB", (2, 2), (200, 100, 50)).save(tmp_path / "weave.png")
    path = tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><sensor type="thinlens"/><shape type="sphere"><bsdf type="principled" id="cloth">'
        '<float name="sheen" value="1"/>'
        '<float name="sheen_tint" value="0.5"/><texture type="bitmap" name="base_color">'
        '<string name="filename" value="weave.png"/></texture></bsdf></shape></scene>'
    )
    scene = load_scene(str(path))
    red, green, blue = scene.materials[scene.meshes[0].material].sheen_color
    assert red == green == blue > 0.05
    assert "scene.xml: sheen_tint of principled BSDFs with a texture: a white sheen (cloth)" in scene.warnings
