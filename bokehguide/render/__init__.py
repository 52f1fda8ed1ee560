"""A path tracer with a thin-lens camera: camera, lens, film, and the radiance along rays.

The package is callable: `bokehguide.render(scene)` is `bokehguide.picture.render(scene)`, which renders a whole picture. Python
binds the name `bokehguide.render` to this package as soon as any module imports a part of it, so a function of that name could
not stay there.
"""

from bokehguide.lazy_names import make_callable
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.film import Film, FilmSamples
from bokehguide.render.lens import Lens
from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.random import PixelRandom

__all__ = ["Film", "FilmSamples", "Lens", "PathSamples", "PathTracer", "PixelRandom", "ThinLensCamera"]

make_callable(__name__, "bokehguide.picture")  # by name: this layer imports none above
