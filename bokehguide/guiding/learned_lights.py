"""The light strategy of the mode `guided`: light samples at primary hits, chosen by learned second moments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.inheritance import Learned
from bokehguide.guiding.light_sampler import LearnedLightSampler, LightBatch, LightSampleRecorder
from bokehguide.guiding.protocols import BatchSamples, LightStrategy, ModeContext, StepSummary
from bokehguide.render.observer import PathObserver
from bokehguide.render.vector import luminance


class LearnedLights(LightStrategy):
    """Light strategy in which a `LearnedLightSampler` chooses light samples. The sampler learns at the ends of epochs."""

    learns = True
    inherits = True
    sampler: LearnedLightSampler

    def __init__(self, context: ModeContext, config: GuidedConfig):
        super().__init__(context)
        self.sampler = LearnedLightSampler(context.camera, context.tracer.light_sampler, config, context.ranks)
        self._learns = config.learn_lights

    def observers(self) -> Sequence[PathObserver]:
        return (LightSampleRecorder(),)

    def record(self, samples: BatchSamples) -> list[LightBatch]:
        """Light samples of the paths of a batch."""
        hits, recorders = samples.paths.primary_hits, cast(Sequence[LightSampleRecorder], samples.light_observers)
        if hits is None:
            return []
        reflected = luminance(hits.direct + hits.indirect)
        return [self.sampler.batch(found, reflected) for recorder in recorders for found in recorder.samples]

    def accumulate(self, records: Sequence[list[LightBatch]], summary: StepSummary) -> None:
        self.sampler.add([batch for record in records for batch in record], summary.threads)

    def update(self, summary: StepSummary) -> None:
        if summary.ends_epoch and self._learns:
            self.sampler.update(summary.step + 1, summary.threads)

    def inherit(self, learned: Learned, name: str) -> None:
        if self._learns:
            sums = (learned.state[name][f"sampler.{each}"] for each in ("sums", "factors.sums"))
            self.sampler.inherit(learned, *sums)

    def merge(self) -> None:
        self.sampler.merge()

    def load_state_dict(self, state_dict, *args, **kwargs):
        """Load the sampler by `LearnedLightSampler.load_state_dict`, which PyTorch does not call for submodules."""
        own = {name.removeprefix("sampler."): value for name, value in state_dict.items()}
        return self.sampler.load_state_dict(own, *args, **kwargs)

    def check(self, step: int) -> None:
        if not 1 <= int(self.sampler.epoch) <= step + 1:
            raise ValueError("an epoch that has not begun")
