"""Surface nodes of MaterialX in the terms of `Material`: standard_surface, open_pbr_surface and gltf_pbr.

The defaults are those of the node definitions of MaterialX 1.39.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bokehguide.limits import LARGEST
from bokehguide.scene.anisotropy import from_alphas
from bokehguide.scene.types import Material, as_vector
from bokehguide.scene.usd.networks import connected_output
from bokehguide.scene.usd.nodes import Nodes, Value
from bokehguide.scene.usd.stage import Stage
from bokehguide.scene.usd.surface_inputs import BLACK, WHITE, Look, SurfaceInputs
from bokehguide.scene.usd.textures import Source, Textures
from bokehguide.scene.vectors import fractions

GREY = (0.8, 0.8, 0.8)
COAT_IOR = 1.5
"""The refractive index of the clearcoat."""
MOST_FILM = 1e5
"""Nanometres of the thickest film of a `Material`."""
TERMS: dict[str, tuple[Any, ...]] = {
    "base": (1.0, ("base", 1.0), ("base_weight", 1.0), None),
    "color": (GREY, ("base_color", GREY), ("base_color", GREY), ("base_color", WHITE)),
    "metallic": (0.0, ("metalness", 0.0), ("base_metalness", 0.0), ("metallic", 1.0)),
    "roughness": (0.0, ("specular_roughness", 0.2), ("specular_roughness", 0.3), ("roughness", 1.0)),
    "specular": (1.0, ("specular", 1.0), ("specular_weight", 1.0), ("specular", 1.0)),
    "specular_color": (WHITE, ("specular_color", WHITE), ("specular_color", WHITE), ("specular_color", WHITE)),
    "ior": (1.5, ("specular_IOR", 1.5), ("specular_ior", 1.5), ("ior", 1.5)),
    "anisotropy": (0.0, ("specular_anisotropy", 0.0), ("specular_roughness_anisotropy", 0.0), ("anisotropy_strength", 0.0)),
    "rotation": (0.0, ("specular_rotation", 0.0), None, ("anisotropy_rotation", 0.0)),
    "transmission": (0.0, ("transmission", 0.0), ("transmission_weight", 0.0), ("transmission", 0.0)),
    "transmission_color": (WHITE, ("transmission_color", WHITE), ("transmission_color", WHITE), ("attenuation_color", WHITE)),
    "depth": (0.0, ("transmission_depth", 0.0), ("transmission_depth", 0.0), ("attenuation_distance", 0.0)),
    "abbe": (20.0, ("transmission_dispersion", 0.0), ("transmission_dispersion_abbe_number", 20.0), None),
    "dispersion": (1.0, None, ("transmission_dispersion_scale", 0.0), ("dispersion", 0.0)),
    "thin": (0.0, ("thin_walled", 0.0), ("geometry_thin_walled", 0.0), None),
    "thickness": (0.0, None, None, ("thickness", 0.0)),
    "subsurface": (0.0, ("subsurface", 0.0), ("subsurface_weight", 0.0), None),
    "subsurface_color": (WHITE, ("subsurface_color", WHITE), ("subsurface_color", GREY), None),
    "coat": (0.0, ("coat", 0.0), ("coat_weight", 0.0), ("clearcoat", 0.0)),
    "coat_color": (WHITE, ("coat_color", WHITE), ("coat_color", WHITE), None),
    "coat_roughness": (0.0, ("coat_roughness", 0.1), ("coat_roughness", 0.0), ("clearcoat_roughness", 0.0)),
    "coat_ior": (COAT_IOR, ("coat_IOR", 1.5), ("coat_ior", 1.6), None),
    "coat_normal": (None, ("coat_normal", None), ("geometry_coat_normal", None), ("clearcoat_normal", None)),
    "sheen": (1.0, ("sheen", 0.0), ("fuzz_weight", 0.0), None),
    "sheen_color": (WHITE, ("sheen_color", WHITE), ("fuzz_color", WHITE), ("sheen_color", BLACK)),
    "sheen_roughness": (0.0, ("sheen_roughness", 0.3), ("fuzz_roughness", 0.5), ("sheen_roughness", 0.0)),
    "film_weight": (1.0, None, ("thin_film_weight", 0.0), ("iridescence", 0.0)),
    "film": (0.0, ("thin_film_thickness", 0.0), ("thin_film_thickness", 0.5), ("iridescence_thickness", 100.0)),
    "film_ior": (1.5, ("thin_film_IOR", 1.5), ("thin_film_ior", 1.4), ("iridescence_ior", 1.3)),
    "emission_weight": (1.0, ("emission", 0.0), ("emission_luminance", 0.0), ("emissive_strength", 1.0)),
    "emission": (WHITE, ("emission_color", WHITE), ("emission_color", WHITE), ("emissive", BLACK)),
    "opacity": (1.0, ("opacity", WHITE), ("geometry_opacity", 1.0), ("alpha", 1.0)),
    "mode": (2.0, None, None, ("alpha_mode", 0.0)),
    "cutoff": (0.5, None, None, ("alpha_cutoff", 0.5)),
    "normal": (None, ("normal", None), ("geometry_normal", None), ("normal", None)),
}
"""Terms of this reader: the value for a node without such an input, and the inputs of standard_surface, open_pbr_surface and
gltf_pbr with their defaults."""


def _standard_alphas(alpha: float, anisotropy: float) -> tuple[float, float]:
    """The α along and across the tangent, of the node roughness_anisotropy."""
    aspect = math.sqrt(1.0 - min(anisotropy, 0.98))
    return alpha / aspect, alpha * aspect


def _open_alphas(alpha: float, anisotropy: float) -> tuple[float, float]:
    """The α along and across the tangent, of the node open_pbr_anisotropy."""
    along = alpha * math.sqrt(2.0 / (1.0 + (1.0 - anisotropy) ** 2))
    return along, (1.0 - anisotropy) * along


@dataclass(frozen=True)
class Model:
    """A surface node.

    column: in TERMS. ignored: inputs without a counterpart, which have no effect at 0. alphas: the α along and across the
    tangent; None for glTF, whose conventions a `Material` has. film_unit: in nanometres. defaults: other ones than in TERMS.
    """

    column: int
    ignored: tuple[str, ...]
    alphas: Callable[[float, float], tuple[float, float]] | None = None
    film_unit: float = 1.0
    defaults: Mapping[str, Any] = field(default_factory=dict)

    @property
    def is_gltf(self) -> bool:
        return self.alphas is None

    def term(self, name: str) -> tuple[str, Any]:
        """The input of a term, "" without one, and its default."""
        given, default = TERMS[name][self.column] or ("", TERMS[name][0])
        return given, self.defaults.get(name, default)


STANDARD = Model(
    1,
    (
        *("diffuse_roughness", "transmission_scatter", "transmission_extra_roughness", "tangent"),
        *("coat_anisotropy", "coat_affect_color", "coat_affect_roughness"),
    ),
    _standard_alphas,
)
OPEN = Model(
    2,
    ("base_diffuse_roughness", "transmission_scatter", "coat_roughness_anisotropy", "geometry_tangent", "geometry_coat_tangent"),
    _open_alphas,
    film_unit=1000.0,
)
SURFACES = {
    "ND_standard_surface_surfaceshader": STANDARD,
    "ND_standard_surface_surfaceshader_100": replace(STANDARD, defaults={"base": 0.8, "color": WHITE}),
    "ND_open_pbr_surface_surfaceshader": OPEN,
    "ND_gltf_pbr_surfaceshader": Model(3, ("tangent",)),
}
"""The models by the identifiers of their nodes."""


class MaterialXSurface(SurfaceInputs):
    """One surface node of MaterialX."""

    def __init__(self, opened: Stage, shader: Any, textures: Textures, nodes: Nodes, name: str, model: Model):
        super().__init__(opened, shader, textures, nodes, name)
        self._model = model

    def look(self) -> Look:
        """The node as a material."""
        color = self._color()
        fields: dict[str, Any] = {"base_color": fractions(color.factor), "base_color_texture": self.whole(color.source)}
        fields |= self._specular() | self._transmission() | self._coat() | self._sheen() | self._film() | self._emission()
        fields |= self.normal_map(self._model.term("normal")[0])
        fields |= self._opacity(color)
        for name in self._model.ignored:
            constant = self.constant(name)
            if (constant is not None and constant.factor.any()) or connected_output(self.shader, name):
                self.opened.lose(f"{name}: left out", self.name)
        return Look(Material(self.name, **fields), tuple(self.uv_names), self.colors)

    def _value(self, term: str) -> Value:
        """The value of a term, as many channels as its default."""
        name, default = self._model.term(term)
        if name and term == "color" and (primvar := self.primvar(name)):
            self.colors = primvar
            return Value(np.ones(3))
        value = self.nodes.input(self.shader, name) if name else None
        return Value(np.asarray(default)) if value is None else self.nodes.resized(value, np.size(default))

    def _number(self, term: str, low: float = 0.0, high: float = 1.0) -> tuple[float, Source | None]:
        """A number within the limits, and its texture."""
        value = self._value(term)
        number = float(value.factor[0])
        if not low <= number <= high:
            name = self._model.term(term)[0]
            self.opened.lose(f"{name} outside {low:g} to {high:g}: the nearest limit in its place", self.name)
        return min(max(number, low), high), value.source

    def _plain(self, term: str, low: float = 0.0, high: float = 1.0) -> float:
        """A number that has no texture here."""
        number, source = self._number(term, low, high)
        if source is None:
            return number
        name, default = self._model.term(term)
        self.opened.lose(f"textures of {name}: {default:g} in their place", self.name)
        return float(default)

    def _combined(self, operation: str, *values: Value) -> Value:
        return self.nodes.combine(operation, self.name, *values)

    def _mixed(self, first: Value, second: Value, share: Value) -> Value:
        """`first`, or `second` by a share."""
        if share.source is None and share.factor[0] in (0.0, 1.0):
            return second if share.factor[0] else first
        return self._combined("mix", second, first, share)

    def _color(self) -> Value:
        """The base colour: diffuse, of a metal, and of transmitted light, beneath the tint of the coat."""
        color = self._combined("multiply", self._value("base"), self._value("color"))
        under, coat = self._value("subsurface"), self._value("coat")
        if under.source is not None or under.factor[0] > 0.0:
            self.opened.lose("subsurface scattering: diffuse reflection of its colour in its place", self.name)
            color = self._mixed(color, self._value("subsurface_color"), under)
        if not self._model.is_gltf:
            tint = self._value("transmission_color") if self._plain("depth", 0.0, LARGEST) == 0.0 else Value(np.ones(3))
            color = self._mixed(color, tint, self._value("transmission"))
        tint = self._value("coat_color")
        if coat.source is not None or coat.factor[0] > 0.0:
            color = self._combined("multiply", color, self._mixed(Value(np.ones(3)), tint, coat))
        if color.source is None and color.factor.max() > 1.0 + 1e-6:
            self.opened.lose("base colours above 1: 1 in their place", self.name)
        return color

    def _specular(self) -> dict[str, Any]:
        """Metalness, roughness and the reflectance at normal incidence."""
        (rough, of_rough), (metal, of_metal), (weight, of_weight) = map(self._number, ("roughness", "metallic", "specular"))
        color = self._value("specular_color")
        tinted = color.source is not None or (color.factor != 1.0).any() or weight != 1.0
        if metal > 0.0 and of_metal is None and not self._model.is_gltf and tinted:
            self.opened.lose("specular weights and colours of metals: 1 in their place", self.name)
        fields = {
            "metallic": metal,
            "roughness": rough,
            "specular": weight,
            "ior": self._plain("ior", 1.0, LARGEST),
            "specular_color": as_vector(color.factor.clip(0.0, LARGEST)),
            "specular_color_texture": self.whole(color.source),
            "specular_texture": self.joined([None, None, None, of_weight]) if of_weight else None,
            "metallic_roughness_texture": self.joined([None, of_rough, of_metal]) if of_rough or of_metal else None,
        }
        strength = self._plain("anisotropy")
        if strength > 0.0 and of_rough is not None and not self._model.is_gltf:
            self.opened.lose("anisotropy together with a texture of the roughness: left out", self.name)
        elif strength > 0.0:
            fields |= self._anisotropy(rough, strength)
        return fields

    def _anisotropy(self, rough: float, strength: float) -> dict[str, Any]:
        """The roughness along and across the tangent. A rotation of standard_surface is a share of a turn, clockwise."""
        rotation = self._plain("rotation", -LARGEST, LARGEST)
        if self._model.alphas is None:
            return {"anisotropy": strength, "anisotropy_rotation": math.degrees(rotation)}
        fields = from_alphas(*self._model.alphas(rough**2, strength))
        return fields | {"anisotropy_rotation": fields["anisotropy_rotation"] - 360.0 * rotation}

    def _transmission(self) -> dict[str, Any]:
        """Light that passes through. Depths are in scene units."""
        share, image = self._number("transmission")
        thin = self._plain("thickness", 0.0, LARGEST) == 0.0 if self._model.is_gltf else self._plain("thin") > 0.0
        fields: dict[str, Any] = {
            "transmission": share,
            "thin": thin and share > 0.0,
            "transmission_texture": self.joined([image]) if image else None,
        }
        depth, tint = self._plain("depth", 0.0, LARGEST), self._value("transmission_color")
        if depth > 0.0:
            if tint.source is not None:
                self.opened.lose("textures of the colour of a medium: left out", self.name)
            fields |= {"attenuation_color": fractions(tint.factor), "attenuation_distance": depth * self.opened.unit}
        abbe, scale = self._plain("abbe", 0.0, LARGEST), self._plain("dispersion", 0.0, LARGEST)
        return fields | {"dispersion": 20.0 * scale / abbe if abbe > 0.0 else 0.0}

    def _coat(self) -> dict[str, Any]:
        """The clearcoat, with its roughness and normal map."""
        (weight, of_weight), (rough, of_rough) = self._number("coat"), self._number("coat_roughness")
        if weight == 0.0:
            return {}
        if self._plain("coat_ior", 1.0, LARGEST) != COAT_IOR:
            self.opened.lose(f"refractive indices of coats: {COAT_IOR:g} in their place", self.name)
        return {
            "clearcoat": weight,
            "clearcoat_roughness": rough,
            "clearcoat_texture": self.joined([of_weight]) if of_weight else None,
            "clearcoat_roughness_texture": self.joined([None, of_rough]) if of_rough else None,
            **self.normal_map(self._model.term("coat_normal")[0], "clearcoat_"),
        }

    def _sheen(self) -> dict[str, Any]:
        """The sheen. Its α is the roughness in the nodes with a weight, and the square of the roughness in a `Material`."""
        color = self._combined("multiply", self._value("sheen"), self._value("sheen_color"))
        if not color.factor.any():
            return {}
        rough, image = self._number("sheen_roughness")
        if not self._model.is_gltf:
            rough = math.sqrt(rough)
            if image is not None:
                image = self._combined("power", Value(np.ones(1), image), Value(np.full(1, 0.5))).source
        return {
            "sheen_color": fractions(color.factor),
            "sheen_roughness": rough,
            "sheen_color_texture": self.whole(color.source),
            "sheen_roughness_texture": self.joined([None, None, None, image]) if image else None,
        }

    def _film(self) -> dict[str, Any]:
        """The thin film."""
        weight, image = self._number("film_weight")
        thickness = self._plain("film", 0.0, MOST_FILM / self._model.film_unit) * self._model.film_unit
        if weight == 0.0 or thickness == 0.0:
            return {}
        return {
            "iridescence": weight,
            "iridescence_ior": self._plain("film_ior", 1.0, LARGEST),
            "iridescence_thickness": (thickness, thickness),
            "iridescence_texture": self.joined([image]) if image else None,
        }

    def _emission(self) -> dict[str, Any]:
        """The emission as radiance."""
        value = self._combined("multiply", self._value("emission_weight"), self._value("emission"))
        image = self.folded(value)
        return {"emission": as_vector(value.factor.clip(0.0, LARGEST))} if image is None else self.emission(image)

    def _opacity(self, color: Value) -> dict[str, Any]:
        """The opacity: a share of straight light, or a mask."""
        value, mode = self._value("opacity"), int(self._plain("mode", 0.0, 2.0))
        image = self.folded(value)
        if self._model.is_gltf and mode == 0:
            return {}
        fields: dict[str, Any] = {"alpha_mode": "mask" if mode == 1 else "blend", "alpha_cutoff": self._plain("cutoff")}
        if image is not None:
            return fields | {"base_color_texture": self.with_alpha(color.source, image)}
        opacity = float(value.factor.mean().clip(0.0, 1.0))
        return fields | {"opacity": opacity} if opacity < 1.0 else {}
