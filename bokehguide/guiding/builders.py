"""Functions that build the strategies of the modes in `modes.py`, one for each mode."""

from __future__ import annotations

from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.emitter_guide import EmitterGuide
from bokehguide.guiding.gaussian_guide import GaussianGuide
from bokehguide.guiding.learned_lights import LearnedLights
from bokehguide.guiding.modes import is_pinhole
from bokehguide.guiding.pixel_reuse import PixelReuse
from bokehguide.guiding.protocols import LensSampler, LightStrategy, Mode, ModeContext
from bokehguide.guiding.uniform import UniformLens


def uniform(context: ModeContext) -> Mode:
    return Mode(UniformLens(context), LightStrategy(context))


def lis(context: ModeContext) -> Mode:
    return Mode(paper_lens(context, learns_blend=False, learns_offsets=False), LightStrategy(context))


def lis_b(context: ModeContext) -> Mode:
    return Mode(paper_lens(context, learns_blend=True, learns_offsets=False), LightStrategy(context))


def lis_o(context: ModeContext) -> Mode:
    return Mode(paper_lens(context, learns_blend=True, learns_offsets=True), LightStrategy(context))


def guided(context: ModeContext) -> Mode:
    """All strategies of the mode. A pinhole has one lens point, so that only the choice of light samples learns."""
    config: GuidedConfig = context.settings.guided
    lights = LightStrategy(context) if context.tracer.lights.empty else LearnedLights(context, config)
    if is_pinhole(context):
        return Mode(UniformLens(context, config.split_count), lights)
    return Mode(EmitterGuide(context, config), lights, PixelReuse(context, config))


def paper_lens(context: ModeContext, learns_blend: bool, learns_offsets: bool) -> LensSampler:
    """The paper's guide."""
    return GaussianGuide(context, context.settings.gaussian, learns_blend, learns_offsets)
