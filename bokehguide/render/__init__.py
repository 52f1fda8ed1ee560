"""A path tracer with a thin-lens camera: camera, lens, film, and the radiance along rays."""

from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.film import Film, FilmSamples
from bokehguide.render.lens import Lens
from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.random import PixelRandom

__all__ = ["Film", "FilmSamples", "Lens", "PathSamples", "PathTracer", "PixelRandom", "ThinLensCamera"]
