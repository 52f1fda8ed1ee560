"""UsdPreviewSurface in the terms of `Material`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bokehguide.errors import printable
from bokehguide.limits import LARGEST
from bokehguide.scene.images import nearest_texels
from bokehguide.scene.types import Material, Texture, Vector, as_vector
from bokehguide.scene.usd.libraries import UsdGeom, UsdShade
from bokehguide.scene.usd.stage import Stage
from bokehguide.scene.usd.textures import Source, Textures, connected_output

SURFACES = ("UsdPreviewSurface", "ND_UsdPreviewSurface_surfaceshader")
PURPOSES = ("full", "preview")
DISPLAY_COLOR = "displayColor"
F0 = 0.04
"""Reflectance at normal incidence for the refractive index 1.5, by which the specular colour is divided."""
DEFAULT_GREY = (0.18, 0.18, 0.18)
DEFAULT_ROUGHNESS = 0.5
WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Look:
    """A material, the primvars of its texture coordinates, and that of its colours, "" without one."""

    material: Material
    uv_names: tuple[str, ...] = ()
    colors: str = ""


DEFAULT = Look(Material("default", DEFAULT_GREY, roughness=DEFAULT_ROUGHNESS))
"""The look of a prim without a material and without a display colour."""
COLORED = Look(replace(DEFAULT.material, base_color=WHITE), colors=DISPLAY_COLOR)
"""The look of a prim without a material, whose display colours are vertex colours."""


class Looks:
    """The looks of a stage, each converted once."""

    def __init__(self, opened: Stage):
        self._opened = opened
        self.textures = Textures(opened)
        self._known: dict[str, Look | None] = {}
        self._plain: dict[Vector, Look] = {}

    def of(self, prim: Any) -> Look | None:
        """The look of a prim or of a subset; None if no material that can be read is bound."""
        binding, named = UsdShade.MaterialBindingAPI(prim), ""
        for purpose in PURPOSES:
            material = binding.ComputeBoundMaterial(purpose)[0]
            if not material:
                continue
            named = str(material.GetPath())
            if named not in self._known:
                self._known[named] = self._look(material)
            if self._known[named] is not None:
                return self._known[named]
        if named:
            self._opened.lose("materials without a UsdPreviewSurface: the display colour in their place", named)
        elif missing := _missing_target(prim):
            self._opened.lose("bindings to materials that the stage has not: the display colour in their place", missing)
        return None

    def of_color(self, prim: Any, constant: bool = False) -> Look:
        """The look of a prim without a material, by its display colour. constant: only a colour of the whole prim counts."""
        primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(DISPLAY_COLOR)
        values = primvar.ComputeFlattened(self._opened.time) if primvar and primvar.HasValue() else None
        if values is None or not len(values):
            return DEFAULT
        if len(values) > 1 and not constant:
            return COLORED
        color = as_vector(np.nan_to_num(np.asarray(values[0], np.float64).reshape(3)).clip(0.0, 1.0))
        return self._plain.setdefault(color, Look(replace(DEFAULT.material, base_color=color)))

    def _look(self, material: Any) -> Look | None:
        """The look of a material, None without a surface that can be read."""
        for context in ("", "mtlx"):
            shader = material.ComputeSurfaceSource(context)[0]
            if shader and shader.GetIdAttr().Get() in SURFACES:
                name = printable(str(material.GetPrim().GetName()), 120)
                return _Surface(self._opened, shader, self.textures, name).look()
        return None


class _Surface:
    """One UsdPreviewSurface node."""

    def __init__(self, opened: Stage, shader: Any, textures: Textures, name: str):
        self._opened, self._shader, self._textures, self._name = opened, shader, textures, name
        self._uv_names: list[str] = []
        self._colors = ""

    def look(self) -> Look:
        """The node as a material."""
        color, image = self._color("diffuseColor", DEFAULT_GREY)
        if max(color) > 1.0 + 1e-6:
            self._opened.lose("diffuse colours above 1: 1 in their place", self._name)
        fields: dict[str, Any] = {"base_color": _fractions(color), "base_color_texture": self._whole(image)}
        fields |= self._specular() | self._clearcoat() | self._emission()
        normal = self._image("normal", normal=True)
        fields["normal_texture"] = None if normal is None else normal.texture(normal.image, self._uv_names)
        if connected_output(self._shader.GetInput("displacement")) or self._number("displacement", 0.0) != 0.0:
            self._opened.lose("displacement: left out", self._name)
        fields |= self._opacity(fields, image)
        return Look(Material(self._name, **fields), tuple(self._uv_names), self._colors)

    def _value(self, name: str) -> Any:
        """The constant value of an input; None without one."""
        given = self._shader.GetInput(name)
        for attribute in given.GetValueProducingAttributes() if given else []:
            if attribute.GetName().startswith("inputs:"):
                return attribute.Get(self._opened.time)
        return None

    def _number(self, name: str, default: float, low: float = 0.0, high: float = 1.0) -> float:
        """A number within the limits; `default` for one that is absent or not finite."""
        value = self._value(name)
        if isinstance(value, (int, float)) and math.isfinite(value):
            if not low <= value <= high:
                self._opened.lose(f"{name} outside {low:g} to {high:g}: the nearest limit in its place", self._name)
            return min(max(float(value), low), high)
        return default

    def _vector(self, name: str, default: Vector) -> Vector:
        """A colour of finite channels that are not negative."""
        value = self._value(name)
        if value is None or np.shape(value) != (3,):
            return default
        color = np.nan_to_num(np.asarray(value, np.float64))
        if color.min() < 0.0:
            self._opened.lose("colours below 0: 0 in their place", self._name)
        return as_vector(color.clip(0.0, LARGEST))

    def _image(self, name: str, normal: bool = False) -> Source | None:
        """The image that feeds an input; None without one."""
        found = connected_output(self._shader.GetInput(name))
        if found is None:
            return None
        shader, output = found
        kind = str(shader.GetIdAttr().Get())
        if kind == "UsdUVTexture":
            return self._textures.read(shader, output, normal)
        if not (name == "diffuseColor" and kind.startswith("UsdPrimvarReader")):
            self._opened.lose(f"nodes of the type {kind} at {name}: left out", self._name)
        return None

    def _color(self, name: str, default: Vector) -> tuple[Vector, Source | None]:
        """The colour of an input, white with an image or with vertex colours, and its image."""
        image = self._image(name)
        if image is not None:
            return WHITE, image
        found = connected_output(self._shader.GetInput(name))
        if name == "diffuseColor" and found is not None and str(found[0].GetIdAttr().Get()).startswith("UsdPrimvarReader_float3"):
            varname = found[0].GetInput("varname")
            self._colors = str((varname.Get(self._opened.time) if varname else None) or DISPLAY_COLOR)
            return WHITE, None
        return self._vector(name, default), None

    def _whole(self, image: Source | None) -> Texture | None:
        """A texture of all colour channels."""
        return None if image is None else image.texture(self._textures.colors(image), self._uv_names)

    def _specular(self) -> dict[str, Any]:
        """Roughness, and the reflectance of the metallic or of the specular workflow."""
        rough, metal = self._image("roughness"), None
        roughness = 1.0 if rough else self._number("roughness", DEFAULT_ROUGHNESS)
        fields: dict[str, Any] = {"roughness": roughness}
        if self._value("useSpecularWorkflow") == 1:
            color, image = self._color("specularColor", (0.0, 0.0, 0.0))
            fields |= {"ior": 1.5, "specular_color": as_vector(each / F0 for each in color)}
            fields["specular_color_texture"] = self._whole(image)
        else:
            metal = self._image("metallic")
            fields |= {"metallic": 1.0 if metal else self._number("metallic", 0.0)}
            fields["ior"] = self._number("ior", 1.5, 1.0, LARGEST)
        if rough or metal:
            fields["metallic_roughness_texture"] = self._joined([None, rough, metal])
        return fields

    def _clearcoat(self) -> dict[str, Any]:
        """The clearcoat and its roughness."""
        coat, rough = self._image("clearcoat"), self._image("clearcoatRoughness")
        return {
            "clearcoat": 1.0 if coat else self._number("clearcoat", 0.0),
            "clearcoat_roughness": 1.0 if rough else self._number("clearcoatRoughness", 0.01),
            "clearcoat_texture": self._joined([coat]) if coat else None,
            "clearcoat_roughness_texture": self._joined([None, rough]) if rough else None,
        }

    def _emission(self) -> dict[str, Any]:
        """The emission as radiance; a texture has a maximum of 1."""
        color, image = self._color("emissiveColor", (0.0, 0.0, 0.0))
        if image is None:
            return {"emission": color}
        self._textures.reserve(2 * image.image.size)
        pixels = image.rgb().clip(0.0, LARGEST)
        peak = float(pixels.max())
        if peak <= 1.0:
            return {
                "emission": WHITE if peak > 0.0 else (0.0, 0.0, 0.0),
                "emission_texture": image.texture(pixels, self._uv_names),
            }
        return {"emission": (peak,) * 3, "emission_texture": image.texture(pixels / np.float32(peak), self._uv_names)}

    def _opacity(self, fields: dict[str, Any], color: Source | None) -> dict[str, Any]:
        """The opacity: a mask, a share of straight light, or clear glass."""
        image, cutoff = self._image("opacity"), self._number("opacityThreshold", 0.0)
        opacity = 1.0 if image else self._number("opacity", 1.0)
        if image is None and opacity == 1.0:
            return {}
        mode = "mask" if cutoff > 0.0 else "blend"
        if image is None:
            presence = mode == "mask" or str(self._value("opacityMode")) == "presence"
            return {"alpha_mode": mode, "alpha_cutoff": cutoff, "opacity": opacity} if presence else _glass(fields, opacity)
        texture = self._with_alpha(color, image)
        return {"alpha_mode": mode, "alpha_cutoff": cutoff, "base_color_texture": texture}

    def _with_alpha(self, color: Source | None, alpha: Source) -> Texture:
        """A texture of the colours of an image, white without one, and of the opacity of another one."""
        values = alpha.grey().clip(0.0, 1.0)
        if color is None:
            rgb, source = np.ones((*values.shape, 3), np.float32), alpha
        else:
            rgb, source = self._textures.colors(color), color
            self._compare(color, alpha)
        self._textures.reserve(2 * rgb.size)
        return source.texture(np.concatenate([rgb, nearest_texels(values, *rgb.shape[:2])[..., None]], axis=2), self._uv_names)

    def _joined(self, sources: list[Source | None]) -> Texture:
        """A texture whose channels come from images; 1 where there is none."""
        given = [source for source in sources if source is not None]
        shape = max((source.image.shape[:2] for source in given), key=math.prod)
        first = given[0]
        for other in given[1:]:
            self._compare(first, other)
        stored = all(each.image is first.image and each.channel == sources.index(each) for each in given)
        if len(given) > 1 and stored and first.image.min() >= 0.0 and first.image.max() <= 1.0:
            return first.texture(first.image, self._uv_names)
        image = np.ones((*shape, 3), np.float32)
        self._textures.reserve(image.size)
        for channel, source in enumerate(sources):
            if source is not None:
                image[..., channel] = nearest_texels(source.grey(), *shape).clip(0.0, 1.0)
        return first.texture(image, self._uv_names)

    def _compare(self, first: Source, other: Source) -> None:
        """Note a loss if two images that become one have different coordinates."""
        if (first.uv_name, first.wrap, first.transform) != (other.uv_name, other.wrap, other.transform):
            self._opened.lose("textures with different coordinates that share one image: those of the first count", self._name)


def _glass(fields: dict[str, Any], opacity: float) -> dict[str, Any]:
    """Refracting glass of an opacity below 1: the light passes without the tint of the diffuse colour."""
    color = as_vector(opacity * channel + 1.0 - opacity for channel in fields["base_color"])
    textured = fields["base_color_texture"] is not None
    return {"transmission": 1.0 - opacity, "base_color": fields["base_color"] if textured else color}


def _fractions(color: Vector) -> Vector:
    return as_vector(min(max(channel, 0.0), 1.0) for channel in color)


def _missing_target(prim: Any) -> str:
    """The path of a material that a prim or a prim above it binds, and that does not exist; empty for none."""
    while prim and not prim.IsPseudoRoot():
        path = UsdShade.MaterialBindingAPI(prim).GetDirectBinding().GetMaterialPath()
        if not path.isEmpty:
            return "" if prim.GetStage().GetPrimAtPath(path) else f"{prim.GetPath()}: {path}"
        prim = prim.GetParent()
    return ""
