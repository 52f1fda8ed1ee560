"""A path tracer with a thin-lens camera: camera, lens, film, and the radiance along rays.

The package is callable: `bokehguide.render(scene)` is `bokehguide.picture.render(scene)`, which renders a whole picture. Python
binds the name `bokehguide.render` to this package as soon as any module imports a part of it, so a function of that name could
not stay there.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any

from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.film import Film, FilmSamples
from bokehguide.render.lens import Lens
from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.random import PixelRandom

__all__ = ["Film", "FilmSamples", "Lens", "PathSamples", "PathTracer", "PixelRandom", "ThinLensCamera"]


class _CallablePackage(ModuleType):
    """The type of this package."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """See `bokehguide.picture.render`."""
        return import_module("bokehguide.picture").render(*arguments, **options)  # by name: this layer imports none above


sys.modules[__name__].__class__ = _CallablePackage
