"""BSDFs of Mitsuba in the terms of `Material`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.color import LUMINANCE
from bokehguide.scene.anisotropy import from_alphas
from bokehguide.scene.disney_sheen import from_disney
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.images import nearest_texels
from bokehguide.scene.losses import Losses
from bokehguide.scene.mitsuba_xml.textures import GREY, Textures, color_of, is_image, kind_of, mean_of
from bokehguide.scene.mitsuba_xml.tree import Plugin, as_dictionary, mitsuba
from bokehguide.scene.types import Material, Texture, Vector, as_vector
from bokehguide.scene.vectors import fractions

REFRACTIVE_INDICES = {
    "vacuum": 1.0,
    "air": 1.000277,
    "water ice": 1.31,
    "water": 1.333,
    "acetone": 1.36,
    "ethanol": 1.361,
    "fused quartz": 1.458,
    "pyrex": 1.47,
    "acrylic glass": 1.49,
    "polypropylene": 1.49,
    "bk7": 1.5046,
    "diamond": 2.419,
}
"""Media that Mitsuba knows by name."""
GLASS = 1.5046
"""Mitsuba's refractive index of glass, unless the file gives another."""
ADAPTERS = ("twosided", "normalmap", "bumpmap", "mask")
SOLIDS = ("dielectric", "roughdielectric", "principled")
"""BSDFs whose light is refracted inside."""


class Materials:
    """The materials of a file, each converted once. lost: with the names of the objects."""

    def __init__(self, file: Path, files: SceneFiles):
        self._file, self._files = file, files
        self.textures = Textures(file, files, self.lose)
        self._known: dict[int, int] = {}
        self.all: list[Material] = []
        self.lost = Losses()

    def lose(self, what: str, name: str) -> None:
        """Note a loss of an object."""
        self.lost.add(what, name)

    def index(self, bsdf: Plugin | None, emission: dict[str, Any]) -> int:
        """The index of the material of a BSDF that has the given fields of emission."""
        key = id(bsdf) if not emission else -1
        if key not in self._known:
            color = (0.0, 0.0, 0.0) if emission else GREY  # of Mitsuba's shapes without a BSDF
            material = Material("default", color, specular=0.0) if bsdf is None else self.convert(bsdf)
            self.all.append(replace(material, **emission))
            if emission:
                return len(self.all) - 1
            self._known[key] = len(self.all) - 1
        return self._known[key]

    def turned(self, bsdf: Plugin | None) -> bool:
        """Whether the medium inside of a BSDF is the thinner one, so that the material suits the other side of the surface."""
        while bsdf is not None and bsdf.type in ADAPTERS and len(bsdf.inner("bsdf")) == 1:
            bsdf = bsdf.inner("bsdf")[0]
        if bsdf is None or bsdf.type not in SOLIDS:
            return False
        if bsdf.type == "principled":
            return mean_of(bsdf.values.get("spec_trans", 0.0)) > 0.0 and bsdf.number("eta", 1.5) < 1.0
        return self._ratio(bsdf, GLASS) < 1.0

    def convert(self, bsdf: Plugin) -> Material:
        """The closest material to a BSDF."""
        name, inner = bsdf.label, bsdf.inner("bsdf")
        if bsdf.type in ADAPTERS and len(inner) == 1:
            return self._wrapped(bsdf, replace(self.convert(inner[0]), name=name))
        if bsdf.type not in CONVERTERS:
            self.lose(f"BSDF {bsdf.type}: grey in its place", name)
            return Material(name, GREY, specular=0.0)
        return CONVERTERS[bsdf.type](self, bsdf)

    def _wrapped(self, bsdf: Plugin, material: Material) -> Material:
        """`material` within an adapter."""
        if bsdf.type == "normalmap":
            textures = bsdf.inner("texture")
            return replace(material, normal_texture=self.textures.read(textures[0], srgb=False) if textures else None)
        if bsdf.type == "bumpmap":
            self.lose("bump maps: left out", material.name)
        if bsdf.type == "mask":
            opacity = bsdf.values.get("opacity", 0.5)
            if isinstance(opacity, Plugin):
                return self._masked(material, self.textures.read(opacity))
            return replace(material, alpha_mode="blend", opacity=min(max(mean_of(opacity), 0.0), 1.0))
        return material

    def _masked(self, material: Material, mask: Texture | None) -> Material:
        """`material` with an opacity texture, whose luminance becomes the alpha of the base colour; None leaves it as it is."""
        if mask is None:
            return material
        color = material.base_color_texture or replace(mask, image=np.ones((1, 1, 3), np.float32))
        if (color.wrap, color.transform) != (mask.wrap, mask.transform):
            self.lose("opacity textures with other coordinates than the colour: those of the colour count", material.name)
        alpha = _luminance(mask)[..., None]
        height, width = np.maximum(color.image.shape[:2], alpha.shape[:2])
        if height * width > max(color.image[..., 0].size, alpha.size):
            self.lose("opacity textures of another aspect ratio than the colour: left out", material.name)
            return material
        self._files.reserve(4 * height * width, 0, f"{self._file}: {material.name}.opacity")
        both = [nearest_texels(image, height, width) for image in (color.image[..., :3], alpha)]
        return replace(material, alpha_mode="blend", base_color_texture=replace(color, image=np.concatenate(both, axis=2)))

    def _blend(self, bsdf: Plugin) -> Material:
        """A mixture of two BSDFs, `weight` of the second: one of the mean colour where only constant colours differ."""
        parts = [self.convert(each) for each in bsdf.inner("bsdf")]
        if len(parts) != 2:
            bsdf.fail("bsdf", f"are {len(parts)} BSDFs; give two")
        value = bsdf.values.get("weight", 0.5)
        image = self.textures.read(value) if is_image(value) else None
        weight = min(max(mean_of(value) if image is None else float(_luminance(image).mean()), 0.0), 1.0)
        larger = replace(parts[weight > 0.5], name=bsdf.label)
        colors = np.array([part.base_color for part in parts])
        plain = [replace(part, name=bsdf.label, base_color=GREY) for part in parts]
        if image is None and plain[0] == plain[1] and larger.base_color_texture is None:
            return replace(larger, base_color=as_vector((1.0 - weight) * colors[0] + weight * colors[1]))
        if 0.0 < weight < 1.0:
            self.lose("mixtures of BSDFs: the larger part counts", bsdf.label)
        return larger

    def _diffuse(self, bsdf: Plugin) -> Material:
        return Material(bsdf.label, specular=0.0, **self._color(bsdf, "reflectance"))

    def _roughdiffuse(self, bsdf: Plugin) -> Material:
        self.lose("roughness of diffuse BSDFs: left out", bsdf.label)
        return self._diffuse(bsdf)

    def _plastic(self, bsdf: Plugin) -> Material:
        rough = {"roughness": 0.0} if bsdf.type == "plastic" else self._roughness(bsdf, 0.1)
        tint, ior = self._tint(bsdf), self._ior(bsdf, 1.49)
        color, most = self._color(bsdf, "diffuse_reflectance"), max(tint)
        if bsdf.flag("nonlinear"):
            color = _saturated(color, ior)
        if most > 0.0:
            color["specular_color"] = as_vector(channel / most for channel in tint)
        return Material(bsdf.label, ior=ior, specular=most, **rough, **color)

    def _conductor(self, bsdf: Plugin) -> Material:
        color = fractions(self._metal(bsdf))
        if bsdf.type == "conductor":
            return Material(bsdf.label, color, metallic=1.0, roughness=0.0)
        alphas = [bsdf.values.get(key, bsdf.values.get("alpha", 0.1)) for key in ("alpha_u", "alpha_v")]
        textured = any(isinstance(alpha, Plugin) for alpha in alphas)
        rough = self._roughness(bsdf, 0.1) if textured else from_alphas(*map(mean_of, alphas))
        return Material(bsdf.label, color, metallic=1.0, single_scattering=True, **rough)

    def _dielectric(self, bsdf: Plugin) -> Material:
        rough = self._roughness(bsdf, 0.1) if bsdf.type == "roughdielectric" else {"roughness": 0.0}
        color = self._color(bsdf, "specular_transmittance", (1.0, 1.0, 1.0))
        if self._tint(bsdf) != (1.0, 1.0, 1.0):
            self.lose("specular_reflectance of dielectrics: 1.0 in its place", bsdf.label)
        thin = bsdf.type == "thindielectric"
        return Material(bsdf.label, transmission=1.0, thin=thin, ior=self._ior(bsdf, GLASS), **rough, **color)

    def _principled(self, bsdf: Plugin) -> Material:
        def scalar(key: str, default: float) -> float:
            if isinstance(bsdf.values.get(key), Plugin):
                self.lose(f"textures of {key}: {default} in their place", bsdf.label)
                return default
            return min(max(mean_of(bsdf.values.get(key, default)), 0.0), 1.0)

        packed = self._packed(bsdf.values.get("roughness"), bsdf.values.get("metallic"), bsdf.label)
        for key in ("spec_tint", "flatness"):
            if isinstance(bsdf.values.get(key), Plugin) or mean_of(bsdf.values.get(key, 0.0)) > 0.0:
                self.lose(f"{key} of principled BSDFs: left out", bsdf.label)
        color, sheen = self._color(bsdf, "base_color"), scalar("sheen", 0.0)
        metallic = 1.0 if is_image(bsdf.values.get("metallic")) else scalar("metallic", 0.0)
        if is_image(bsdf.values.get("roughness")):
            rough: dict[str, Any] = {"roughness": 1.0}
            if scalar("anisotropic", 0.0) > 0.0:
                self.lose("anisotropic of principled BSDFs with a texture of roughness: left out", bsdf.label)
        else:
            aspect, alpha = math.sqrt(1.0 - 0.9 * scalar("anisotropic", 0.0)), scalar("roughness", 0.5) ** 2
            rough = from_alphas(alpha / aspect, alpha * aspect)
        tint = scalar("sheen_tint", 0.0) if sheen > 0.0 else 0.0
        if tint > 0.0 and "base_color_texture" in color:
            self.lose("sheen_tint of principled BSDFs with a texture: a white sheen", bsdf.label)
        ior = _principled_ior(bsdf)
        return Material(
            bsdf.label,
            metallic=metallic,
            single_scattering=metallic > 0.0,
            ior=ior,
            specular=float(ior > 1.0),
            transmission=scalar("spec_trans", 0.0),
            clearcoat=scalar("clearcoat", 0.0),
            clearcoat_roughness=1.0 - scalar("clearcoat_gloss", 0.0),
            **from_disney(sheen, tint, color["base_color"], metallic),
            **packed,
            **rough,
            **color,
        )

    def _roughness(self, bsdf: Plugin, default: float) -> dict[str, Any]:
        """The fields of the roughness whose square is Mitsuba's α."""
        value = bsdf.values.get("alpha", bsdf.values.get("alpha_u", default))
        if "alpha_u" in bsdf.values and bsdf.values["alpha_u"] != bsdf.values.get("alpha_v"):
            self.lose("anisotropic roughness: that along u counts", bsdf.label)
        if is_image(value):
            packed = self._packed(value, None, bsdf.label)["metallic_roughness_texture"]
            return {"roughness": 1.0, "metallic_roughness_texture": replace(packed, image=np.sqrt(packed.image))}
        if isinstance(value, Plugin):
            self.lose("textures of roughness: left out", bsdf.label)
            value = default
        return {"roughness": math.sqrt(min(max(mean_of(value), 0.0), 1.0))}

    def _packed(self, roughness: Any, metallic: Any, name: str) -> dict[str, Any]:
        """The texture of the luminances of two images, as glTF packs them; without images no field."""
        given = {channel: self.textures.read(value) for channel, value in ((1, roughness), (2, metallic)) if is_image(value)}
        found = {channel: texture for channel, texture in given.items() if texture is not None}
        if not found:
            return {}
        first = next(iter(found.values()))
        height, width = np.max([texture.image.shape[:2] for texture in found.values()], axis=0)
        image = np.ones((height, width, 3), np.float32)
        for channel, texture in found.items():
            if (texture.wrap, texture.transform) != (first.wrap, first.transform):
                self.lose("metallic of other texture coordinates than roughness: those of roughness count", name)
            image[..., channel] = nearest_texels(_luminance(texture), height, width)
        return {"metallic_roughness_texture": replace(first, image=image)}

    def _ior(self, bsdf: Plugin, default: float) -> float:
        """The refractive index of the denser medium, relative to that of the thinner one."""
        ratio = self._ratio(bsdf, default)
        if ratio < 1.0 and bsdf.type not in SOLIDS:
            self.lose(f"{bsdf.type} with int_ior below ext_ior: both exchanged", bsdf.label)
        return max(ratio, 1.0 / ratio)

    def _ratio(self, bsdf: Plugin, default: float) -> float:
        """The ratio of the refractive indices inside and outside. default: the index inside unless the file has one."""
        inside, outside = (self._index(bsdf, key, value) for key, value in (("int_ior", default), ("ext_ior", 1.000277)))
        return inside / outside

    def _index(self, bsdf: Plugin, key: str, default: float) -> float:
        value = bsdf.values.get(key, default)
        if isinstance(value, str):
            if value not in REFRACTIVE_INDICES:
                bsdf.fail(key, "is no medium that is known; give a number")
            return REFRACTIVE_INDICES[value]
        return max(bsdf.number(key, default), 1e-3)

    def _tint(self, bsdf: Plugin) -> Vector:
        """The factor of the specular reflection."""
        value = bsdf.values.get("specular_reflectance", 1.0)
        color = color_of(value, bsdf.place)
        if color is None:
            self.lose(f"specular_reflectance of the type {kind_of(value)}: 1.0 in its place", bsdf.label)
            return 1.0, 1.0, 1.0
        return fractions(color)

    def _metal(self, bsdf: Plugin) -> Any:
        """The reflectance of a conductor at normal incidence, by Mitsuba itself."""
        given = {key: bsdf.values[key] for key in ("material", "eta", "k", "specular_reflectance") if key in bsdf.values}
        plain = {key: as_dictionary(value) for key, value in given.items()}
        for key in (key for key, value in plain.items() if value is None):
            self.lose(f"{key} of the type {kind_of(given[key])}: left out", bsdf.label)
        with mitsuba(bsdf.place) as mi:
            try:
                metal = mi.load_dict({"type": "conductor"} | {key: value for key, value in plain.items() if value is not None})
            except RuntimeError:
                bsdf.fail("material", "is no conductor that Mitsuba knows; give another one")
            at = mi.SurfaceInteraction3f()
            at.wi = mi.Vector3f(0.0, 0.0, 1.0)
            _, weight = metal.sample(mi.BSDFContext(), at, 0.5, mi.Point2f(0.5, 0.5))
            return np.array(weight, np.float64).ravel()[:3]

    def _color(self, bsdf: Plugin, key: str, default: Vector = GREY) -> dict[str, Any]:
        """Base colour and its texture from a colour or an image."""
        value = bsdf.values.get(key, default)
        if is_image(value):
            return {"base_color": (1.0, 1.0, 1.0), "base_color_texture": self.textures.read(value, srgb=True)}
        color = color_of(value, bsdf.place)
        if color is None:
            self.lose(f"texture {kind_of(value)}: grey in its place", bsdf.label)
        return {"base_color": fractions(color or GREY)}


CONVERTERS: dict[str, Callable[[Materials, Plugin], Material]] = {
    "blendbsdf": Materials._blend,
    "diffuse": Materials._diffuse,
    "roughdiffuse": Materials._roughdiffuse,
    **dict.fromkeys(("plastic", "roughplastic", "pplastic"), Materials._plastic),
    **dict.fromkeys(("conductor", "roughconductor"), Materials._conductor),
    **dict.fromkeys(("dielectric", "roughdielectric", "thindielectric"), Materials._dielectric),
    "principled": Materials._principled,
}
"""Converters of BSDFs by the name of the plugin."""


def _luminance(texture: Texture) -> np.ndarray:
    """The luminance of the texels between 0 and 1, `[H, W]`."""
    return (texture.image[..., :3] @ LUMINANCE.astype(np.float32)).clip(0.0, 1.0)


def _saturated(color: dict[str, Any], ior: float) -> dict[str, Any]:
    """The fields of `_color` for the `nonlinear` plastic of Mitsuba.

    The base colours light again after each reflection on the inside. Other plastics have the light that a white base would lose.
    """
    with mitsuba("plastic") as mi:
        inside = float(mi.fresnel_diffuse_reflectance(1.0 / ior))
    texture = color.get("base_color_texture")
    again = lambda base: base * (1.0 - inside) / (1.0 - inside * base)  # noqa: E731
    if texture is not None:
        color["base_color_texture"] = replace(texture, image=again(texture.image.clip(max=1.0)))
    return color | {"base_color": as_vector(again(channel) for channel in color["base_color"])}


def _principled_ior(bsdf: Plugin) -> float:
    """The refractive index of a principled BSDF, at least 1. `specular` is a reflectance at normal incidence of 0.08."""
    if "eta" in bsdf.values:
        eta = max(bsdf.number("eta", 1.5), 1e-3)
        return max(eta, 1.0 / eta)
    root = math.sqrt(min(max(0.08 * bsdf.number("specular", 0.5), 0.0), 0.99))
    return (1.0 + root) / (1.0 - root)
