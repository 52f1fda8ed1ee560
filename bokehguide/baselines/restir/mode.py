"""The modes `area-restir` and `area-restir+lis`: spatial reuse of samples of the uniform lens and of `lis-o`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

from torch import Tensor

from bokehguide.baselines.restir.spatial_reuse import SpatialReuse
from bokehguide.guiding.builders import paper_lens
from bokehguide.guiding.protocols import BatchSamples, LightStrategy, Mode, ModeContext, SampleReuse
from bokehguide.guiding.uniform import UniformLens
from bokehguide.render.film import FilmSamples
from bokehguide.runtime.indexing import Pixels
from bokehguide.runtime.timer import PhaseTimer


def area_restir(context: ModeContext) -> Mode:
    return Mode(UniformLens(context), LightStrategy(context), AreaRestir(context))


def area_restir_lis(context: ModeContext) -> Mode:
    lens = paper_lens(context, learns_blend=True, learns_offsets=True)
    return Mode(lens, LightStrategy(context), AreaRestir(context))


class AreaRestir(SampleReuse):
    """Sample reuse by a second pass over the frame, in which each pixel resamples its own sample and its neighbours' samples."""

    weighted = True
    roulette_cell = 0  # shifts trace a path again in another pixel, and the path must not depend on the pixel

    def __init__(self, context: ModeContext):
        super().__init__()
        settings = context.settings
        self.spatial = SpatialReuse(context.camera, context.tracer, settings.reuse_radius, settings.seed)

    def expose(self, samples: BatchSamples, film: Callable[[Pixels, FilmSamples], Tensor], timer: PhaseTimer) -> Tensor:
        """Keep the samples for the second pass; the film is unchanged."""
        batch = samples.batch
        span = cast(slice, batch.pixels)  # the mode renders whole frames
        return self.spatial.keep(span, batch.subpixel, samples.drawn.points, samples.paths, samples.film)

    def second_pass(self, spans: Sequence[slice]) -> Sequence[slice]:
        return spans

    def resample(self, span: slice, step: int, timer: PhaseTimer) -> tuple[FilmSamples, int]:
        return self.spatial.resample(span, step, timer)
