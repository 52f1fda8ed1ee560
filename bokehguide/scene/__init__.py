"""Scenes: plain data, read from scene files, model files or built-in scenes.

The names below are imported when they are first used, so that the process of `usd/isolation.py` starts soon.
"""

from typing import TYPE_CHECKING

from bokehguide.lazy_names import lazy_names

if TYPE_CHECKING:
    from bokehguide.scene.builtin import BUILTIN, DESCRIPTIONS
    from bokehguide.scene.emitters import lens_coverage
    from bokehguide.scene.loading import load_scene
    from bokehguide.scene.overrides import Overrides
    from bokehguide.scene.summary import summarize
    from bokehguide.scene.types import (
        Aperture,
        Camera,
        Cone,
        Environment,
        FilmSettings,
        Inset,
        Material,
        Mesh,
        Scene,
        Sun,
        Texture,
    )

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

_HOMES = {
    "BUILTIN": "builtin",
    "DESCRIPTIONS": "builtin",
    "Overrides": "overrides",
    "lens_coverage": "emitters",
    "load_scene": "loading",
    "summarize": "summary",
}
"""Modules of the exported names; `types` has the others."""

__getattr__, __dir__ = lazy_names(__name__, __all__, _HOMES, "types")
