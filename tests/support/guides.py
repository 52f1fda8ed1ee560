"""Guides without a render, and queries of guides, for tests of their modules."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from bokehguide.guiding.config import GaussianConfig
from bokehguide.guiding.emitter_guide import EmitterGuide
from bokehguide.guiding.gaussian_guide import GaussianGuide
from bokehguide.guiding.guide import Guide, GuideRecord
from bokehguide.guiding.lens_queries import MixtureQuery
from bokehguide.guiding.protocols import BatchSamples, LensPoints, ModeContext, PixelBatch, StepSummary
from bokehguide.guiding.record_buffer import Records
from bokehguide.models.base import LensMixture, LensSample
from bokehguide.models.ellipse_mixture import EllipseMixture
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.random import PixelRandom
from bokehguide.runtime import native
from bokehguide.runtime.distributed import Ranks
from bokehguide.runtime.indexing import Pixels, pixel_numbers
from bokehguide.scene.types import Camera
from bokehguide.train import RenderSettings


def context(camera: ThinLensCamera, ranks: Ranks | None = None) -> ModeContext:
    """The context of a whole frame, without a scene."""
    owned = torch.ones(camera.width * camera.height, dtype=torch.bool)
    return ModeContext(None, camera, None, camera.width, camera.height, RenderSettings("guided"), ranks or Ranks(), owned)


def gaussian_guide(camera: ThinLensCamera, mode: str = "lis-o", config: GaussianConfig | None = None) -> GaussianGuide:
    """The guide of one of the paper's modes."""
    return GaussianGuide(context(camera), config or GaussianConfig(), mode in ("lis-b", "lis-o"), mode == "lis-o")


def film_context(width: int, height: int, ranks: Ranks | None = None) -> ModeContext:
    """The context of a film of this size, without a scene."""
    return context(ThinLensCamera(Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0)), width, height), ranks)


def pixel_batch(guide: Guide, pixels: Pixels | None = None, raster: Tensor | None = None) -> PixelBatch:
    """Pixels of the guide's camera, by default all, in a step of the present epoch; raster: by default the pixels' centres."""
    camera = guide.camera
    pixels = slice(0, camera.width * camera.height) if pixels is None else pixels
    numbers = pixel_numbers(pixels)
    corner = torch.stack((numbers % camera.width, numbers // camera.width))
    raster = corner + 0.5 if raster is None else raster
    step = max(int(guide.epoch), 2)  # GaussianGuide is uniform in step 1
    focus = camera.focus_points(raster)
    return PixelBatch(step, pixels, pixels, raster, raster - corner, focus, PixelRandom(0, step, numbers), 1.0)


def mixture_query(guide: Guide, batch: PixelBatch) -> MixtureQuery:
    """The guide's query for a batch with candidates."""
    query = guide.query(batch)
    assert isinstance(query, MixtureQuery)
    return query


def mixture_of(guide: Guide, batch: PixelBatch | None = None) -> LensMixture:
    """The mixture that the guide draws from, by default at the centres of all pixels."""
    return mixture_query(guide, batch or pixel_batch(guide)).mixture


def pytorch_mixture(guide: EmitterGuide, batch: PixelBatch) -> EllipseMixture:
    """The mixture of `mixture_of` in PyTorch, with its ellipses."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(native.SWITCH, "0")
        guide.set_candidates()
        mixture = mixture_of(guide, batch)
    guide.set_candidates()
    assert isinstance(mixture, EllipseMixture)
    return mixture


def samples_of(batch: PixelBatch, query: MixtureQuery, drawn: LensSample) -> BatchSamples:
    """Lens points drawn from a query, as `Guide.learn_from` takes them: without paths."""
    at = query.mixture.evaluate(drawn.points)
    points = LensPoints(drawn.points, torch.ones_like(at.density), at, drawn.candidate)
    return BatchSamples(batch, query, points, None, None, (), (), None)


def learned_record(learned: object) -> GuideRecord:
    """The report of a batch without primary hits."""
    records = Records(torch.zeros(0, dtype=torch.int64), torch.zeros(3, 0), torch.zeros(0))
    return GuideRecord(records=records, learned=learned)


def summary(step: int, mean_luminance: float = 1.0) -> StepSummary:
    """The summary of a step, without a picture."""
    return StepSummary(step, mean_luminance, lambda: torch.zeros(0))
