"""The `[materials.NAME]` tables of a scene file."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from bokehguide.errors import BokehguideError
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.images import load_texture
from bokehguide.scene.tables import ANY, CONE_ANGLE, FRACTION, IOR, NOT_NEGATIVE, POSITIVE, Table, did_you_mean
from bokehguide.scene.types import Cone, Material, Texture

ENCODED = {
    "base_color_texture": True,
    "metallic_roughness_texture": False,
    "emission_texture": True,
    "normal_texture": False,
    "specular_texture": False,
    "specular_color_texture": True,
    "transmission_texture": False,
    "clearcoat_texture": False,
    "clearcoat_roughness_texture": False,
    "clearcoat_normal_texture": False,
}
"""The textures, and whether their colours are sRGB."""
KEYS = (
    *("base_color", "metallic", "roughness", "specular", "specular_color", "transmission", "thin", "ior"),
    *("attenuation_color", "attenuation_distance", "clearcoat", "clearcoat_roughness", "emission"),
    *("emission_cone", "double_sided", "opacity", "alpha_mode", "alpha_cutoff", "normal_scale"),
    *("clearcoat_normal_scale", *ENCODED),
)
NEEDS = {
    "emission_texture": ("emission",),
    "emission_cone": ("emission",),
    "normal_scale": ("normal_texture",),
    "clearcoat_normal_scale": ("clearcoat_normal_texture",),
    "attenuation_color": ("attenuation_distance",),
    "attenuation_distance": ("attenuation_color",),
    "clearcoat_roughness": ("clearcoat", "clearcoat_texture"),
    "clearcoat_roughness_texture": ("clearcoat", "clearcoat_texture"),
    "clearcoat_normal_texture": ("clearcoat", "clearcoat_texture"),
    "opacity": ("alpha_mode",),
    "alpha_cutoff": ("alpha_mode",),
}
"""Keys that have no effect without one of the listed keys."""
FACTOR_TEXTURES = {"metallic": "metallic_roughness_texture", "roughness": "metallic_roughness_texture"}
"""The textures of factors whose names differ."""
ALPHA_MODES = ("opaque", "mask", "blend")


def read_materials(root: Table, files: SceneFiles) -> list[Material]:
    """The materials in the file's order. files: the files that textures may name.

    Raises BokehguideError naming file, field, value and remedy for an invalid material.
    """
    values = root.values.get("materials", {})
    if not isinstance(values, dict):
        root.fail("materials", "is not a table; write [materials.NAME]")
    return [_material(Table(values[name], root.file, f"materials.{name}", KEYS), files) for name in values]


def _material(table: Table, files: SceneFiles) -> Material:
    """The material of a table. An absent factor is 1 if its texture is given."""
    for key, others in NEEDS.items():
        if key in table and not any(other in table for other in others):
            table.fail(key, f"has no effect without {others[0]}; give that too")
    textures = _textures(table, files)

    def factor(key: str, default: float) -> float:
        texture = FACTOR_TEXTURES.get(key, f"{key}_texture")
        return table.number(key, 1.0 if texture in textures else default, FRACTION)

    base_color = (1.0, 1.0, 1.0) if "base_color_texture" in textures else Material.base_color
    material = Material(
        name=table.path.removeprefix("materials."),
        base_color=table.vector("base_color", base_color, FRACTION),
        metallic=factor("metallic", Material.metallic),
        roughness=factor("roughness", Material.roughness),
        specular=factor("specular", Material.specular),
        specular_color=table.vector("specular_color", Material.specular_color, NOT_NEGATIVE),
        transmission=factor("transmission", Material.transmission),
        thin=table.flag("thin"),
        ior=table.number("ior", Material.ior, IOR),
        attenuation_color=table.vector("attenuation_color", Material.attenuation_color, FRACTION),
        attenuation_distance=table.number("attenuation_distance", Material.attenuation_distance, POSITIVE),
        clearcoat=factor("clearcoat", Material.clearcoat),
        clearcoat_roughness=factor("clearcoat_roughness", Material.clearcoat_roughness),
        emission=table.vector("emission", Material.emission, NOT_NEGATIVE),
        emission_cone=_cone(table),
        double_sided=table.flag("double_sided"),
        opacity=table.number("opacity", Material.opacity, FRACTION),
        alpha_mode=_alpha_mode(table),
        alpha_cutoff=table.number("alpha_cutoff", Material.alpha_cutoff, FRACTION),
        normal_scale=table.number("normal_scale", Material.normal_scale, ANY),
        clearcoat_normal_scale=table.number("clearcoat_normal_scale", Material.clearcoat_normal_scale, ANY),
    )
    return replace(material, **textures)


def _textures(table: Table, files: SceneFiles) -> dict[str, Any]:
    """The textures of a material's table by their keys."""
    textures: dict[str, Any] = {}
    for key, encoded in ENCODED.items():
        if key in table:
            alpha = key == "specular_texture" or (key == "base_color_texture" and _alpha_mode(table) != "opaque")
            textures[key] = Texture(load_texture(files.named(table, key, "texture"), files, encoded, alpha))
    if "specular_texture" in textures and textures["specular_texture"].image.shape[2] < 4:
        table.fail("specular_texture", "has no alpha channel, which holds the specular factor; give an image with alpha")
    return textures


def _alpha_mode(table: Table) -> str:
    """The alpha mode of a material's table."""
    mode = table.text("alpha_mode") or Material.alpha_mode
    if mode not in ALPHA_MODES:
        table.fail("alpha_mode", f"is not a mode; {did_you_mean(mode, ALPHA_MODES)}")
    return mode


def _cone(table: Table) -> Cone | None:
    """The emission cone of a material's table, None if absent."""
    if "emission_cone" not in table:
        return None
    cone = Table(table.values["emission_cone"], table.file, f"{table.path}.emission_cone", ("axis", "inner", "outer"))
    axis = cone.direction("axis")
    outer = cone.number("outer", 45.0, CONE_ANGLE)
    inner = cone.number("inner", 0.0, CONE_ANGLE)
    if inner >= outer:
        raise BokehguideError(f"{cone.place('outer')}: {outer:g} is not above inner, {inner:g}; give a larger angle")
    return Cone(axis, inner, outer)
