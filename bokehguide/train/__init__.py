"""Rendering as training: the loop, the guide that learns, the logger."""

from bokehguide.train.checkpoint import load_checkpoint, save_checkpoint, saved_steps
from bokehguide.train.logger import RenderLogger
from bokehguide.train.loop import RenderLoop, StepStats
from bokehguide.train.metadata import describe_render
from bokehguide.train.settings import LENS_MODES, MODES, RenderSettings

__all__ = [
    *("LENS_MODES", "MODES", "RenderLogger", "RenderLoop", "RenderSettings", "StepStats", "describe_render"),
    *("load_checkpoint", "save_checkpoint", "saved_steps"),
]
