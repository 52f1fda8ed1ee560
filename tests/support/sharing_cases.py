"""Scenes whose neighbouring pixels see the same surfaces, and steps of a loop with the reused samples of their pixels."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.pixel_reuse import PixelPathReuse
from bokehguide.guiding.protocols import BatchSamples
from bokehguide.guiding.reuse_weights import Reused
from bokehguide.render.path_tracer import PathSamples
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene.types import Camera, Environment, FilmSettings, Material, Scene
from bokehguide.train import RenderLoop, RenderSettings
from tests.support.tracing import UP, rectangle

CAMERA = Camera((0.1, 0.2, 0.3), (0.1, 0.2, -1.0), fov=50.0, aperture_radius=0.25, focus_distance=1.5)
FLOOR = Material("floor", (0.6, 0.5, 0.4))
WALL = Material("wall", (0.9, 0.6, 0.4), metallic=1.0, roughness=0.5)
LAMP = Material("emitter", (0.0, 0.0, 0.0), specular=0.0, emission=(24.0, 20.0, 16.0), double_sided=True)
CARD = Material("card", (0.1, 0.2, 0.5))
SHEET = Material("sheet", (0.3, 0.5, 0.2), specular=0.0, opacity=0.4, alpha_mode="blend")


def scene_of(meshes, materials, width: int, height: int, sky: bool = True, peak: float = 2.0, camera: Camera = CAMERA) -> Scene:
    """A scene of these meshes; sky: whether an environment map with a bright part of radiance `peak` lights it."""
    radiance = np.full((4, 8, 3), 0.3, np.float32)
    radiance[1, 3:5] = peak
    environment = Environment(radiance) if sky else None
    return Scene("shared", camera, tuple(meshes), tuple(materials), FilmSettings(width, height, 3), environment)


def terrace(width: int, height: int, sheet: bool = False, sky: bool = True) -> Scene:
    """A floor close below a wide lens, a glossy wall behind it, an emitter, a card before the focal plane, and the sky.

    sheet: whether a translucent sheet stands before the left half of everything but the card.
    """
    meshes = [
        rectangle(0, (0.0, -0.15, -5.7), UP, (6.0, 6.0, 1.0)),
        rectangle(1, (0.9, 0.2, -3.5), (10.0, -20.0, 0.0), 0.7),
        rectangle(2, (-0.5, 0.5, -3.0), (0.0, 30.0, 0.0), 0.12),
        rectangle(3, (-0.1, 0.25, -0.4), (0.0, 20.0, 0.0), 0.1),
    ]
    if not sheet:
        return scene_of(meshes, (FLOOR, WALL, LAMP, CARD), width, height, sky)
    meshes.append(rectangle(4, (-0.75, 0.3, -0.8), (0.0, 10.0, 0.0), 0.7))
    return scene_of(meshes, (FLOOR, WALL, LAMP, CARD, SHEET), width, height, sky)


def leaning(width: int, height: int, material: Material = FLOOR) -> Scene:
    """A wall that fills the frame, whose shading normals face one half of the lens only."""
    depth = 3.5
    wall = rectangle(0, (CAMERA.position[0], CAMERA.position[1], CAMERA.position[2] - depth), scale=9.0)
    normals = np.zeros_like(wall.vertices)
    normals[:, 0], normals[:, 2] = depth, wall.vertices[:, 0] - CAMERA.position[0]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return scene_of([replace(wall, normals=normals)], (material,), width, height)


@dataclass
class Step:
    """The samples of one step, before and after reuse."""

    samples: BatchSamples
    reused: Reused

    @property
    def own(self) -> Tensor:
        """W L / (A q) of the samples before reuse, `[3, N]`."""
        return self.samples.paths.radiance * self.samples.drawn.weight


class RecordedReuse(PixelPathReuse):
    """Keeps the samples of its steps. change: applied to the paths before reuse. group: as of `PixelPathReuse`."""

    def __init__(self, loop: RenderLoop, seed: int, change: Callable[[PathSamples], None] | None, group: int):
        super().__init__(loop.camera, loop.tracer, loop.film.width, seed, group, GuidedConfig.min_spread)
        self.steps: list[Step] = []
        self._change = change

    def reuse(self, samples: BatchSamples, timer: PhaseTimer) -> Reused:
        if self._change is not None:
            self._change(samples.paths)
        self.steps.append(Step(samples, super().reuse(samples, timer)))
        return self.steps[-1].reused


def loop_of(scene: Scene, seed: int = 0, threads: int = 1, config: GuidedConfig = GuidedConfig()) -> RenderLoop:
    return RenderLoop(scene, RenderSettings("guided", seed=seed, threads=threads, guided=config))


def trained(scene: Scene, steps: int = 2) -> RenderLoop:
    """A loop that has learned for some steps, and learns no more."""
    loop = loop_of(scene)
    for _ in range(steps):
        loop.step()
    loop._learns = False
    return loop


def step_of(
    loop: RenderLoop,
    seed: int,
    change: Callable[[PathSamples], None] | None = None,
    group: int = GuidedConfig.reuse_group,
) -> Step:
    """The next step, with random numbers and groups of its own; change, group: see `RecordedReuse`."""
    loop.settings = replace(loop.settings, seed=seed)
    loop.mode.reuse.paths = recorded = RecordedReuse(loop, seed, change, group)
    loop.step()
    [step] = recorded.steps
    return step


def on_film(values: Tensor, scene: Scene) -> np.ndarray:
    """`[.., N]` as `[.., H, W]`."""
    return values.reshape(*values.shape[:-1], scene.film.height, scene.film.width).double().numpy()


def same(one: Tensor, other: Tensor, rounding: float = 1e-5) -> bool:
    return bool(torch.isclose(one, other, rtol=rounding, atol=1e-6).all())


def spoil(loop: RenderLoop, every: int = 9) -> None:
    """Take one step in which each sample whose number is a multiple of `every` is not finite."""
    trace = loop.tracer.trace

    def spoiled(*args, **keywords) -> PathSamples:
        samples = trace(*args, **keywords)
        samples.radiance[:, ::every] = math.nan
        return samples

    loop.tracer.trace = spoiled
    loop.step()
    loop.tracer.trace = trace
