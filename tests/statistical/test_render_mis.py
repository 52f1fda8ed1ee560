"""Light sampling and BSDF sampling together give what BSDF sampling alone gives, and mutations show."""

import pytest
import torch

from bokehguide.render import mis
from bokehguide.render.bsdf.opaque import OpaqueBSDF
from bokehguide.render.lens import Lens
from bokehguide.render.lights.scene_lights import Lights
from bokehguide.render.tracer import Tracer
from bokehguide.runtime import native
from bokehguide.scene.types import Material
from tests.support.light_checks import (
    direct_light,
    lens_uniformity,
    shadow,
)
from tests.support.rooms import MATERIALS, bsdf_sampling_only, checkered, neon, room, sky_with_a_window
from tests.support.statistical import SIGNIFICANCE
from tests.support.tracing import DOWN, UP, agreement, emitter, estimates, matte, rectangle, scene


@pytest.mark.slow
@pytest.mark.parametrize("light", ["plain", "checkered", "neon", "sky", "emitters and sky"])
@pytest.mark.parametrize("name", MATERIALS)
def test_both_techniques_together_agree_with_one_alone(name, light, monkeypatch):
    environment = sky_with_a_window(6.0) if "sky" in light else None
    emitters = {"checkered": checkered(), "neon": neon(), "sky": matte(0.2)}.get(light, emitter(2.0))
    ray = ((0.1, 1.3, 1.5), (-0.1, -0.8, -1.5))
    both = estimates(room(MATERIALS[name], environment, emitters), *ray, count=60_000)
    bsdf_sampling_only(monkeypatch)
    alone = estimates(room(MATERIALS[name], environment, emitters), *ray, count=120_000, seed=1)
    assert both.mean() > 0.01
    assert agreement(both, alone) > SIGNIFICANCE


@pytest.mark.parametrize("height", [0.3, 1.0, 3.0])
def test_a_lamp_near_a_floor_that_is_seen_from_afar_does_not_shadow_itself(height, monkeypatch):
    """From 10 m away rays leave the floor by so much that the emitter is nearer than what was sampled."""
    lit = scene([rectangle(0, rotate=UP, scale=20.0), rectangle(1, (0.0, height, 0.0), DOWN, 0.3)], [matte(0.8), emitter(5.0)])
    ray = ((10.0 + 0.5 * height, 10.0, 0.0), (-1.0, -1.0, 0.0))
    both = estimates(lit, *ray, count=60_000)
    bsdf_sampling_only(monkeypatch)
    alone = estimates(lit, *ray, count=200_000, seed=1)
    assert alone.mean() > 0.01
    assert agreement(both, alone) > SIGNIFICANCE


@pytest.mark.parametrize("shift", [0.0, 0.01])
def test_a_wall_on_the_border_of_two_cells_has_one_choice_of_lamps(shift, monkeypatch):
    """Emitters in pairs left and right of a wall: the middle of the grid is a border between cells."""
    meshes = [rectangle(0, (shift, 0.0, 0.0), (0.0, -90.0, 0.0), 2.0)]
    for x in (-1.5, -0.6, -0.05, 0.05, 0.6, 1.5):
        meshes += [rectangle(1, (x, 0.0, z), (0.0, 90.0, 0.0), 0.05) for z in (-0.3, 0.0, 0.3)]
    wall = Material("wall", (0.9, 0.9, 0.9), metallic=1.0, roughness=0.6)
    lit = scene(meshes, [wall, emitter(5.0, double_sided=True)])
    ray = ((-0.5 + shift, 1.0, 0.1), (0.5, -0.9, -0.1))
    both = estimates(lit, *ray, count=60_000)
    bsdf_sampling_only(monkeypatch)
    alone = estimates(lit, *ray, count=200_000, seed=1)
    assert agreement(both, alone) > SIGNIFICANCE


def glare() -> float:
    """p-value of a glossy plate agreeing with one technique alone; needs both sets of weights right."""
    ray = ((0.1, 1.3, 1.5), (-0.1, -0.8, -1.5))
    both = estimates(room(MATERIALS["glossy metal"], sky_with_a_window(6.0), emitter(2.0)), *ray, count=60_000)
    with pytest.MonkeyPatch.context() as patch:
        bsdf_sampling_only(patch)
        alone = estimates(room(MATERIALS["glossy metal"], sky_with_a_window(6.0), emitter(2.0)), *ray, count=120_000, seed=1)
    return agreement(both, alone)


def test_a_dropped_mis_weight_is_found(monkeypatch):
    monkeypatch.setenv(native.SWITCH, "0")
    monkeypatch.setattr(mis, "power_heuristic", lambda pdf, other: torch.ones_like(pdf))
    assert direct_light() < SIGNIFICANCE
    assert glare() < SIGNIFICANCE


def test_an_mis_weight_of_the_wrong_density_is_found(monkeypatch):
    monkeypatch.setenv(native.SWITCH, "0")
    density = Lights.triangle_pdf
    monkeypatch.setattr(Lights, "triangle_pdf", lambda self, *rest: 0.5 * density(self, *rest))
    assert direct_light() < SIGNIFICANCE


def test_a_missing_shadow_test_is_found(monkeypatch):
    monkeypatch.setenv(native.SWITCH, "0")
    monkeypatch.setattr(Tracer, "visible", lambda self, origins, directions, distances: torch.ones_like(distances))
    assert shadow() < SIGNIFICANCE


def test_a_dropped_cosine_is_found(monkeypatch):
    monkeypatch.setenv(native.SWITCH, "0")
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
