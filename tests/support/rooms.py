"""A room with several kinds of emitters, materials of all kinds for its floor, and skies, for tests of light sampling."""

from __future__ import annotations

import numpy as np
import torch

from bokehguide.render import mis
from bokehguide.render.lights.scene_lights import Lights
from bokehguide.runtime import native
from bokehguide.scene.types import Environment, Material, Scene, Texture
from tests.support.tracing import DOWN, UP, emitter, matte, rectangle, scene, sphere

MATERIALS = {
    "matte": matte(0.6),
    "coated": Material("coated", (0.6, 0.5, 0.4), roughness=0.4),
    "glossy metal": Material("metal", (0.9, 0.7, 0.4), metallic=1.0, roughness=0.3),
    "mixed": Material("mixed", (0.9, 0.7, 0.4), metallic=0.5, roughness=0.6),
    "cloth": Material("cloth", (0.3, 0.2, 0.5), roughness=0.8, sheen_color=(1.0, 0.8, 0.6), sheen_roughness=0.4),
    "brushed metal": Material("brushed", (0.9, 0.7, 0.4), metallic=1.0, roughness=0.4, anisotropy=0.8),
    "leaf": Material(
        "leaf", (0.3, 0.6, 0.2), roughness=0.5, diffuse_transmission=0.6, diffuse_transmission_color=(0.7, 0.9, 0.3)
    ),
    "frosted sheet": Material("sheet", (0.9, 0.9, 0.8), roughness=0.5, transmission=0.8, thin=True),
    "frosted solid": Material("solid", (0.9, 0.9, 0.8), roughness=0.5, transmission=1.0),
}


def sky_with_a_window(peak: float) -> Environment:
    """A dim sky with a bright rectangle of radiance `peak`."""
    radiance = np.full((16, 32, 3), 0.2, np.float32)
    radiance[2:6, 3:9] = peak
    return Environment(radiance, 40.0)


def checkered() -> Material:
    """An emitter with a texture that is black in places."""
    texture = np.zeros((4, 4, 3), np.float32)
    texture[::2, ::2], texture[1::2, 1::2] = (1.0, 0.5, 0.2), (0.1, 0.5, 1.0)
    return emitter(4.0, emission_texture=Texture(texture), double_sided=True)


def neon() -> Material:
    """An emitter beneath a clear coat, dimmer at grazing angles."""
    return emitter(4.0, clearcoat=1.0, double_sided=True)


def room(material: Material, environment: Environment | None, light: Material) -> Scene:
    """A floor and a slanted plate of `material`, a rectangular emitter and a ball emitter over a rough floor."""
    meshes = [
        rectangle(0, rotate=UP, scale=3.0),
        rectangle(1, (0.0, 0.5, 0.0), (-60.0, 20.0, 0.0), 0.5),
        rectangle(2, (0.4, 1.6, 0.3), DOWN, 0.5),
        sphere(2, (-1.0, 1.0, 0.5), 0.3),
        rectangle(2, (0.0, 0.1, -0.6), UP, 0.2),
    ]
    return scene(meshes, [matte(0.3), material, light], environment, max_depth=4)


def bsdf_sampling_only(monkeypatch) -> None:
    """Turn off next-event estimation and MIS for the rest of a test."""
    monkeypatch.setenv(native.SWITCH, "0")
    monkeypatch.setattr(Lights, "empty", property(lambda self: True))
    monkeypatch.setattr(mis, "power_heuristic", lambda pdf, other: torch.ones_like(pdf))
