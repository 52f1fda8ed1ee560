"""A renderer of its own, guided by bokehguide.

The toy renderer below knows spheres, a thin lens and NumPy, and nothing of bokehguide. `render` guides it.

    python examples/guide_your_renderer.py --spp 32 --out .
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import bokehguide

FOV, LENS_RADIUS, FOCUS = 40.0, 0.06, 2.0
CAMERA = bokehguide.Camera((0, 0, 0), (0, 0, -1), fov=FOV, aperture_radius=LENS_RADIUS, focus_distance=FOCUS)


class ToyRenderer:
    """Spheres under a dim sky: a matte ball in focus, and small lamps behind it. The camera looks along -z."""

    def __init__(self, width: int, height: int):
        self.width, self.height = width, height
        generator = np.random.default_rng(3)
        lamps = generator.uniform((-2.6, -1.2, -9.0), (2.6, 1.6, -6.0), (24, 3))
        self.centres = np.concatenate([[[0.05, -0.1, -FOCUS]], lamps])
        self.radii = np.array([0.28] + [0.02] * len(lamps))
        colours = generator.uniform(0.2, 1.0, (len(lamps), 3)) * (900.0, 500.0, 260.0)
        self.emission = np.concatenate([[[0.0, 0.0, 0.0]], colours])

    def raster(self, generator: np.random.Generator) -> np.ndarray:
        """A position in each pixel, `[N, 2]`."""
        row, column = np.mgrid[: self.height, : self.width]
        return np.stack([column.ravel(), row.ravel()], axis=1) + generator.random((self.width * self.height, 2))

    def rays(self, raster: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Origins and unit directions `[N, 3]` from lens points on the unit disc, `[N, 2]`, through the focal plane."""
        scale = 2.0 * FOCUS * np.tan(np.radians(FOV) / 2.0) / self.width
        x, y = (raster[:, 0] - 0.5 * self.width) * scale, (0.5 * self.height - raster[:, 1]) * scale
        origins = np.concatenate([LENS_RADIUS * points, np.zeros((len(points), 1))], axis=1)
        directions = np.stack([x, y, np.full_like(x, -FOCUS)], axis=1) - origins
        return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)

    def trace(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Radiance `[N, 3]` along rays, and the distances `[N]` of the surfaces, infinite without one."""
        towards = self.centres - origins[:, None]
        along = np.einsum("nki,ni->nk", towards, directions)
        inside = self.radii**2 - (towards**2).sum(axis=2) + along**2
        distance = np.where((inside > 0.0) & (along > 0.0), along - np.sqrt(inside.clip(min=0.0)), np.inf)
        nearest = distance.argmin(axis=1)
        distance = distance.min(axis=1)
        hit = np.isfinite(distance)
        normal = (origins + directions * np.where(hit, distance, 0.0)[:, None] - self.centres[nearest]) / self.radii[
            nearest, None
        ]
        matte = (0.05 + 0.35 * (normal @ (0.6, 0.64, 0.48)).clip(min=0.0))[:, None] * (0.9, 0.5, 0.3)
        surface = np.where(nearest[:, None] == 0, matte, self.emission[nearest])
        sky = (0.02 + 0.03 * directions[:, 1:2].clip(min=0.0)) * (0.6, 0.8, 1.0)
        return np.where(hit[:, None], surface, sky), distance


def render(toy: ToyRenderer, spp: int, guided: bool, seed: int = 0) -> np.ndarray:
    """The picture `[H, W, 3]`. Without guiding, the lens is sampled evenly."""
    generator = np.random.default_rng(seed)
    torch.manual_seed(seed)
    picture = np.zeros((toy.width * toy.height, 3))
    guide = bokehguide.LensGuide(CAMERA, toy.width, toy.height)
    for _ in range(spp):
        raster = toy.raster(generator)
        lens = guide.distribution(raster)
        points = lens.sample()
        radiance, distances = toy.trace(*toy.rays(raster, points.numpy()))
        picture += lens.weight(points).numpy()[:, None] * radiance
        if guided:  # without observations the distribution stays uniform
            guide.observe(points, distances, radiance @ (0.2126, 0.7152, 0.0722))
            guide.update()
    return (picture / spp).reshape(toy.height, toy.width, 3)


def error(picture: np.ndarray, reference: np.ndarray) -> float:
    """Mean absolute error relative to the reference (plus 0.01)."""
    return float((np.abs(picture - reference) / (reference + 0.01)).mean())


def save(path: Path, picture: np.ndarray) -> None:
    """Write a PNG with a simple tone curve."""
    display = 255.0 * (picture / (1.0 + picture)).clip(0.0, 1.0) ** (1.0 / 2.2)
    Image.fromarray(display.round().astype(np.uint8)).save(path)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spp", type=int, default=32, help="samples per pixel (default: 32)")
    parser.add_argument("--width", type=int, default=192, help="pixels (default: 192)")
    parser.add_argument("--out", type=Path, help="folder for uniform.png and guided.png")
    options = parser.parse_args(arguments)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
    toy = ToyRenderer(options.width, options.width * 9 // 16)
    reference = render(toy, 8 * options.spp, guided=True, seed=1)
    for name, guided in (("uniform", False), ("guided", True)):
        picture = render(toy, options.spp, guided)
        print(f"{name}: error {error(picture, reference):.4f} at {options.spp} samples per pixel")
        if options.out:
            save(options.out / f"{name}.png", picture)


if __name__ == "__main__":
    main()
