"""A small scene in which pixels have much to share, and its renders step by step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy import stats

from bokehguide.render.film import Film
from bokehguide.render.vector import luminance
from bokehguide.scene.shapes import transform, transformed, unit_rectangle, unit_sphere
from bokehguide.scene.types import Camera, Environment, Material, Mesh, Scene
from bokehguide.scene.types import FilmSettings as Frame
from bokehguide.train import RenderLoop, RenderSettings
from tests.support.statistical import block_means, z_test

WIDTH, HEIGHT, RADIUS = 48, 32, 5.0
FLOOR = -0.32
"""Height of the floor below the lens, which is 0.25 wide: what it sees of it changes much over the lens."""


def mesh(shape: Mesh, material: int, translate, rotate=(0.0, 0.0, 0.0), scale=1.0) -> Mesh:
    return replace(transformed(shape, transform(translate, rotate, scale)), material=material)


def scene(width: int = WIDTH, height: int = HEIGHT, max_depth: int = 3) -> Scene:
    """A floor close below a wide lens, a mirror, an emitter, a card before the focal plane, and a sky with a bright part."""
    camera = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=50.0, aperture_radius=0.25, focus_distance=1.5)
    materials = (
        Material("floor", (0.6, 0.5, 0.4)),
        Material("mirror", (0.9, 0.9, 0.9), metallic=1.0, roughness=0.0),
        Material("emitter", (0.0, 0.0, 0.0), specular=0.0, emission=(24.0, 20.0, 16.0)),
        Material("card", (0.1, 0.2, 0.5)),
    )
    meshes = (
        mesh(unit_rectangle(), 0, (0.0, FLOOR, -6.0), (-90.0, 0.0, 0.0), 6.0),
        mesh(unit_sphere(), 1, (0.5, 0.0, -2.5), scale=0.4),
        mesh(unit_sphere(), 2, (-0.6, 0.35, -4.0), scale=0.08),
        mesh(unit_rectangle(), 3, (-0.25, 0.05, -0.9), (0.0, 20.0, 0.0), 0.12),
    )
    sky = np.full((4, 8, 3), 0.3, np.float32)
    sky[1, 2:4] = 2.0
    return Scene("shared", camera, meshes, materials, Frame(width, height, max_depth), Environment(sky))


def loop_of(mode: str, seed: int = 0, threads: int = 1, shown: Scene | None = None) -> RenderLoop:
    return RenderLoop(shown or scene(), RenderSettings(mode, seed=seed, threads=threads, reuse_radius=RADIUS))


def luminance_by_step(loop: RenderLoop, steps: int) -> np.ndarray:
    """Each step's picture alone, `[steps, H, W]`."""
    pictures = []
    for _ in range(steps):
        loop.film = Film(loop.film.width, loop.film.height)
        loop.step()
        assert loop.film.bad_count == 0
        pictures.append(luminance(loop.film.radiance().permute(2, 0, 1).flatten(1)).reshape(HEIGHT, WIDTH))
    return torch.stack(pictures).double().numpy()


def same_means(one: np.ndarray, other: np.ndarray) -> float:
    """p-value of two pictures by step `[steps, H, W]` having the same means in blocks of 8 × 8 pixels and over the frame.

    Step by step, as both may have used the same samples, and a step's pixels each other's.
    """
    difference = one - other
    blocks = np.stack([block_means(picture, 8).ravel() for picture in difference])
    values = np.concatenate((blocks, difference.mean((1, 2))[:, None]), axis=1)
    t = values.mean(0) / (values.std(0, ddof=1) / np.sqrt(len(values)))
    z = stats.norm.isf(stats.t.sf(np.abs(t), len(values) - 1))
    return z_test(z, np.ones_like(z))
