"""Defocused photographs by path tracing with guided lens sampling.

`bokehguide.render(scene)` renders a scene and returns a `Picture`. `bokehguide.view(scene)` shows a scene on a page on which its
depth of field can be set. The names below are imported when they are first used, so
that `import bokehguide` and `bokehguide --help` do not wait for PyTorch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from bokehguide.lazy_names import lazy_names

if TYPE_CHECKING:
    from bokehguide.errors import BokehguideError
    from bokehguide.guiding.lens_guide import LensGuide
    from bokehguide.picture import Picture, render
    from bokehguide.scene import (
        Aperture,
        Camera,
        Cone,
        Environment,
        FilmSettings,
        Inset,
        Material,
        Mesh,
        Overrides,
        Scene,
        Sun,
        Texture,
        load_scene,
    )
    from bokehguide.train import RenderLoop, RenderSettings
    from bokehguide.view.notebook import view

__version__ = "0.4.0"

__all__ = [
    "Aperture",
    "BokehguideError",
    "Camera",
    "Cone",
    "Environment",
    "FilmSettings",
    "Inset",
    "LensGuide",
    "Material",
    "Mesh",
    "Overrides",
    "Picture",
    "RenderLoop",
    "RenderSettings",
    "Scene",
    "Sun",
    "Texture",
    "load_scene",
    "render",
    "view",
]

_HOMES = {
    "BokehguideError": "errors",
    "LensGuide": "guiding.lens_guide",
    "Picture": "picture",
    "RenderLoop": "train",
    "RenderSettings": "train",
}
"""Modules of the exported names; `scene` has the others."""

_name, __dir__ = lazy_names(__name__, __all__, _HOMES, "scene")


def __getattr__(name: str) -> Any:
    if name in ("render", "view"):  # packages, which are callable as well
        return import_module(f"bokehguide.{name}")
    return _name(name)
