"""The `[materials.NAME]` tables of a scene file."""

from __future__ import annotations

from typing import Any

from bokehguide.errors import BokehguideError
from bokehguide.scene.checks import check_light_group
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.images import load_texture
from bokehguide.scene.tables import FILM, Table, did_you_mean
from bokehguide.scene.toml.cones import read_cone
from bokehguide.scene.types import ALPHA_MODES, MATERIAL_COLORS, MATERIAL_NUMBERS, Material, Texture, Vector

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
    "sheen_color_texture": True,
    "sheen_roughness_texture": False,
    "anisotropy_texture": False,
    "diffuse_transmission_texture": False,
    "diffuse_transmission_color_texture": True,
    "iridescence_texture": False,
    "iridescence_thickness_texture": False,
}
"""The textures, and whether their colours are sRGB."""
THICKNESS = "iridescence_thickness"
ALPHA_TEXTURES = {
    "specular_texture": "the specular factor",
    "sheen_roughness_texture": "the roughness of the sheen",
    "diffuse_transmission_texture": "the share of light that passes",
}
"""Textures whose values are alpha, and the meaning of the values."""
KEYS = (
    *("base_color", "metallic", "roughness", "specular", "specular_color", "transmission", "thin", "ior"),
    *("attenuation_color", "attenuation_distance", "clearcoat", "clearcoat_roughness", "emission"),
    *("emission_cone", "group", "double_sided", "opacity", "alpha_mode", "alpha_cutoff", "normal_scale"),
    *("clearcoat_normal_scale", "sheen_color", "sheen_roughness", "anisotropy", "anisotropy_rotation"),
    *("diffuse_transmission", "diffuse_transmission_color", "iridescence", "iridescence_ior"),
    *("iridescence_thickness", "dispersion", "single_scattering", *ENCODED),
)
NEEDS = {
    "emission_texture": ("emission",),
    "emission_cone": ("emission",),
    "group": ("emission",),
    "normal_scale": ("normal_texture",),
    "clearcoat_normal_scale": ("clearcoat_normal_texture",),
    "attenuation_color": ("attenuation_distance",),
    "attenuation_distance": ("attenuation_color",),
    "clearcoat_roughness": ("clearcoat", "clearcoat_texture"),
    "clearcoat_roughness_texture": ("clearcoat", "clearcoat_texture"),
    "clearcoat_normal_texture": ("clearcoat", "clearcoat_texture"),
    "sheen_roughness": ("sheen_color", "sheen_color_texture"),
    "sheen_roughness_texture": ("sheen_color", "sheen_color_texture"),
    "anisotropy_rotation": ("anisotropy", "anisotropy_texture"),
    "diffuse_transmission_color": ("diffuse_transmission", "diffuse_transmission_texture"),
    "diffuse_transmission_color_texture": ("diffuse_transmission", "diffuse_transmission_texture"),
    "iridescence_ior": ("iridescence", "iridescence_texture"),
    "iridescence_thickness": ("iridescence", "iridescence_texture"),
    "iridescence_thickness_texture": ("iridescence", "iridescence_texture"),
    "dispersion": ("transmission", "transmission_texture"),
    "single_scattering": ("metallic", "metallic_roughness_texture"),
    "opacity": ("alpha_mode",),
    "alpha_cutoff": ("alpha_mode",),
}
"""Keys that have no effect without one of the listed keys."""
FACTOR_TEXTURES = {"metallic": "metallic_roughness_texture", "roughness": "metallic_roughness_texture"}
"""The textures of factors whose names differ."""


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

    def number(key: str) -> float:
        texture = FACTOR_TEXTURES.get(key, f"{key}_texture")
        default = 1.0 if texture in textures else getattr(Material, key)
        return table.number(key, default, MATERIAL_NUMBERS[key])

    def color(key: str) -> Vector:
        default = (1.0, 1.0, 1.0) if f"{key}_texture" in textures else getattr(Material, key)
        return table.vector(key, default, MATERIAL_COLORS[key])

    return Material(
        name=table.path.removeprefix("materials."),
        **{key: number(key) for key in MATERIAL_NUMBERS},
        **{key: color(key) for key in MATERIAL_COLORS},
        **{key: table.flag(key) for key in ("thin", "single_scattering", "double_sided")},
        iridescence_thickness=table.pair(THICKNESS, FILM) if THICKNESS in table else Material.iridescence_thickness,
        alpha_mode=_alpha_mode(table),
        emission_cone=read_cone(table, "emission_cone") if "emission_cone" in table else None,
        light_group=check_light_group(table, "group"),
        **textures,
    )


def _textures(table: Table, files: SceneFiles) -> dict[str, Any]:
    """The textures of a material's table by their keys."""
    textures: dict[str, Any] = {}
    for key, encoded in ENCODED.items():
        if key in table:
            alpha = key in ALPHA_TEXTURES or (key == "base_color_texture" and _alpha_mode(table) != "opaque")
            path = files.named(table, key)
            try:
                textures[key] = Texture(load_texture(path, files, encoded, alpha))
            except BokehguideError as error:
                raise BokehguideError(f"{table.place(key)}: {error}") from None
    for key, meaning in ALPHA_TEXTURES.items():
        if key in textures and textures[key].image.shape[2] < 4:
            table.fail(key, f"has no alpha channel, which holds {meaning}; give an image with alpha")
    return textures


def _alpha_mode(table: Table) -> str:
    """The alpha mode of a material's table."""
    mode = table.text("alpha_mode") or Material.alpha_mode
    if mode not in ALPHA_MODES:
        table.fail("alpha_mode", f"is not a mode; {did_you_mean(mode, ALPHA_MODES)}")
    return mode
