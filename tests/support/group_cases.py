"""A scene whose lights have groups, and renders of the groups."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bokehguide.scene.types import Environment, Material, Scene
from bokehguide.train import AdaptiveLoop, RenderLoop, RenderSettings, make_loop
from tests.support.native_cases import SUNS
from tests.support.sharing_cases import terrace
from tests.support.tracing import rectangle

NAMES = ("lamps", "neon", "sun", "sky", "ungrouped")
NEON = Material("neon", (0.2, 0.2, 0.2), emission=(0.5, 6.0, 9.0), clearcoat=0.5, double_sided=True, light_group="neon")
BULB = Material("bulb", (0.0, 0.0, 0.0), specular=0.0, emission=(9.0, 1.0, 0.5), double_sided=True)


def grouped(width: int = 24, height: int = 16) -> Scene:
    """Two groups of emitters, an emitter and a sun without group, a sun and the sky in groups, and a translucent sheet."""
    scene = terrace(width, height, sheet=True)
    materials = [replace(each, light_group="lamps") if each.emits else each for each in scene.materials]
    count = len(materials)
    meshes = [
        rectangle(count, (0.6, 0.5, -2.0), (0.0, 20.0, 0.0), 0.1),
        rectangle(count + 1, (-0.3, -0.1, -2.2), (0.0, 0.0, 0.0), 0.05),
    ]
    assert scene.environment is not None
    sky = Environment(0.2 * scene.environment.radiance, light_group="sky")
    suns = (replace(SUNS[0], light_group="sun"), SUNS[1])
    return replace(scene, meshes=(*scene.meshes, *meshes), materials=(*materials, NEON, BULB), environment=sky, suns=suns)


def only(scene: Scene, group: str, scale: float = 1.0) -> Scene:
    """The scene with the light of one group alone, times `scale`. Other surfaces of emitters stay, and are dark."""

    def factor(name: str) -> float:
        return scale if (name or "ungrouped") == group else 0.0

    def dimmed(values: tuple[float, ...], name: str) -> tuple[float, float, float]:
        red, green, blue = (factor(name) * value for value in values)
        return red, green, blue

    materials = tuple(replace(each, emission=dimmed(each.emission, each.light_group)) for each in scene.materials)
    suns = tuple(replace(each, irradiance=dimmed(each.irradiance, each.light_group)) for each in scene.suns)
    sky = scene.environment
    if sky is not None:
        sky = replace(sky, radiance=np.float32(factor(sky.light_group)) * sky.radiance)
    return replace(scene, materials=materials, suns=suns, environment=sky)


def rendered(scene: Scene, spp: int, settings: RenderSettings) -> RenderLoop | AdaptiveLoop:
    """A loop after `spp` steps, or when all blocks have the target noise."""
    with make_loop(scene, replace(settings, spp=spp)) as loop:
        while loop.step_number < spp and not (isinstance(loop, AdaptiveLoop) and loop.finished):
            loop.step()
    return loop
