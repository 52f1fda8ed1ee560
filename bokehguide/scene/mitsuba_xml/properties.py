"""Names of the properties of Mitsuba's plugins, by which misspelt ones are found."""

from __future__ import annotations

from collections.abc import Iterator
from difflib import get_close_matches

from bokehguide.scene.mitsuba_xml.tree import Plugin

PLACED = ("to_world", "sampling_weight")
MESH = ("to_world", "flip_normals", "face_normals", "silhouette_sampling_weight")
FILE = (*MESH, "filename")
SENSOR = (
    *("to_world", "fov", "fov_axis", "focal_length", "focus_distance", "near_clip", "far_clip", "shutter_open", "shutter_close"),
    "srf",
)
FILM = (
    *("width", "height", "crop_width", "crop_height", "crop_offset_x", "crop_offset_y", "sample_border", "file_format"),
    *("pixel_format", "component_format", "banner", "compensate"),
)
ROUGH = ("alpha", "alpha_u", "alpha_v", "distribution", "sample_visible")
PLASTIC = ("diffuse_reflectance", "specular_reflectance", "int_ior", "ext_ior", "nonlinear")
METAL = ("material", "eta", "k", "specular_reflectance")
GLASS = ("int_ior", "ext_ior", "specular_reflectance", "specular_transmittance")
BUMPS = ("flip_invalid_normals", "use_shadowing_function")
PRINCIPLED = (
    *("base_color", "roughness", "metallic", "anisotropic", "specular", "eta", "spec_trans", "spec_tint", "flatness", "sheen"),
    *("sheen_tint", "clearcoat", "clearcoat_gloss", "clearcoat_sampling_rate", "main_specular_sampling_rate"),
    "diffuse_reflectance_sampling_rate",
)
PROPERTIES = {
    "perspective": (*SENSOR, "principal_point_offset_x", "principal_point_offset_y"),
    "thinlens": (*SENSOR, "aperture_radius"),
    "hdrfilm": FILM,
    "sphere": (*MESH, "center", "radius"),
    **dict.fromkeys(("rectangle", "disk", "cube"), MESH),
    "cylinder": ("to_world", "flip_normals", "silhouette_sampling_weight", "p0", "p1", "radius"),
    **dict.fromkeys(("obj", "ply"), (*FILE, "flip_tex_coords")),
    "serialized": (*FILE, "shape_index"),
    "diffuse": ("reflectance",),
    "roughdiffuse": ("reflectance", "alpha", "use_fast_approx"),
    "plastic": PLASTIC,
    "roughplastic": (*PLASTIC, *ROUGH),
    "pplastic": ("diffuse_reflectance", "specular_reflectance", "int_ior", "ext_ior", *ROUGH),
    "conductor": METAL,
    "roughconductor": (*METAL, *ROUGH),
    **dict.fromkeys(("dielectric", "thindielectric"), GLASS),
    "roughdielectric": (*GLASS, *ROUGH),
    "principled": PRINCIPLED,
    "twosided": ("allow_transmission",),
    "mask": ("opacity",),
    "blendbsdf": ("weight",),
    "normalmap": BUMPS,
    "bumpmap": (*BUMPS, "scale"),
    "bitmap": ("filename", "bitmap", "data", "filter_type", "wrap_mode", "format", "raw", "to_uv", "accel"),
    "checkerboard": ("color0", "color1", "to_uv"),
    "area": (*PLACED, "radiance"),
    "constant": (*PLACED, "radiance"),
    "envmap": (*PLACED, "filename", "bitmap", "scale", "mis_compensation"),
    "directional": (*PLACED, "direction", "irradiance"),
    "point": (*PLACED, "position", "intensity"),
    "spot": (*PLACED, "intensity", "cutoff_angle", "beam_width", "texture"),
}
"""Properties by plugin, also those without a counterpart. Other plugins are left out as a whole, or tell each loss."""
TEXTURED = ("normalmap", "bumpmap")
"""Plugins whose textures may have any name."""


def unknown_properties(root: Plugin) -> Iterator[tuple[Plugin, str, str]]:
    """Properties within `root` of a name that Mitsuba does not know, each with a similar name, empty without one."""
    seen, stack = {id(root)}, [root]
    while stack:
        plugin = stack.pop()
        known = PROPERTIES.get(plugin.type)
        for key, value in plugin.values.items():
            if isinstance(value, Plugin) and id(value) not in seen:
                seen.add(id(value))
                stack.append(value)
            if known is not None and key not in known and not _any_name(plugin, key, value):
                yield plugin, key, next(iter(get_close_matches(key, known, 1)), "")


def _any_name(plugin: Plugin, key: str, value: object) -> bool:
    """Whether `value` is a nested plugin whose name in `plugin` does not matter."""
    if not isinstance(value, Plugin):
        return False
    by_name = value.kind == "texture" and plugin.kind in ("bsdf", "emitter") and plugin.type not in TEXTURED
    return not by_name or key.startswith("_arg_")
