"""UsdPreviewSurface in the terms of `Material`."""

from __future__ import annotations

import math
from typing import Any

from bokehguide.limits import LARGEST
from bokehguide.scene.types import Material, Vector, as_vector
from bokehguide.scene.usd.networks import PREFIX, connected_output, kind_of, valued
from bokehguide.scene.usd.surface_inputs import BLACK, WHITE, Look, SurfaceInputs
from bokehguide.scene.usd.textures import Source
from bokehguide.scene.vectors import fractions

F0 = 0.04
"""Reflectance at normal incidence for the refractive index 1.5, by which the specular colour is divided."""
DEFAULT_GREY = (0.18, 0.18, 0.18)
DEFAULT_ROUGHNESS = 0.5


class PreviewSurface(SurfaceInputs):
    """One UsdPreviewSurface node."""

    def look(self) -> Look:
        """The node as a material."""
        color, image = self.color("diffuseColor", DEFAULT_GREY)
        if max(color) > 1.0 + 1e-6:
            self.opened.lose("diffuse colours above 1: 1 in their place", self.name)
        fields: dict[str, Any] = {"base_color": fractions(color), "base_color_texture": self.whole(image)}
        fields |= self._specular() | self._clearcoat() | self._emission()
        fields |= self.normal_map("normal")
        if connected_output(self.shader, "displacement") or self.number("displacement", 0.0) != 0.0:
            self.opened.lose("displacement: left out", self.name)
        fields |= self._opacity(fields, image)
        return Look(Material(self.name, **fields), tuple(self.uv_names), self.colors)

    def value(self, name: str) -> Any:
        """The constant value of an input as it is; None without one."""
        attribute = valued(self.shader, name)
        if attribute is not None:
            return attribute.Get(self.opened.time)
        constant = self.constant(name)
        return None if constant is None else float(constant.factor[0])

    def number(self, name: str, default: float, low: float = 0.0, high: float = 1.0) -> float:
        """A number within the limits; `default` for one that is absent or not finite."""
        value = self.value(name)
        if isinstance(value, (int, float)) and math.isfinite(value):
            if not low <= value <= high:
                self.opened.lose(f"{name} outside {low:g} to {high:g}: the nearest limit in its place", self.name)
            return min(max(float(value), low), high)
        return default

    def vector(self, name: str, default: Vector) -> Vector:
        """A colour of finite channels that are not negative."""
        value = self.constant(name)
        if value is None or len(value.factor) != 3:
            return default
        if value.factor.min() < 0.0:
            self.opened.lose("colours below 0: 0 in their place", self.name)
        return as_vector(value.factor.clip(0.0, LARGEST))

    def image(self, name: str) -> Source | None:
        """The image that feeds an input; None without one."""
        found = connected_output(self.shader, name)
        if found is None or (name == "diffuseColor" and self.primvar(name)):
            return None
        shader, output = found
        kind = kind_of(shader)
        if kind == "UsdUVTexture":
            return self.textures.read(shader, output)
        if kind.startswith(PREFIX):
            return self.folded(self.nodes.output(shader, output))
        self.opened.lose(f"nodes of the type {kind} at {name}: left out", self.name)
        return None

    def color(self, name: str, default: Vector) -> tuple[Vector, Source | None]:
        """The colour of an input, white with an image or with vertex colours, and its image."""
        image = self.image(name)
        if image is not None:
            return WHITE, image
        if name == "diffuseColor" and (primvar := self.primvar(name)):
            self.colors = primvar
            return WHITE, None
        return self.vector(name, default), None

    def _specular(self) -> dict[str, Any]:
        """Roughness, and the reflectance of the metallic or of the specular workflow."""
        rough, metal = self.image("roughness"), None
        roughness = 1.0 if rough else self.number("roughness", DEFAULT_ROUGHNESS)
        fields: dict[str, Any] = {"roughness": roughness}
        if self.value("useSpecularWorkflow") == 1:
            color, image = self.color("specularColor", BLACK)
            fields |= {"ior": 1.5, "specular_color": as_vector(each / F0 for each in color)}
            fields["specular_color_texture"] = self.whole(image)
        else:
            metal = self.image("metallic")
            fields |= {"metallic": 1.0 if metal else self.number("metallic", 0.0)}
            fields["ior"] = self.number("ior", 1.5, 1.0, LARGEST)
        if rough or metal:
            fields["metallic_roughness_texture"] = self.joined([None, rough, metal])
        return fields

    def _clearcoat(self) -> dict[str, Any]:
        """The clearcoat and its roughness."""
        coat, rough = self.image("clearcoat"), self.image("clearcoatRoughness")
        return {
            "clearcoat": 1.0 if coat else self.number("clearcoat", 0.0),
            "clearcoat_roughness": 1.0 if rough else self.number("clearcoatRoughness", 0.01),
            "clearcoat_texture": self.joined([coat]) if coat else None,
            "clearcoat_roughness_texture": self.joined([None, rough]) if rough else None,
        }

    def _emission(self) -> dict[str, Any]:
        """The emission as radiance; a texture has a maximum of 1."""
        color, image = self.color("emissiveColor", BLACK)
        return {"emission": color} if image is None else self.emission(image)

    def _opacity(self, fields: dict[str, Any], color: Source | None) -> dict[str, Any]:
        """The opacity: a mask, a share of straight light, or clear glass."""
        image, cutoff = self.image("opacity"), self.number("opacityThreshold", 0.0)
        opacity = 1.0 if image else self.number("opacity", 1.0)
        if image is None and opacity == 1.0:
            return {}
        mode = "mask" if cutoff > 0.0 else "blend"
        if image is None:
            presence = mode == "mask" or str(self.value("opacityMode")) == "presence"
            return {"alpha_mode": mode, "alpha_cutoff": cutoff, "opacity": opacity} if presence else _glass(fields, opacity)
        texture = self.with_alpha(color, image)
        return {"alpha_mode": mode, "alpha_cutoff": cutoff, "base_color_texture": texture}


def _glass(fields: dict[str, Any], opacity: float) -> dict[str, Any]:
    """Refracting glass of an opacity below 1: the light passes without the tint of the diffuse colour."""
    color = as_vector(opacity * channel + 1.0 - opacity for channel in fields["base_color"])
    textured = fields["base_color_texture"] is not None
    return {"transmission": 1.0 - opacity, "base_color": fields["base_color"] if textured else color}
