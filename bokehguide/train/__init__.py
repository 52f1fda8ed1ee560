"""Rendering as training: the loop, the guide that learns, the logger."""

from bokehguide.train.adaptive import AdaptiveLoop, make_loop
from bokehguide.train.checkpoint import load_checkpoint, save_checkpoint, saved_steps
from bokehguide.train.logger import RenderLogger
from bokehguide.train.loop import RenderLoop
from bokehguide.train.metadata import describe_render
from bokehguide.train.ranks import Ranks, restarts
from bokehguide.train.settings import LENS_MODES, MODES, RenderSettings
from bokehguide.train.steps import StepStats

__all__ = [
    *("AdaptiveLoop", "LENS_MODES", "MODES", "Ranks", "RenderLogger", "RenderLoop", "RenderSettings", "StepStats"),
    *("describe_render", "load_checkpoint", "make_loop", "restarts", "save_checkpoint", "saved_steps"),
]
