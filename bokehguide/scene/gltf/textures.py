"""Textures of a glTF file: images, samplers, KHR_texture_transform."""

from __future__ import annotations

import math
from dataclasses import fields

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.scene.gltf.document import Document, Part
from bokehguide.scene.images import decode_texture
from bokehguide.scene.types import Material, Texture

WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
NEAREST = 9728
MAX_UV_SET = 15
WEBP, BASISU, TRANSFORM = "EXT_texture_webp", "KHR_texture_basisu", "KHR_texture_transform"


class Textures:
    """Reads the textures of `document`; each image is decoded once for each of its uses."""

    def __init__(self, document: Document):
        self.document = document
        self._images: dict[tuple[int, bool, bool], np.ndarray] = {}

    @property
    def images(self) -> set[int]:
        """The images that were read."""
        return {index for index, *_ in self._images}

    def read(self, owner: Part, key: str, srgb: bool = False, alpha: bool = False) -> Texture | None:
        """The texture that `owner` has under `key`, None where it has none that can be read.

        srgb: its colours are encoded. alpha: a fourth channel is wanted where the image has one.
        """
        info = owner.part(key)
        index = self.document.link(info, "index", "textures")
        if index is None:
            return None
        texture = self.document.items("textures")[index]
        image = self._source(texture)
        if image is None:
            return None
        moved = info.extension(TRANSFORM)
        return Texture(
            image=self._pixels(image, srgb, alpha),
            uv_set=moved.whole("texCoord", info.whole("texCoord", 0, MAX_UV_SET), MAX_UV_SET),
            wrap=self._wrap(texture),
            transform=_transform(moved),
        )

    def _source(self, texture: Part) -> int | None:
        for part in (texture.extension(WEBP), texture):
            source = self.document.link(part, "source", "images")
            if source is not None and self.document.items("images")[source].values.get("mimeType") != "image/ktx2":
                return source
        packed = ", ".join(texture.extensions) or "no image"
        self.document.note(f"textures in a form that is not read ({packed}): the factors alone count", texture.label)
        return None

    def _pixels(self, index: int, srgb: bool, alpha: bool) -> np.ndarray:
        key = (index, srgb, alpha)
        if key not in self._images:
            image = self.document.items("images")[index]
            view = self.document.link(image, "bufferView", "bufferViews")
            if view is None and "uri" not in image:
                raise BokehguideError(f"{image.file}: {image.path}: has neither bufferView nor uri; repair the file")
            data = self.document.resource(image) if view is None else bytes(self.document.view(view))
            self._images[key] = decode_texture(data, f"{image.file}: {image.path}", self.document.files, srgb, alpha)
        return self._images[key]

    def _wrap(self, texture: Part) -> tuple[str, str]:
        index = self.document.link(texture, "sampler", "samplers")
        if index is None:
            return Texture.wrap
        sampler = self.document.items("samplers")[index]
        if NEAREST in (sampler.whole("magFilter"), sampler.whole("minFilter")):
            self.document.note("nearest-texel filters: textures are sampled bilinearly", texture.label)
        for key in ("wrapS", "wrapT"):
            if sampler.whole(key, 10497) not in WRAPS:
                sampler.fail(key, f"is none of {', '.join(map(str, WRAPS))}; repair the file")
        return WRAPS[sampler.whole("wrapS", 10497)], WRAPS[sampler.whole("wrapT", 10497)]


def _transform(part: Part) -> tuple[float, ...]:
    """Rows of scale, then rotation from +u towards -v, then offset.

    v points down, so that this is anticlockwise where the image is seen. The matrix printed
    in the extension turns the other way; Blender, Babylon.js and three.js do as is done here.
    """
    (du, dv), (su, sv) = part.numbers("offset", 2, (0.0, 0.0)), part.numbers("scale", 2, (1.0, 1.0))
    angle = part.number("rotation", 0.0)
    cos, sin = math.cos(angle), math.sin(angle)
    return (cos * su, sin * sv, du, -sin * su, cos * sv, dv)


def textures_of(material: Material) -> dict[str, Texture]:
    """The textures of `material` by the names of their fields."""
    given = {field.name: getattr(material, field.name) for field in fields(material)}
    return {name: value for name, value in given.items() if isinstance(value, Texture)}


def uv_sets(material: Material) -> int:
    """How many sets of texture coordinates the textures of `material` reach for."""
    return 1 + max((texture.uv_set for texture in textures_of(material).values()), default=-1)
