"""Rendering and learning, step by step: the loop, adaptive SPP (samples per pixel), checkpoints and logs."""

from bokehguide.guiding.modes import MODES
from bokehguide.runtime.distributed import Ranks, restarts
from bokehguide.train.adaptive import AdaptiveLoop, make_loop
from bokehguide.train.checkpoint import load_checkpoint, save_checkpoint, saved_state
from bokehguide.train.denoising import DenoisedPicture, denoise_picture
from bokehguide.train.logger import RenderLogger
from bokehguide.train.loop import RenderLoop
from bokehguide.train.mattes import matte_attributes, matte_layers
from bokehguide.train.metadata import describe_render
from bokehguide.train.settings import LENS_MODES, RenderSettings
from bokehguide.train.step_stats import StepStats

__all__ = [
    "LENS_MODES",
    "MODES",
    "AdaptiveLoop",
    "DenoisedPicture",
    "Ranks",
    "RenderLogger",
    "RenderLoop",
    "RenderSettings",
    "StepStats",
    "denoise_picture",
    "describe_render",
    "load_checkpoint",
    "make_loop",
    "matte_attributes",
    "matte_layers",
    "restarts",
    "save_checkpoint",
    "saved_state",
]
