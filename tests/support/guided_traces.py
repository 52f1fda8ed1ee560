"""Traces of the mode `guided` by the native core and by PyTorch."""

from functools import cache

import torch
from torch import Tensor

from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.light_sampler import LearnedLightSampler, LightSampleRecorder, LightSamples
from bokehguide.guiding.virtual_images import HighlightImages
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.primary_hits import PrimaryHits
from bokehguide.render.random import PixelRandom
from bokehguide.render.splitting import SplitPaths
from bokehguide.runtime.timer import PhaseTimer
from tests.support.native_cases import both_tracers, feature_scene

COUNT = 3000
FLIPS = 0.004
"""Largest share of paths that rounding may send elsewhere."""
PIXELS = (96, 54)


def differing(found: Tensor, expected: Tensor, tolerance: float = 1e-3) -> float:
    """Share of columns that differ by more than rounding."""
    found, expected = found.reshape(-1, found.shape[-1]).double(), expected.reshape(-1, expected.shape[-1]).double()
    scale = expected.abs().amax(0) + 1e-3
    return float((((found - expected).abs().amax(0) / scale) > tolerance).double().mean())


@cache
def sampler(name: str, learned: bool) -> LearnedLightSampler:
    """A light sampler in its first epoch, or after random samples that leave some clusters without any."""
    _, reference = both_tracers(name)
    camera = ThinLensCamera(feature_scene(name).camera, *PIXELS)
    lights = LearnedLightSampler(camera, reference.light_sampler, GuidedConfig())
    if learned:
        generator = torch.Generator().manual_seed(8)
        tiles, clusters = lights.probability.shape
        row, cluster = (torch.randint(size, (4000,), generator=generator, dtype=torch.int32) for size in (tiles, clusters))
        rms, visibility, difference, rest = torch.rand(4, 4000, generator=generator)
        difference = difference - 0.5
        samples = LightSamples(row, cluster, (rms * 4.0).exp(), (visibility > 0.5).float(), difference)
        lights.add([lights.batch(samples, rest - 0.3 * difference)])
        lights.update(3)  # the step of `rays` is in this epoch: copies of paths are stratified together
    return lights


class Traced:
    """A trace of the mode `guided`, and the records of its observers."""

    def __init__(self, tracer: PathTracer, name: str, given: tuple[Tensor, Tensor, PixelRandom], learned: bool = True, **options):
        origin, direction, random = given
        counts = torch.randint(1, 5, (origin.shape[1],), generator=torch.Generator().manual_seed(4)).float()
        self.lights, self.images = LightSampleRecorder(), HighlightImages(tracer.geometry, origin.shape[1], 0.2)
        lit = not tracer.lights.empty
        self.samples: PathSamples = tracer.trace(
            origin,
            direction,
            random,
            PhaseTimer(),
            light_sampler=sampler(name, learned) if lit else None,
            splitting=SplitPaths(options.pop("counts", counts)),
            observers=(self.lights, self.images),
            **options,
        )

    @property
    def hits(self) -> PrimaryHits:
        assert self.samples.primary_hits is not None
        return self.samples.primary_hits
