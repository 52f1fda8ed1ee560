"""A lens sampler that learns from a record of primary hits: the base class of `GaussianGuide` and `EmitterGuide`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from bokehguide.guiding.lens_queries import MixtureQuery
from bokehguide.guiding.protocols import BatchSamples, LensContext, LensRecord, LensSampler
from bokehguide.guiding.record_buffer import FAR, Raster, Records
from bokehguide.models.candidates import CandidateList
from bokehguide.models.gaussian_field import GaussianField
from bokehguide.models.kl import one_sample_kl
from bokehguide.render.path_tracer import PathSamples
from bokehguide.render.tracer import MISS_DISTANCE
from bokehguide.render.vector import luminance
from bokehguide.runtime import native


@dataclass(kw_only=True)
class GuideRecord(LensRecord):
    """The report of one batch to a guide.

    records: samples for the record of primary hits. learned: result of `learn_from`, None for a batch without candidates.
    """

    records: Records
    learned: object | None = None


class Guide(LensSampler):
    """Learns the lens distribution of each pixel: records primary hits, fits a field of highlights, and lists candidates.

    A candidate of a pixel is a component of the field that the pixel may see through the lens. Threads call `query` and `record`
    concurrently, with different batches of pixels. `update` ends a step.
    """

    learns = True
    record_buffer: Raster
    highlight_cells: Tensor
    epoch: Tensor
    candidates: CandidateList | None = None
    """Candidates of each pixel, None if the field is empty."""

    def __init__(self, context: LensContext):
        super().__init__(context)
        self.field = GaussianField()
        self.register_buffer("highlight_cells", torch.zeros(0, dtype=torch.int64))
        self.register_buffer("epoch", torch.tensor(1))
        """First step of the epoch, on the host, so that no reader waits for the device."""

    @property
    def component_count(self) -> int:
        return len(self.field)

    def record(self, samples: BatchSamples, good: Tensor) -> GuideRecord:
        query = samples.query if isinstance(samples.query, MixtureQuery) else None
        weight, ratio, figures = self._weights_and_ratios(samples, good, query)
        light = self.recorded_light(samples.paths, good)
        records = self.records(samples.drawn.points, samples.directions, self.recorded_distance(samples), light, weight)
        learned = None if query is None else self.learn_from(samples, query, ratio)
        return GuideRecord(records=records, learned=learned, figures=figures)

    def _weights_and_ratios(
        self, samples: BatchSamples, good: Tensor, query: MixtureQuery | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Weights `[N]` of the samples, 0 for those that are not on the film; ratios `[N]` as `learn_from` takes them; and
        `LensRecord.figures`. Without a mixture, the ratios are undefined and the figures are 0."""
        weight, radiance, core = samples.drawn.weight, samples.paths.radiance, native.core_on(samples.drawn.weight.device)
        figures = torch.zeros(4, dtype=torch.float64, device=weight.device)
        # The unit of radiance is the frame's mean luminance. While the mean is 0, the ratio is 0.
        unit, area = samples.batch.mean_luminance or math.inf, self.camera.lens.area
        if core is not None:
            weights, ratio, mixture = torch.empty_like(weight), torch.empty_like(weight), (None, None, None)
            if query is not None:
                mixture = query.own_pdf(samples.drawn), query.mixture.beta, query.mixture.guided
            given = (radiance.contiguous(), weight.contiguous(), good)
            core.weigh_samples(*given, *mixture, unit, area, weights, ratio, figures)
            return weights, ratio, figures
        weight = weight.nan_to_num(0.0, 0.0, 0.0) * good
        if query is None:
            return weight, weight, figures
        ratio = finite(luminance(radiance), good) * weight / unit
        loss = one_sample_kl(ratio, query.own_pdf(samples.drawn), area)
        return weight, ratio, _figures(query, weight, loss)

    def learn_from(self, samples: BatchSamples, query: MixtureQuery[Any], ratio: Tensor) -> object:
        """Report of one sample per pixel for learning the mixture; `accumulate` receives it as `GuideRecord.learned`.

        ratio: L / (A q) over the mean luminance of the frame, `[N]`, 0 outside the lens.
        """
        raise NotImplementedError

    def recorded_light(self, paths: PathSamples, good: Tensor) -> Tensor:
        """Luminance `[N]` of the samples for the record, 0 for samples that are not on the film."""
        core = native.core_on(good.device)
        if core is None:
            return finite(luminance(paths.radiance), good)
        light = torch.empty(len(good))
        core.recorded_light(paths.radiance.contiguous(), good, None, None, None, False, light)
        return light

    def recorded_distance(self, samples: BatchSamples) -> Tensor:
        """Distance `[N]` along each camera ray at which the record places the light of the ray."""
        return samples.paths.distance

    def records(self, points: Tensor, directions: Tensor, distance: Tensor, light: Tensor, weight: Tensor) -> Records:
        """Records of `light` `[N]` at `distance` `[N]`, metres, along rays from lens points `[2, N]` in world directions
        `[3, N]`; weight: of the samples, `[N]`, 0 for samples to leave out."""
        core, far = native.core_on(distance.device), FAR * self.camera.lens.focus_distance
        if core is not None:
            cells, position = self._hits_by_core(core, points, directions, distance, weight, far)
            return Records(cells, position, light)
        directions = self.camera.axes.T @ directions
        position = _positions(points, directions, distance, far)
        cells = self.record_buffer.cells(self.camera, position)
        return Records(torch.where(weight > 0.0, cells, -1), position, light)

    def _hits_by_core(
        self, core: ModuleType, points: Tensor, directions: Tensor, distance: Tensor, weight: Tensor, far: float
    ) -> tuple[Tensor, Tensor]:
        """Cells and positions of `records` by the native core."""
        camera, record = self.camera, self.record_buffer
        frame, raster = (camera.width, camera.height, camera.pixel_slope), (record.border, record.width, record.height)
        position, cells = torch.empty(3, len(distance)), torch.empty(len(distance), dtype=torch.int64)
        rays = [values.contiguous() for values in (points, directions, distance, weight)]
        core.record_hits(frame, raster, (far, MISS_DISTANCE), camera.axes.contiguous(), *rays, position, cells)
        return cells, position

    def images(self, beta: Tensor) -> dict[str, Tensor]:
        """Images of β, the record and its highlight cells. The last two images include the margin of the record."""
        beta = beta.reshape(self.camera.height, self.camera.width)
        if self.candidates is not None:
            beta = beta * (self.candidates.counts() > 0).reshape(beta.shape)
        radiance = self.record_buffer.radiance()
        highlights = torch.zeros(radiance.numel(), device=radiance.device)
        highlights[self.highlight_cells] = 1.0
        bright = radiance / (radiance + radiance.mean().clamp(min=1e-20))
        images = {"beta": beta, "record": bright, "highlights": highlights.reshape(radiance.shape)}
        return {name: image[..., None].expand(-1, -1, 3).float() for name, image in images.items()}

    def check(self, step: int) -> None:
        super().check(step)
        if bool((self.highlight_cells >= self.record_buffer.height * self.record_buffer.width).any()):
            raise ValueError("highlights outside the record")
        if not 1 <= int(self.epoch) <= step + 1:
            raise ValueError("an epoch that has not begun")


def learned_of(records: Sequence[GuideRecord]) -> list:
    """All values of `GuideRecord.learned` that are not None."""
    return [record.learned for record in records if record.learned is not None]


def finite(light: Tensor, good: Tensor) -> Tensor:
    """Luminance `[N]` of the samples that are on the film, 0 for all other samples."""
    return light.nan_to_num(0.0, 0.0, 0.0) * good


def _figures(query: MixtureQuery, weight: Tensor, loss: Tensor) -> Tensor:
    guided, beta = query.mixture.guided, query.mixture.beta
    return torch.stack([each.double() for each in (guided.sum(), ((weight == 0.0) & guided).sum(), beta.sum(), loss)])


def _positions(points: Tensor, directions: Tensor, distance: Tensor, far: float) -> Tensor:
    """Positions `[3, N]` at `distance` `[N]` along camera-frame directions `[3, N]` from lens points `[2, N]`.

    Rays that left the scene begin at the lens centre and end at the distance `far`.
    """
    hit = distance < MISS_DISTANCE
    origin = torch.stack((points[0] * hit, points[1] * hit, torch.zeros_like(distance)))
    return origin + directions * torch.where(hit, distance, far)
