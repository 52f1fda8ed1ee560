"""Scenes: what is photographed, read from built-ins, scene files and models."""

from bokehguide.scene.builtin import BUILTIN, DESCRIPTIONS
from bokehguide.scene.describing import describe
from bokehguide.scene.lamps import lens_coverage
from bokehguide.scene.loading import load_scene
from bokehguide.scene.overrides import Overrides
from bokehguide.scene.types import Aperture, Camera, Cone, Environment, Film, Inset, Material, Mesh, Scene, Sun, Texture

__all__ = [
    *("BUILTIN", "DESCRIPTIONS", "Aperture", "Camera", "Cone", "Environment", "Film", "Inset", "Material", "Mesh"),
    *("Overrides", "Scene", "Sun", "Texture", "describe", "lens_coverage", "load_scene"),
]
