"""Textures of a glTF file: images, samplers, KHR_texture_transform."""

from __future__ import annotations

import math
from dataclasses import fields

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.scene.gltf.document import Document
from bokehguide.scene.gltf.parts import Part
from bokehguide.scene.images import decode_texture
from bokehguide.scene.types import Material, Texture

REPEAT = 10497
WRAPS = {REPEAT: "repeat", 33071: "clamp", 33648: "mirror"}
NEAREST = 9728
MAX_UV_SET = 15
TRANSFORM = "KHR_texture_transform"
FORMATS = ("EXT_texture_webp", "EXT_texture_avif", "KHR_texture_basisu")
"""Extensions with an image in another format than PNG and JPEG, which replaces the texture's own."""


class Textures:
    """The textures of `document`. Each image is decoded once for each combination of colour space and alpha."""

    def __init__(self, document: Document):
        self.document = document
        self._images: dict[tuple[int, bool, bool], np.ndarray] = {}

    @property
    def images(self) -> set[int]:
        """Indices of the decoded images."""
        return {index for index, *_ in self._images}

    def read(self, owner: Part, key: str, srgb: bool = False, alpha: bool = False) -> Texture | None:
        """The texture `key` of `owner`; None if it is absent or in an unsupported format.

        srgb: decodes the colours from sRGB. alpha: keeps an alpha channel. Raises BokehguideError as
        `decode_texture` does.
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
        """The index of a texture's image; None, with a note, if its format is unsupported."""
        for part in (*map(texture.extension, FORMATS), texture):
            source = self.document.link(part, "source", "images")
            if source is not None:
                return source
        packed = ", ".join(texture.extensions) or "no image"
        self.document.note(f"textures in an unsupported format ({packed}): only the factors are used", texture.label)
        return None

    def _pixels(self, index: int, srgb: bool, alpha: bool) -> np.ndarray:
        """The decoded image `index`, float32 `[H, W, 3 or 4]`."""
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
        """The addressing modes of a texture's sampler along u and v."""
        index = self.document.link(texture, "sampler", "samplers")
        if index is None:
            return Texture.wrap
        sampler = self.document.items("samplers")[index]
        if NEAREST in (sampler.whole("magFilter", None), sampler.whole("minFilter", None)):
            self.document.note("nearest-texel filters: textures are sampled bilinearly", texture.label)
        across, down = sampler.whole("wrapS", REPEAT), sampler.whole("wrapT", REPEAT)
        for key, mode in (("wrapS", across), ("wrapT", down)):
            if mode not in WRAPS:
                sampler.fail(key, f"is none of {', '.join(map(str, WRAPS))}; repair the file")
        return WRAPS[across], WRAPS[down]


def _transform(part: Part) -> tuple[float, float, float, float, float, float]:
    """`Texture.transform` of KHR_texture_transform: scale, rotation from +u towards -v, offset.

    v points down, so that the rotation is anticlockwise in the image. The matrix in the extension's
    text rotates clockwise; Blender, Babylon.js and three.js rotate anticlockwise.
    """
    (du, dv), (su, sv) = part.numbers("offset", 2, (0.0, 0.0)), part.numbers("scale", 2, (1.0, 1.0))
    angle = part.number("rotation", 0.0)
    cos, sin = math.cos(angle), math.sin(angle)
    return (cos * su, sin * sv, du, -sin * su, cos * sv, dv)


def textures_of(material: Material) -> dict[str, Texture]:
    """The textures of `material` by field name."""
    given = {field.name: getattr(material, field.name) for field in fields(material)}
    return {name: value for name, value in given.items() if isinstance(value, Texture)}


def uv_sets(material: Material) -> int:
    """The number of texture coordinate sets that `material` needs."""
    return 1 + max((texture.uv_set for texture in textures_of(material).values()), default=-1)
