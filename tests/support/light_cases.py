"""Emitters of all kinds around a point, and light samples there."""

from __future__ import annotations

import numpy as np
import torch

from bokehguide.render.geometry import Geometry
from bokehguide.render.lights.power_sampler import PowerLightSampler
from bokehguide.render.lights.scene_lights import Lights
from bokehguide.render.random import PixelRandom
from bokehguide.scene.types import Environment, Scene, Texture
from tests.support.choice_cases import learned_choice
from tests.support.tracing import emitter, matte, rectangle, scene, sphere

DRAWS = 200_000
TEXTURE = np.zeros((4, 4, 3), np.float32)
TEXTURE[::2, ::2], TEXTURE[1::2, 1::2] = (1.0, 0.5, 0.2), (0.1, 0.5, 1.0)
ORIGIN = (0.0, 0.0, 0.0)


def window() -> Environment:
    radiance = np.full((16, 32, 3), 0.2, np.float32)
    radiance[2:6, 3:9] = 5.0
    return Environment(radiance, 40.0)


def emitters(environment: Environment | None) -> Scene:
    """Emitters around the origin: plain, textured, seen from behind, double-sided, one behind another; and a wall."""
    materials = [emitter(5.0), emitter(8.0, emission_texture=Texture(TEXTURE)), emitter(3.0, double_sided=True), matte(0.5)]
    meshes = [
        rectangle(0, (0.5, 0.2, 1.0), (180.0, 0.0, 0.0), 0.4),
        rectangle(1, (-1.0, 0.5, 0.8), (30.0, 90.0, 0.0), 0.5),
        rectangle(0, (0.0, -1.0, 0.5), (90.0, 0.0, 0.0), 0.3),  # shows its back
        rectangle(2, (0.0, 1.5, 0.6), (-90.0, 0.0, 0.0), 0.3),
        rectangle(0, (1.0, 0.4, 2.0), (180.0, 0.0, 0.0), 0.6),
        sphere(0, (0.2, -0.5, -1.0), 0.2),
        rectangle(3, (1.2, -0.6, 0.4), (0.0, -90.0, 0.0), 0.4),
    ]
    return scene(meshes, materials, environment)


def at(place, count: int) -> torch.Tensor:
    """`count` copies of a point, `[3, count]`."""
    return torch.tensor(place)[:, None].repeat(1, count)


def sampled(scene: Scene, count: int = DRAWS, place=ORIGIN, learnt: bool = False):
    """The sampler by power, the geometry, the distribution, learned or not, and light samples at one point."""
    geometry = Geometry(scene)
    power = PowerLightSampler(Lights(scene, geometry))
    points, uniforms = at(place, count), PixelRandom(0, 0, torch.arange(count)).uniform(0, 6)
    if not learnt:
        return power, geometry, power, power.draw(power.lights.query(points), uniforms)
    distribution = learned_choice(power, count)
    return power, geometry, distribution, distribution.draw(power.lights.query(points), uniforms)
