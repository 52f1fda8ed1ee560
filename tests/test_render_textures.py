"""Texture look-ups against one texel at a time."""

import math

import numpy as np
import torch

from bokehguide.render.textures import TextureAtlas
from bokehguide.scene.types import Texture


def bilinear(image: np.ndarray, u: float, v: float) -> np.ndarray:
    """Colour of a repeated `[H, W, 3]` image at (u, v), texel centres at half integers."""
    height, width = image.shape[:2]
    x, y = u * width - 0.5, v * height - 0.5
    color = np.zeros(3)
    for row in (math.floor(y), math.floor(y) + 1):
        for column in (math.floor(x), math.floor(x) + 1):
            weight = (1 - abs(y - row)) * (1 - abs(x - column))
            color += weight * image[row % height, column % width]
    return color


def test_lookups_are_bilinear_and_repeat():
    generator = np.random.default_rng(3)
    images = [generator.uniform(size=size + (3,)).astype(np.float16).astype(np.float32) for size in ((5, 3), (1, 1), (4, 16))]
    atlas = TextureAtlas()
    numbers = [atlas.add(Texture(image)) for image in images]
    atlas.build("cpu")
    number = generator.choice(numbers, 300)
    uv = generator.uniform(-2.5, 3.5, (2, 300)).astype(np.float32)
    uv[:, :6] = [[0.0, 1.0, -1.0, 0.5, 0.999999, -1e-9], [0.0, 1.0, 2.0, 0.5, 0.0, -1e-9]]
    found = atlas.lookup(torch.from_numpy(number), torch.from_numpy(uv))
    expected = np.stack([bilinear(images[n], *point) for n, point in zip(number, uv.T.astype(float))], axis=1)
    np.testing.assert_allclose(found[:3].numpy(), expected, atol=1e-4)


def test_texel_centres_give_the_texels_with_the_first_row_at_v_zero():
    image = np.arange(12, dtype=np.float32).reshape(2, 2, 3)
    atlas = TextureAtlas()
    atlas.add(Texture(image))
    uv = torch.tensor([[0.25, 0.75, 0.25, 0.75], [0.25, 0.25, 0.75, 0.75]])
    found = atlas.build("cpu").lookup(torch.zeros(4, dtype=torch.int64), uv)
    np.testing.assert_array_equal(found[:3].T.numpy(), image.reshape(4, 3))


def test_an_array_used_twice_is_stored_once_and_none_is_minus_one():
    atlas = TextureAtlas()
    image = np.ones((2, 3, 3), np.float32)
    assert (atlas.add(Texture(image)), atlas.add(Texture(image)), atlas.add(None)) == (0, 0, -1)
    assert atlas.build("cpu").texels.shape == (6,)
