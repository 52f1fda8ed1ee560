"""Light sampling and BSDF sampling together give what BSDF sampling alone gives, and mutations show."""

import numpy as np
import pytest
import torch

from bokehguide.render import mis
from bokehguide.render.bsdf import OpaqueBSDF
from bokehguide.render.lens import Lens
from bokehguide.render.lights import Lights
from bokehguide.render.tracer import Tracer
from bokehguide.scene.types import Environment, Material, Texture
from tests.statistical import SIGNIFICANCE
from tests.test_render_camera import lens_uniformity
from tests.test_render_path_tracer import direct_light, shadow
from tests.tracing import DOWN, UP, agreement, estimates, lamp, matte, rectangle, scene, sphere

MATERIALS = {
    "matte": matte(0.6),
    "coated": Material("coated", (0.6, 0.5, 0.4), roughness=0.4),
    "glossy metal": Material("metal", (0.9, 0.7, 0.4), metallic=1.0, roughness=0.3),
    "mixed": Material("mixed", (0.9, 0.7, 0.4), metallic=0.5, roughness=0.6),
    "frosted sheet": Material("sheet", (0.9, 0.9, 0.8), roughness=0.5, transmission=0.8, thin=True),
    "frosted solid": Material("solid", (0.9, 0.9, 0.8), roughness=0.5, transmission=1.0),
}


def sky_with_a_window(peak: float) -> Environment:
    radiance = np.full((16, 32, 3), 0.2, np.float32)
    radiance[2:6, 3:9] = peak
    return Environment(radiance, 40.0)


def checkered() -> Material:
    """A lamp with a texture that is black in places."""
    texture = np.zeros((4, 4, 3), np.float32)
    texture[::2, ::2], texture[1::2, 1::2] = (1.0, 0.5, 0.2), (0.1, 0.5, 1.0)
    return lamp(4.0, emission_texture=Texture(texture), double_sided=True)


def neon() -> Material:
    """A lamp beneath a clear coat, dimmer at grazing angles."""
    return lamp(4.0, clearcoat=1.0, double_sided=True)


def room(material: Material, environment: Environment | None, light: Material):
    """A floor and a slanted plate of `material`, a rectangular lamp and a ball lamp over a rough floor."""
    meshes = [
        rectangle(0, rotate=UP, scale=3.0),
        rectangle(1, (0.0, 0.5, 0.0), (-60.0, 20.0, 0.0), 0.5),
        rectangle(2, (0.4, 1.6, 0.3), DOWN, 0.5),
        sphere(2, (-1.0, 1.0, 0.5), 0.3),
        rectangle(2, (0.0, 0.1, -0.6), UP, 0.2),
    ]
    return scene(meshes, [matte(0.3), material, light], environment, max_depth=4)


def bsdf_sampling_only(monkeypatch) -> None:
    monkeypatch.setattr(Lights, "empty", property(lambda self: True))
    monkeypatch.setattr(mis, "power_heuristic", lambda pdf, other: torch.ones_like(pdf))


@pytest.mark.parametrize("light", ["plain", "checkered", "neon", "sky", "lamps and sky"])
@pytest.mark.parametrize("name", MATERIALS)
def test_both_techniques_together_agree_with_one_alone(name, light, monkeypatch):
    environment = sky_with_a_window(6.0) if "sky" in light else None
    lamps = {"checkered": checkered(), "neon": neon(), "sky": matte(0.2)}.get(light, lamp(2.0))
    ray = ((0.1, 1.3, 1.5), (-0.1, -0.8, -1.5))
    both = estimates(room(MATERIALS[name], environment, lamps), *ray, count=60_000)
    bsdf_sampling_only(monkeypatch)
    alone = estimates(room(MATERIALS[name], environment, lamps), *ray, count=120_000, seed=1)
    assert both.mean() > 0.01
    assert agreement(both, alone) > SIGNIFICANCE


@pytest.mark.parametrize("height", [0.3, 1.0, 3.0])
def test_a_lamp_near_a_floor_that_is_seen_from_afar_does_not_shadow_itself(height, monkeypatch):
    """From 10 m away rays leave the floor by so much that the lamp is nearer than what was sampled."""
    lit = scene([rectangle(0, rotate=UP, scale=20.0), rectangle(1, (0.0, height, 0.0), DOWN, 0.3)], [matte(0.8), lamp(5.0)])
    ray = ((10.0 + 0.5 * height, 10.0, 0.0), (-1.0, -1.0, 0.0))
    both = estimates(lit, *ray, count=60_000)
    bsdf_sampling_only(monkeypatch)
    alone = estimates(lit, *ray, count=200_000, seed=1)
    assert alone.mean() > 0.01
    assert agreement(both, alone) > SIGNIFICANCE


@pytest.mark.parametrize("shift", [0.0, 0.01])
def test_a_wall_on_the_border_of_two_cells_has_one_choice_of_lamps(shift, monkeypatch):
    """Lamps in pairs left and right of a wall: the middle of the grid is a border between cells."""
    meshes = [rectangle(0, (shift, 0.0, 0.0), (0.0, -90.0, 0.0), 2.0)]
    for x in (-1.5, -0.6, -0.05, 0.05, 0.6, 1.5):
        meshes += [rectangle(1, (x, 0.0, z), (0.0, 90.0, 0.0), 0.05) for z in (-0.3, 0.0, 0.3)]
    wall = Material("wall", (0.9, 0.9, 0.9), metallic=1.0, roughness=0.6)
    lit = scene(meshes, [wall, lamp(5.0, double_sided=True)])
    ray = ((-0.5 + shift, 1.0, 0.1), (0.5, -0.9, -0.1))
    both = estimates(lit, *ray, count=60_000)
    bsdf_sampling_only(monkeypatch)
    alone = estimates(lit, *ray, count=200_000, seed=1)
    assert agreement(both, alone) > SIGNIFICANCE


def glare() -> float:
    """p-value of a glossy plate agreeing with one technique alone; needs both sets of weights right."""
    ray = ((0.1, 1.3, 1.5), (-0.1, -0.8, -1.5))
    both = estimates(room(MATERIALS["glossy metal"], sky_with_a_window(6.0), lamp(2.0)), *ray, count=60_000)
    with pytest.MonkeyPatch.context() as patch:
        bsdf_sampling_only(patch)
        alone = estimates(room(MATERIALS["glossy metal"], sky_with_a_window(6.0), lamp(2.0)), *ray, count=120_000, seed=1)
    return agreement(both, alone)


def test_a_dropped_mis_weight_is_found(monkeypatch):
    monkeypatch.setattr(mis, "power_heuristic", lambda pdf, other: torch.ones_like(pdf))
    assert direct_light() < SIGNIFICANCE
    assert glare() < SIGNIFICANCE


def test_an_mis_weight_of_the_wrong_density_is_found(monkeypatch):
    density = Lights.triangle_pdf
    monkeypatch.setattr(Lights, "triangle_pdf", lambda self, *rest: 0.5 * density(self, *rest))
    assert direct_light() < SIGNIFICANCE


def test_a_missing_shadow_test_is_found(monkeypatch):
    monkeypatch.setattr(Tracer, "visible", lambda self, origins, directions, distances: torch.ones_like(distances))
    assert shadow() < SIGNIFICANCE


def test_a_dropped_cosine_is_found(monkeypatch):
    evaluate = OpaqueBSDF.evaluate

    def without_cosine(self, incoming):
        value, pdf = evaluate(self, incoming)
        return value / incoming[2].abs().clamp(min=1e-3), pdf

    monkeypatch.setattr(OpaqueBSDF, "evaluate", without_cosine)
    assert direct_light() < SIGNIFICANCE


def test_a_lens_sampled_by_its_radius_is_found(monkeypatch):
    sample = Lens.sample
    monkeypatch.setattr(Lens, "sample", lambda self, uniforms: sample(self, uniforms.square()))
    assert lens_uniformity() < SIGNIFICANCE


def test_the_unmutated_checks_pass():
    assert min(direct_light(), shadow(), glare(), lens_uniformity()) > SIGNIFICANCE
