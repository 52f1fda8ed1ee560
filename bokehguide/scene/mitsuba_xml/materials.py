"""BSDFs of Mitsuba in the terms of `Material`."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from bokehguide.color import LUMINANCE
from bokehguide.image.reading import read_channels
from bokehguide.scene.anisotropy import from_alphas
from bokehguide.scene.disney_sheen import from_disney
from bokehguide.scene.files import SceneFiles, require_file
from bokehguide.scene.images import checks, load_texture, nearest_texels
from bokehguide.scene.mitsuba_xml.tree import Plugin, as_dictionary, mitsuba
from bokehguide.scene.types import Material, Texture, Vector, as_vector

GREY = (0.5, 0.5, 0.5)
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
WRAPS = {"repeat": "repeat", "mirror": "mirror", "clamp": "clamp"}


class Materials:
    """The materials of a file, each converted once. lost: what they lose, in words, with the names of the BSDFs."""

    def __init__(self, file: Path, files: SceneFiles):
        self._file, self._files = file, files
        self._known: dict[int, int] = {}
        self.all: list[Material] = []
        self.lost: dict[str, dict[str, None]] = {}

    def lose(self, what: str, name: str) -> None:
        """Note a loss of an object."""
        self.lost.setdefault(what, {})[name] = None

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
            return _mean(bsdf.values.get("spec_trans", 0.0)) > 0.0 and bsdf.number("eta", 1.5) < 1.0
        return self._ratio(bsdf, GLASS) < 1.0

    def convert(self, bsdf: Plugin) -> Material:
        """The closest material to a BSDF."""
        name, inner = bsdf.name or bsdf.type, bsdf.inner("bsdf")
        if bsdf.type in ADAPTERS and len(inner) == 1:
            return self._wrapped(bsdf, replace(self.convert(inner[0]), name=name))
        convert = getattr(self, f"_{bsdf.type}", None)
        if convert is None or bsdf.type not in KNOWN:
            self.lose(f"BSDF {bsdf.type}: grey in its place", name)
            return Material(name, GREY, specular=0.0)
        return convert(bsdf, name)

    def _wrapped(self, bsdf: Plugin, material: Material) -> Material:
        """`material` within an adapter."""
        if bsdf.type == "normalmap":
            textures = bsdf.inner("texture")
            return replace(material, normal_texture=self.texture(textures[0], srgb=False) if textures else None)
        if bsdf.type == "bumpmap":
            self.lose("bump maps: left out", material.name)
        if bsdf.type == "mask":
            opacity = bsdf.values.get("opacity", 0.5)
            if isinstance(opacity, Plugin):
                return self._masked(material, self.texture(opacity))
            return replace(material, alpha_mode="blend", opacity=min(max(_mean(opacity), 0.0), 1.0))
        return material

    def _masked(self, material: Material, mask: Texture | None) -> Material:
        """`material` with an opacity texture, whose luminance becomes the alpha of the base colour; None leaves it as it is."""
        if mask is None:
            return material
        color = material.base_color_texture or replace(mask, image=np.ones((1, 1, 3), np.float32))
        if (color.wrap, color.transform) != (mask.wrap, mask.transform):
            self.lose("opacity textures with other coordinates than the colour: those of the colour count", material.name)
        alpha = (mask.image[..., :3] @ LUMINANCE.astype(np.float32)).clip(0.0, 1.0)[..., None]
        height, width = np.maximum(color.image.shape[:2], alpha.shape[:2])
        if height * width > max(color.image[..., 0].size, alpha.size):
            self.lose("opacity textures of another aspect ratio than the colour: left out", material.name)
            return material
        self._files.reserve(4 * height * width, 0, f"{self._file}: {material.name}.opacity")
        both = [nearest_texels(image, height, width) for image in (color.image[..., :3], alpha)]
        return replace(material, alpha_mode="blend", base_color_texture=replace(color, image=np.concatenate(both, axis=2)))

    def _diffuse(self, bsdf: Plugin, name: str) -> Material:
        return Material(name, specular=0.0, **self._color(bsdf, "reflectance"))

    def _roughdiffuse(self, bsdf: Plugin, name: str) -> Material:
        self.lose("roughness of diffuse BSDFs: left out", name)
        return self._diffuse(bsdf, name)

    def _plastic(self, bsdf: Plugin, name: str) -> Material:
        rough = {"roughness": 0.0} if bsdf.type == "plastic" else self._roughness(bsdf, 0.1)
        tint, ior = self._tint(bsdf, name), self._ior(bsdf, name, 1.49)
        color, most = self._color(bsdf, "diffuse_reflectance"), max(tint)
        if bsdf.flag("nonlinear"):
            color = _saturated(color, ior)
        if most > 0.0:
            color["specular_color"] = as_vector(channel / most for channel in tint)
        return Material(name, ior=ior, specular=most, **rough, **color)

    _roughplastic = _pplastic = _plastic

    def _conductor(self, bsdf: Plugin, name: str) -> Material:
        color = as_vector(min(max(float(each), 0.0), 1.0) for each in self._metal(bsdf, name))
        if bsdf.type == "conductor":
            return Material(name, color, metallic=1.0, roughness=0.0)
        alphas = [bsdf.values.get(key, bsdf.values.get("alpha", 0.1)) for key in ("alpha_u", "alpha_v")]
        textured = any(isinstance(alpha, Plugin) for alpha in alphas)
        rough = self._roughness(bsdf, 0.1) if textured else from_alphas(*map(_mean, alphas))
        return Material(name, color, metallic=1.0, single_scattering=True, **rough)

    _roughconductor = _conductor

    def _dielectric(self, bsdf: Plugin, name: str) -> Material:
        rough = self._roughness(bsdf, 0.1) if bsdf.type == "roughdielectric" else {"roughness": 0.0}
        color = self._color(bsdf, "specular_transmittance", (1.0, 1.0, 1.0))
        if self._tint(bsdf, name) != (1.0, 1.0, 1.0):
            self.lose("specular_reflectance of dielectrics: 1.0 in its place", name)
        thin = bsdf.type == "thindielectric"
        return Material(name, transmission=1.0, thin=thin, ior=self._ior(bsdf, name, GLASS), **rough, **color)

    _roughdielectric = _thindielectric = _dielectric

    def _principled(self, bsdf: Plugin, name: str) -> Material:
        def scalar(key: str, default: float) -> float:
            if isinstance(bsdf.values.get(key), Plugin):
                self.lose(f"textures of {key}: {default} in their place", name)
                return default
            return min(max(_mean(bsdf.values.get(key, default)), 0.0), 1.0)

        packed = self._packed(bsdf.values.get("roughness"), bsdf.values.get("metallic"), name)
        for key in ("spec_tint", "flatness"):
            if isinstance(bsdf.values.get(key), Plugin) or _mean(bsdf.values.get(key, 0.0)) > 0.0:
                self.lose(f"{key} of principled BSDFs: left out", name)
        color, sheen = self._color(bsdf, "base_color"), scalar("sheen", 0.0)
        metallic = 1.0 if is_image(bsdf.values.get("metallic")) else scalar("metallic", 0.0)
        if is_image(bsdf.values.get("roughness")):
            rough: dict[str, Any] = {"roughness": 1.0}
            if scalar("anisotropic", 0.0) > 0.0:
                self.lose("anisotropic of principled BSDFs with a texture of roughness: left out", name)
        else:
            aspect, alpha = math.sqrt(1.0 - 0.9 * scalar("anisotropic", 0.0)), scalar("roughness", 0.5) ** 2
            rough = from_alphas(alpha / aspect, alpha * aspect)
        tint = scalar("sheen_tint", 0.0) if sheen > 0.0 else 0.0
        if tint > 0.0 and "base_color_texture" in color:
            self.lose("sheen_tint of principled BSDFs with a texture: a white sheen", name)
        ior = _principled_ior(bsdf)
        return Material(
            name,
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
            self.lose("anisotropic roughness: that along u counts", bsdf.name or bsdf.type)
        if is_image(value):
            packed = self._packed(value, None, bsdf.name or bsdf.type)["metallic_roughness_texture"]
            return {"roughness": 1.0, "metallic_roughness_texture": replace(packed, image=np.sqrt(packed.image))}
        if isinstance(value, Plugin):
            self.lose("textures of roughness: left out", bsdf.name or bsdf.type)
            value = default
        return {"roughness": math.sqrt(min(max(_mean(value), 0.0), 1.0))}

    def _packed(self, roughness: Any, metallic: Any, name: str) -> dict[str, Any]:
        """The texture of the luminances of two images, as glTF packs them; without images no field."""
        given = {channel: self.texture(value) for channel, value in ((1, roughness), (2, metallic)) if is_image(value)}
        found = {channel: texture for channel, texture in given.items() if texture is not None}
        if not found:
            return {}
        first = next(iter(found.values()))
        height, width = np.max([texture.image.shape[:2] for texture in found.values()], axis=0)
        image = np.ones((height, width, 3), np.float32)
        for channel, texture in found.items():
            if (texture.wrap, texture.transform) != (first.wrap, first.transform):
                self.lose("metallic of other texture coordinates than roughness: those of roughness count", name)
            rows, columns = (np.arange(size) * old // size for size, old in zip((height, width), texture.image.shape))
            luminance = texture.image[..., :3] @ np.array(LUMINANCE, np.float32)
            image[..., channel] = luminance[rows[:, None], columns].clip(0.0, 1.0)
        return {"metallic_roughness_texture": replace(first, image=image)}

    def _ior(self, bsdf: Plugin, name: str, default: float) -> float:
        """The refractive index of the denser medium, relative to that of the thinner one."""
        ratio = self._ratio(bsdf, default)
        if ratio < 1.0 and bsdf.type not in SOLIDS:
            self.lose(f"{bsdf.type} with int_ior below ext_ior: both exchanged", name)
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

    def _tint(self, bsdf: Plugin, name: str) -> Vector:
        """The factor of the specular reflection."""
        value = bsdf.values.get("specular_reflectance", 1.0)
        color = color_of(value, bsdf.place)
        if color is None:
            self.lose(f"specular_reflectance of the type {kind_of(value)}: 1.0 in its place", name)
            return 1.0, 1.0, 1.0
        return as_vector(min(max(channel, 0.0), 1.0) for channel in color)

    def _metal(self, bsdf: Plugin, name: str) -> Any:
        """The reflectance of a conductor at normal incidence, by Mitsuba itself."""
        given = {key: bsdf.values[key] for key in ("material", "eta", "k", "specular_reflectance") if key in bsdf.values}
        plain = {key: as_dictionary(value) for key, value in given.items()}
        for key in (key for key, value in plain.items() if value is None):
            self.lose(f"{key} of the type {kind_of(given[key])}: left out", name)
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
            return {"base_color": (1.0, 1.0, 1.0), "base_color_texture": self.texture(value, srgb=True)}
        color = color_of(value, bsdf.place)
        if color is None:
            self.lose(f"texture {kind_of(value)}: grey in its place", bsdf.name or bsdf.type)
        return {"base_color": as_vector(min(max(channel, 0.0), 1.0) for channel in color or GREY)}

    def texture(self, texture: Plugin, srgb: bool = True) -> Texture | None:
        """A bitmap or a checkerboard; None for another texture."""
        if not is_image(texture):
            self.lose(f"texture {texture.type}: left out", texture.name or texture.type)
            return None
        image = self._checks(texture) if texture.type == "checkerboard" else self._bitmap(texture, srgb)
        wrap, matrix = WRAPS.get(texture.text("wrap_mode", "repeat"), "repeat"), texture.matrix("to_uv")
        return Texture(image, wrap=(wrap, wrap), transform=tuple(matrix[[0, 0, 0, 1, 1, 1], [0, 1, 3, 0, 1, 3]].tolist()))

    def _bitmap(self, texture: Plugin, srgb: bool) -> np.ndarray:
        """The pixels of a file, linear float32 `[H, W, 3]`."""
        path = self._files.find(self._file.parent, texture.text("filename"), f"{texture.place}.filename")
        require_file(path, "texture", f"{texture.place}.filename")
        raw = not srgb or texture.flag("raw")
        return self._floats(path) if path.suffix.lower() in (".exr", ".hdr") else load_texture(path, self._files, not raw)

    def _checks(self, texture: Plugin) -> np.ndarray:
        """A checkerboard, linear float32 `[H, W, 3]`."""
        given = [texture.values.get(key, default) for key, default in (("color0", 0.4), ("color1", 0.2))]
        colors = [color_of(value, texture.place) for value in given]
        if None in colors:
            self.lose("textures in a checkerboard: grey in their place", texture.name or texture.type)
        image = checks(*(np.array(color or GREY, np.float32).clip(min=0.0) for color in colors))
        self._files.reserve(image.size, 0, texture.place)
        return image

    def _floats(self, path: Path) -> np.ndarray:
        """An image of linear floats, `[H, W, 3]`."""
        read = read_channels(path, path.suffix.upper().removeprefix("."))
        names = "RGB" if set("RGB") <= set(read.names) else (read.names[0],) * 3
        image = np.stack([read.pixels[..., read.names.index(name)] for name in names], axis=-1)
        self._files.reserve(image.size, path.stat().st_size, str(path))
        return np.nan_to_num(image, posinf=0.0, neginf=0.0).astype(np.float32)


KNOWN = {
    *("diffuse", "roughdiffuse", "plastic", "roughplastic", "pplastic", "conductor", "roughconductor", "principled"),
    *("dielectric", "roughdielectric", "thindielectric"),
}
"""BSDFs that have a counterpart."""


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


def is_image(value: Any) -> TypeGuard[Plugin]:
    """Whether a property is an image of a file or a checkerboard."""
    if not isinstance(value, Plugin):
        return False
    return value.type == "checkerboard" or (value.type == "bitmap" and isinstance(value.values.get("filename"), str))


def kind_of(value: Any) -> str:
    """The plugin of a property that is a plugin or a spectrum."""
    return value.type if isinstance(value, Plugin) else "spectrum"


def color_of(value: Any, place: str, light: bool = False) -> Vector | None:
    """A colour as linear RGB, that of spectra by Mitsuba itself. None for a texture, and for a spectrum without a colour there.

    light: whether the colour is that of an emitter. place: of the plugin, for errors.
    """
    if isinstance(value, (int, float)):
        return float(value), float(value), float(value)
    if isinstance(value, tuple) and len(value) == 3:
        return as_vector(value)
    plain = as_dictionary(value)
    if plain is None:
        return None
    with mitsuba(place) as mi:
        at = mi.SurfaceInteraction3f()
        at.wi = mi.Vector3f(0.0, 0.0, 1.0)
        try:
            if light:
                found = mi.load_dict({"type": "constant", "radiance": plain}).eval(at)
            else:
                found = mi.load_dict({"type": "diffuse", "reflectance": plain}).eval_diffuse_reflectance(at)
        except (RuntimeError, TypeError, ValueError):
            return None
        return as_vector(float(channel) for channel in np.ravel(np.array(found)))


def _principled_ior(bsdf: Plugin) -> float:
    """The refractive index of a principled BSDF, at least 1. `specular` is a reflectance at normal incidence of 0.08."""
    if "eta" in bsdf.values:
        eta = max(bsdf.number("eta", 1.5), 1e-3)
        return max(eta, 1.0 / eta)
    root = math.sqrt(min(max(0.08 * bsdf.number("specular", 0.5), 0.0), 0.99))
    return (1.0 + root) / (1.0 - root)


def _mean(value: Any) -> float:
    """The mean of a colour or of a spectrum, 0.5 for anything else."""
    values = getattr(value, "values", value)
    values = values() if callable(values) else values
    try:
        mean = float(np.mean(np.asarray(values, np.float64)))
    except (TypeError, ValueError):
        return 0.5
    return mean if math.isfinite(mean) else 0.5
