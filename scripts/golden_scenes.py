"""The scenes of `golden.py`: built-in scenes, and variants with features that no built-in scene has."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from bokehguide.scene import Aperture, Cone, Material, Overrides, Scene, Sun, Texture, load_scene


@cache
def make_scene(name: str, size: tuple[int, int]) -> Scene:
    """A built-in scene, or one of the variants below."""
    base = {"sunlit-street": "night-street", "hidden-sky": "night-street", "materials": "chrome"}
    base |= dict.fromkeys(("cat-eye", "blades", "mask", "pinhole"), "fairy-lights")
    scene = load_scene(base.get(name, name), Overrides(*size))
    if name in ("sunlit-street", "hidden-sky"):
        suns = (Sun((0.15, 0.196, -0.969), 3.0, (0.5, 0.4, 0.3)), Sun((0.48, 0.8, 0.36), 0.5, (0.3, 0.4, 0.5)))
        scene = replace(scene, suns=suns, environment=replace(scene.environment, visible=name == "sunlit-street", rotation=20.0))
    elif name == "materials":
        meshes = tuple(replace(mesh, uvs=np.ascontiguousarray(9.0 * mesh.vertices[:, None, :2])) for mesh in scene.meshes)
        scene = replace(scene, meshes=meshes, materials=tuple(map(varied, range(len(scene.materials)), scene.materials)))
    elif name == "pinhole":
        scene = replace(scene, camera=replace(scene.camera, aperture_radius=0.0))
    elif name in ("cat-eye", "blades", "mask"):
        mask = np.linspace(0.0, 1.0, 12 * 9, dtype=np.float32).reshape(9, 12)
        apertures = {
            "cat-eye": Aperture(cat_eye=0.7),
            "blades": Aperture(5, 10.0, 0.3, 1.4, edge=0.5),
            "mask": Aperture(image=mask),
        }
        scene = replace(scene, camera=replace(scene.camera, aperture=apertures[name]))
    return scene


def varied(number: int, material: Material) -> Material:
    """The material, or, where it is no emitter, with one of the terms that built-in scenes do not have."""
    texture = Texture(np.random.default_rng(7).uniform(0.3, 1.0, (8, 8, 4)).astype(np.float32), wrap=("mirror", "repeat"))
    kinds = (
        {"base_color_texture": texture, "alpha_mode": "mask"},
        {"normal_texture": texture, "clearcoat": 0.8, "clearcoat_roughness": 0.1},
        {"metallic": 0.0, "transmission": 0.9, "attenuation_color": (0.9, 0.5, 0.3), "attenuation_distance": 0.02},
        {"metallic": 0.0, "opacity": 0.6, "alpha_mode": "blend"},
        {"metallic": 0.0, "transmission": 0.8, "thin": True},
        {"metallic_roughness_texture": texture, "specular_color": (0.9, 0.6, 0.3)},
    )
    if material.emits:
        return replace(material, emission_cone=Cone((0.0, 0.0, 1.0), 30.0, 70.0) if number % 2 else None)
    return replace(material, **kinds[number % len(kinds)])
