"""Scenes in which pixels see much of the same, and steps of a loop with what their pixels shared."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.path_tracer import PathSamples
from bokehguide.render.timer import PhaseTimer
from bokehguide.scene.types import Camera, Environment, Film, Material, Scene
from bokehguide.train import RenderLoop, RenderSettings
from bokehguide.train.guide import LensDraw
from bokehguide.train.sharing import PathSharing, Shared
from tests.tracing import UP, rectangle

CAMERA = Camera((0.1, 0.2, 0.3), (0.1, 0.2, -1.0), fov=50.0, aperture_radius=0.25, focus_distance=1.5)
FLOOR = Material("floor", (0.6, 0.5, 0.4))
WALL = Material("wall", (0.9, 0.6, 0.4), metallic=1.0, roughness=0.5)
LAMP = Material("lamp", (0.0, 0.0, 0.0), specular=0.0, emission=(24.0, 20.0, 16.0), double_sided=True)
CARD = Material("card", (0.1, 0.2, 0.5))
SHEET = Material("sheet", (0.3, 0.5, 0.2), specular=0.0, opacity=0.4, alpha_mode="blend")


def shown(meshes, materials, width: int, height: int, sky: bool = True, peak: float = 2.0, camera: Camera = CAMERA) -> Scene:
    """Under a sky with a bright part."""
    radiance = np.full((4, 8, 3), 0.3, np.float32)
    radiance[1, 3:5] = peak
    environment = Environment(radiance) if sky else None
    return Scene("shared", camera, tuple(meshes), tuple(materials), Film(width, height, 3), environment)


def terrace(width: int, height: int, sheet: bool = False, sky: bool = True) -> Scene:
    """A floor close below a wide lens, a glossy wall behind it, a lamp, a card before the focal plane, and the sky; if asked
    for, also a sheer sheet before the left half of all that but the card."""
    meshes = [
        rectangle(0, (0.0, -0.15, -5.7), UP, (6.0, 6.0, 1.0)),
        rectangle(1, (0.9, 0.2, -3.5), (10.0, -20.0, 0.0), 0.7),
        rectangle(2, (-0.5, 0.5, -3.0), (0.0, 30.0, 0.0), 0.12),
        rectangle(3, (-0.1, 0.25, -0.4), (0.0, 20.0, 0.0), 0.1),
    ]
    if not sheet:
        return shown(meshes, (FLOOR, WALL, LAMP, CARD), width, height, sky)
    meshes.append(rectangle(4, (-0.75, 0.3, -0.8), (0.0, 10.0, 0.0), 0.7))
    return shown(meshes, (FLOOR, WALL, LAMP, CARD, SHEET), width, height, sky)


def leaning(width: int, height: int, material: Material = FLOOR) -> Scene:
    """A wall that fills the frame, whose shading normals face one half of the lens and not the other."""
    depth = 3.5
    wall = rectangle(0, (CAMERA.position[0], CAMERA.position[1], CAMERA.position[2] - depth), scale=9.0)
    normals = np.zeros_like(wall.vertices)
    normals[:, 0], normals[:, 2] = depth, wall.vertices[:, 0] - CAMERA.position[0]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return shown([replace(wall, normals=normals)], (material,), width, height)


@dataclass
class Step:
    """What the pixels of a step found, and what they shared; `samples` and `shared` as `share` took and returned them."""

    number: int
    places: Tensor
    focus: Tensor
    draw: LensDraw
    samples: PathSamples
    depth: Tensor
    shared: Shared

    @property
    def own(self) -> Tensor:
        """W L / (A q) `[3, N]`."""
        return self.samples.radiance * self.draw.weight


def loop_of(scene: Scene, seed: int = 0, **others) -> RenderLoop:
    return RenderLoop(scene, RenderSettings("guided", seed=seed, **{"threads": 1} | others))


def taught(scene: Scene, steps: int = 2) -> RenderLoop:
    """A loop that has learnt for some steps, and learns no more."""
    loop = loop_of(scene)
    for _ in range(steps):
        loop.step()
    loop._learns = False
    return loop


def step_of(loop: RenderLoop, seed: int, change=None) -> Step:
    """The next step with random numbers and groups of its own; change: what to do to the samples before they are shared."""
    loop.settings = replace(loop.settings, seed=seed)
    sharing = loop.sharing = PathSharing(loop.camera, loop.tracer, loop.film.width, seed)
    found = []

    def share(step: int, places, focus: Tensor, draw: LensDraw, samples: PathSamples, depth: Tensor, timer: PhaseTimer) -> Shared:
        if change is not None:
            change(samples)
        shared = PathSharing.share(sharing, step, places, focus, draw, samples, depth, timer)
        found.append(Step(step, places, focus, draw, samples, depth, shared))
        return shared

    sharing.share = share
    loop.step()
    assert len(found) == 1
    return found[0]


def on_film(values: Tensor, scene: Scene) -> np.ndarray:
    """`[.., N]` as `[.., H, W]`."""
    return values.reshape(*values.shape[:-1], scene.film.height, scene.film.width).double().numpy()


def same(one: Tensor, other: Tensor, rounding: float = 1e-5) -> bool:
    return bool(torch.isclose(one, other, rtol=rounding, atol=1e-6).all())
