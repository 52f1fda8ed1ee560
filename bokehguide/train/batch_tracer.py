"""The samples of one batch of pixels: rays from drawn lens points, their paths, and the estimates that the film adds."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from bokehguide.guiding.protocols import BatchSamples, LensPoints, LensQuery, Mode, PixelBatch
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.film import FilmSamples
from bokehguide.render.light_groups import GroupedLights
from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.shadow_roulette import ShadowRoulette
from bokehguide.runtime.timer import PhaseTimer


@dataclass(frozen=True)
class BatchTracer:
    """Traces the paths of batches. Threads share it, as it changes nothing.

    groups: light groups of the film, None without.
    """

    camera: ThinLensCamera
    tracer: PathTracer
    mode: Mode
    shadow_roulette: ShadowRoulette
    groups: GroupedLights | None

    def trace(self, batch: PixelBatch, query: LensQuery, drawn: LensPoints, timer: PhaseTimer) -> BatchSamples:
        """Samples with whole paths from the lens points that `query` has drawn."""
        lens, lights = self.mode.lens, self.mode.lights
        origins, directions = self.camera.rays(batch.focus, drawn.points)
        of_lens, of_lights = lens.observers(batch), lights.observers()
        paths = self.tracer.trace(
            origins,
            directions,
            batch.random,
            timer,
            alive=drawn.weight,
            light_sampler=lights.sampler,
            splitting=lens.splitting(drawn.weight),
            observers=(*of_lens, *of_lights),
            groups=self.groups,
            shadow_threshold=self.shadow_roulette.thresholds(batch.places, drawn.weight),
        )
        film = film_samples(self.camera, paths, directions, drawn.weight)
        return BatchSamples(batch, query, drawn, directions, paths, of_lens, of_lights, film)

    def trace_features(self, batch: PixelBatch, drawn: LensPoints, timer: PhaseTimer) -> tuple[FilmSamples, int]:
        """Samples with paths of one segment, for the features of the film, and the number of rays."""
        origins, directions = self.camera.rays(batch.focus, drawn.points)
        seen = self.tracer.trace(origins, directions, batch.random, timer, max_depth=1)
        return film_samples(self.camera, seen, directions, drawn.weight), seen.rays


def film_samples(camera: ThinLensCamera, paths: PathSamples, directions: Tensor, weight: Tensor) -> FilmSamples:
    """Samples in the form that the film adds. directions: of the camera rays, world frame, `[3, N]`. weight: W / (A q), `[N]`."""
    depth = camera.depth(paths.distance, directions)
    found = weight, paths.radiance, paths.alpha, depth, paths.normal, paths.albedo, paths.emission
    return FilmSamples(*found, triangle=paths.triangle, groups=None if paths.groups is None else paths.groups.rays)
