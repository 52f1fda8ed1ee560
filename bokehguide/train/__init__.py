"""Rendering as training: the loop, the guide that learns, the logger."""

from bokehguide.train.loop import RenderLoop, StepStats
from bokehguide.train.settings import MODES, RenderSettings

__all__ = ["MODES", "RenderLoop", "RenderSettings", "StepStats"]
