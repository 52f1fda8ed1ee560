"""Texture look-ups against one texel at a time."""

import math
from itertools import product

import numpy as np
import pytest
import torch

from bokehguide.render.textures import TextureAtlas
from bokehguide.scene.types import Texture


def texel(index: int, size: int, wrap: str) -> int:
    """The texel that stands at an index beyond the image."""
    if wrap == "clamp":
        return min(max(index, 0), size - 1)
    if wrap == "mirror":
        index %= 2 * size
        return index if index < size else 2 * size - 1 - index
    return index % size


def bilinear(texture: Texture, u: float, v: float) -> np.ndarray:
    """Colour of a texture at the mesh's (u, v), texel centres at half integers."""
    a, b, c, d, e, f = texture.transform
    height, width = texture.image.shape[:2]
    x, y = (a * u + b * v + c) * width - 0.5, (d * u + e * v + f) * height - 0.5
    color = np.zeros(texture.image.shape[2])
    for row in (math.floor(y), math.floor(y) + 1):
        for column in (math.floor(x), math.floor(x) + 1):
            weight = (1 - abs(y - row)) * (1 - abs(x - column))
            color += weight * texture.image[texel(row, height, texture.wrap[1]), texel(column, width, texture.wrap[0])]
    return color


def images(*sizes: tuple[int, int, int]) -> list[np.ndarray]:
    """Random images that half floats hold exactly."""
    generator = np.random.default_rng(3)
    return [generator.uniform(size=size).astype(np.float16).astype(np.float32) for size in sizes]


def looked_up(textures: list[Texture], number: np.ndarray, uv: np.ndarray) -> np.ndarray:
    atlas = TextureAtlas()
    numbers = np.array([atlas.add(texture) for texture in textures])
    found = atlas.build("cpu").lookup(torch.from_numpy(numbers[number]), torch.from_numpy(uv.astype(np.float32)))
    return found.numpy()


def check(textures: list[Texture]) -> None:
    """Look-ups of RGB at 400 places each, some of them on the borders, against the slow way."""
    generator = np.random.default_rng(4)
    number = generator.integers(0, len(textures), 400)
    uv = generator.uniform(-2.5, 3.5, (2, 400)).astype(np.float32)
    uv[:, :6] = [[0.0, 1.0, -1.0, 0.5, 0.999999, -1e-9], [0.0, 1.0, 2.0, 0.5, 0.0, -1e-9]]
    found = looked_up(textures, number, uv)
    expected = np.stack([bilinear(textures[n], *point)[:3] for n, point in zip(number, uv.T.astype(float))], axis=1)
    np.testing.assert_allclose(found[:3], expected, atol=1e-4)


def test_lookups_are_bilinear_and_repeat():
    check([Texture(image) for image in images((5, 3, 3), (1, 1, 3), (4, 16, 3))])


def test_each_axis_wraps_in_its_own_way():
    """Also images of one and of two texels, where both neighbours fold back."""
    ways = list(product(("repeat", "clamp", "mirror"), repeat=2))
    check([Texture(image, wrap=way) for image in images((5, 3, 3), (1, 2, 3)) for way in ways])


def test_transforms_come_before_wrapping():
    turn, scale = 0.7, (2.0, -0.5)
    cosine, sine = math.cos(turn), math.sin(turn)
    rotated = (scale[0] * cosine, scale[1] * sine, 0.3, -scale[0] * sine, scale[1] * cosine, -0.2)
    first, second = images((5, 3, 3), (4, 4, 4))
    moved = Texture(second, transform=(1.0, 0.0, 0.5, 0.0, 1.0, 0.0))
    check([Texture(first, wrap=("clamp", "mirror"), transform=rotated), Texture(first), moved])


def test_alpha_is_the_fourth_channel_and_1_where_there_is_none():
    with_alpha, without = images((4, 4, 4), (3, 3, 3))
    uv = np.random.default_rng(5).uniform(0, 1, (2, 100)).astype(np.float32)
    found = looked_up([Texture(with_alpha), Texture(without)], np.arange(100) % 2, uv)
    expected = [bilinear(Texture(with_alpha), *point)[3] for point in uv.T[::2]]
    np.testing.assert_allclose(found[3, ::2], expected, atol=1e-5)
    np.testing.assert_allclose(found[3, 1::2], 1.0, rtol=1e-6)


def test_texel_centres_give_the_texels_with_the_first_row_at_v_zero():
    image = np.arange(12, dtype=np.float32).reshape(2, 2, 3)
    uv = np.array([[0.25, 0.75, 0.25, 0.75], [0.25, 0.25, 0.75, 0.75]])
    np.testing.assert_array_equal(looked_up([Texture(image)], np.zeros(4, int), uv)[:3].T, image.reshape(4, 3))


def test_what_half_floats_cannot_hold_is_scaled():
    bright = np.full((2, 2, 3), 0.5, np.float32)
    bright[0, 0], bright[1, 1] = (3e6, 70_000.0, 1.0), (65_504.0, 1e6, 0.25)
    dim = np.full((1, 1, 3), 0.25, np.float32)
    uv = np.array([[0.25, 0.75, 0.75, 0.0], [0.25, 0.75, 0.25, 0.0]])
    found = looked_up([Texture(bright), Texture(dim)], np.array([0, 0, 0, 1]), uv)
    expected = np.stack([bright[0, 0], bright[1, 1], bright[0, 1], dim[0, 0]], axis=1)
    np.testing.assert_allclose(found[:3], expected, rtol=1e-3)
    np.testing.assert_allclose(found[3], 1.0, rtol=1e-3)


@pytest.mark.parametrize("bits", [8, 16])
def test_normals_keep_their_digits_near_the_flat_one(bits):
    """Steps of a 16-bit map about its middle are 3e-5, finer than half floats resolve about 0.5."""
    top = 2**bits - 1
    levels = np.linspace(0.5 - 100.0 / top, 0.5 + 100.0 / top, 201)
    atlas = TextureAtlas()
    number = atlas.add(Texture(np.tile(levels[None, :, None], (1, 1, 3)).astype(np.float32)), signed=True)
    uv = torch.stack((torch.from_numpy((np.arange(201) + 0.5) / 201).float(), torch.zeros(201)))
    found = atlas.build("cpu").lookup(torch.full((201,), number), uv)
    np.testing.assert_allclose(found[0].numpy(), 2.0 * levels - 1.0, atol=0.15 / top)


def test_an_image_used_twice_is_stored_once_and_none_is_minus_one():
    atlas = TextureAtlas()
    image = np.ones((2, 3, 3), np.float32)
    assert (atlas.add(Texture(image)), atlas.add(Texture(image)), atlas.add(None)) == (0, 0, -1)
    assert atlas.add(Texture(image, wrap=("clamp", "clamp"))) == 1
    assert atlas.build("cpu").texels.shape == (6,)


def test_uv_sets_are_those_that_textures_use():
    atlas = TextureAtlas()
    for image, uv_set in zip(images((2, 2, 3), (2, 2, 3), (2, 2, 3)), (3, 0, 3)):
        atlas.add(Texture(image, uv_set))
    atlas.build("cpu")
    assert atlas.uv_sets == (0, 3)
    assert atlas.uv_set.tolist() == [1, 0, 1]
