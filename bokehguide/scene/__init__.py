"""Scenes: plain data, read from scene files, model files or built-in scenes."""

from bokehguide.scene.builtin import BUILTIN, DESCRIPTIONS
from bokehguide.scene.emitters import lens_coverage
from bokehguide.scene.loading import load_scene
from bokehguide.scene.overrides import Overrides
from bokehguide.scene.summary import summarize
from bokehguide.scene.types import Aperture, Camera, Cone, Environment, FilmSettings, Inset, Material, Mesh, Scene, Sun, Texture

__all__ = [
    "BUILTIN",
    "DESCRIPTIONS",
    "Aperture",
    "Camera",
    "Cone",
    "Environment",
    "FilmSettings",
    "Inset",
    "Material",
    "Mesh",
    "Overrides",
    "Scene",
    "Sun",
    "Texture",
    "lens_coverage",
    "load_scene",
    "summarize",
]
