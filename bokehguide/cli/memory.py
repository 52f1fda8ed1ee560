"""Memory that would run out or has run out, in one line."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from bokehguide.errors import BokehguideError, reason

if TYPE_CHECKING:
    from bokehguide.scene import Scene
    from bokehguide.train import RenderSettings

PIXEL_BYTES, TRIANGLE_BYTES, TEXEL_BYTES, MAP_TEXEL_BYTES = 250, 250, 20, 60
"""Least memory of a render for each pixel of the film, triangle, texel of a texture, and texel of the environment map."""
MATTE_BYTES = 190
"""Least memory of the mattes for each pixel of the film."""
GROUP_BYTES = 24
"""Least memory of a light group for each pixel of the film."""
EXHAUSTED = ("allocate memory", "out of memory", "bad_alloc", "start new thread")
"""Parts of the messages of PyTorch, C++ and Python where memory has run out."""


@contextmanager
def explained(what: str = "the scene") -> Iterator[None]:
    """Turn an error of memory that has run out into a BokehguideError. what: the part of the input that took it."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and not any(words in str(error) for words in EXHAUSTED):
            raise
        raise BokehguideError(
            f"memory ran out ({_amount(error)}): {what} is too large for this machine; lower --size or --threads, "
            "or give fewer triangles and smaller textures"
        ) from error


def _amount(error: Exception) -> str:
    """The memory that was refused, in words."""
    asked = re.search(r"allocate (\d+) bytes", str(error))
    return f"{int(asked[1]) / 1e9:.2g} GB more were needed" if asked else reason(error)


def describe(scene: Scene) -> str:
    """The sizes of a scene that take memory, in words."""
    triangles = sum(len(mesh.triangles) for mesh in scene.meshes)
    return f"a picture of {scene.film.width}x{scene.film.height} pixels with {triangles:,} triangles"


def check_memory(scene: Scene, settings: RenderSettings) -> None:
    """Raise BokehguideError if a render needs more memory than is free; estimates are low."""
    from bokehguide.memory import free_memory  # here, as the command line imports this module first

    free, needed = free_memory(), least_memory(scene, settings)
    if free is not None and needed > free:
        raise BokehguideError(
            f"memory: {describe(scene)} takes at least {needed / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free; "
            "lower --size, or give fewer triangles and smaller textures"
        )


def least_memory(scene: Scene, settings: RenderSettings) -> int:
    """Bytes that a render needs at least, beside its scene."""
    from bokehguide.scene import Texture
    from bokehguide.scene.light_groups import find_light_groups

    *_, width, height = settings.window(scene.film.width, scene.film.height)
    films = 1 if settings.target_noise is None else 2
    triangles = sum(len(mesh.triangles) for mesh in scene.meshes)
    textures = [value for each in scene.materials for value in vars(each).values() if isinstance(value, Texture)]
    images = {id(texture.image): texture.image.size // 3 for texture in textures}
    sky = 0 if scene.environment is None else scene.environment.radiance.size // 3
    surfaces = TRIANGLE_BYTES * triangles + TEXEL_BYTES * sum(images.values())
    groups = len(find_light_groups(scene).names) if settings.light_groups else 0
    pixel_bytes = PIXEL_BYTES + MATTE_BYTES * settings.cryptomatte + GROUP_BYTES * groups
    return pixel_bytes * width * height * films + surfaces + MAP_TEXEL_BYTES * sky
