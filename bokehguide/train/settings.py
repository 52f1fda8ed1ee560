"""The settings of a render."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from bokehguide.errors import BokehguideError
from bokehguide.guiding.config import GaussianConfig, GuidedConfig
from bokehguide.guiding.modes import MODES
from bokehguide.limits import MAX_INT, MAX_SIDE, MAX_THREADS
from bokehguide.scene.checks import Fields
from bokehguide.scene.tables import Limits, in_fractions, leaves_frame
from bokehguide.scene.types import Inset

DEVICES = ("cpu", "cuda")
LENS_MODES = tuple(name for name, entry in MODES.items() if not entry.whole_frame)
"""Modes that render any part of a frame by itself."""

WHOLE = {
    "spp": Limits(f"a whole number of samples per pixel from 1 to {MAX_INT}", low=1, high=MAX_INT),
    "seed": Limits(f"a whole number from {-(2**31)} to {2**32 - 1}", low=-(2**31), high=2**32 - 1),
    "threads": Limits(f"a whole number of threads from 1 to {MAX_THREADS}", low=1, high=MAX_THREADS),
}
NUMBERS = {
    "reuse_radius": Limits(f"pixels from 1 to {MAX_SIDE}", low=1.0, high=MAX_SIDE),
    "target_noise": Limits("a relative error from 1e-06 to 1", low=1e-6, high=1.0),
}


class _Settings(Fields):
    """The fields of the settings, by the names that the command line has as well."""

    def place(self, key: str) -> str:
        return key


@dataclass(frozen=True)
class RenderSettings:
    """Settings of one render.

    mode: a name of the registry `bokehguide.guiding.modes.MODES`. spp: samples per pixel; one step renders one sample per pixel.
    seed: of all random numbers, 32 bits: negative seeds stand for seeds above 2^31.
    device: "cpu" or "cuda" (shading, guiding and learning; Embree runs on the CPU). A `torch.device` of these becomes its name.
    threads: worker threads; None: one for each core.
    reuse_radius: radius in pixels of the neighbourhood in which Area ReSTIR reuses samples. The paper's 50 is for a width of
    1920 pixels; 50 · width / 1920 covers the same part of a smaller picture.
    crop: x, y, width, height, from the top left, of the part of the frame to render: whole pixels, or fractions of the frame if
    all are from 0 to 1 and one is a float.
    target_noise: estimated relative error at which a block of pixels ends; None: all pixels get spp samples.
    denoise: whether the film keeps two halves, which `bokehguide.train.denoise_picture` needs. Mode `guided`
    then reuses primary hits in the groups of `GuidedConfig.denoised_reuse_group`.
    cryptomatte: whether the film keeps the coverage of objects and materials, which `bokehguide.train.matte_layers` needs.
    light_groups: whether the film keeps the radiance of each light group of the scene.
    gaussian: settings of the paper's modes. guided: settings of the mode `guided`.
    Raises BokehguideError for a value out of range.
    """

    mode: str = "guided"
    spp: int = 256
    seed: int = 0
    device: str = "cpu"
    threads: int | None = None
    reuse_radius: float = 50.0
    crop: tuple[float, float, float, float] | None = None
    target_noise: float | None = None
    denoise: bool = False
    cryptomatte: bool = False
    light_groups: bool = False
    gaussian: GaussianConfig = field(default_factory=GaussianConfig)
    guided: GuidedConfig = field(default_factory=GuidedConfig)

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise BokehguideError(f"mode: {self.mode!r} is unknown; choose one of {', '.join(MODES)}")
        object.__setattr__(self, "device", _device_name(self.device))  # the dataclass is frozen
        if self.device not in DEVICES:
            raise BokehguideError(f"device: {self.device!r} is unknown; choose {' or '.join(DEVICES)}")
        fields = _Settings(self)
        absent = {key for key in ("threads", "target_noise") if getattr(self, key) is None}
        fields.check_wholes(**{key: limits for key, limits in WHOLE.items() if key not in absent})
        fields.check_numbers(**{key: limits for key, limits in NUMBERS.items() if key not in absent})
        fields.check_flags("denoise", "cryptomatte", "light_groups")
        fields.check_instances(GaussianConfig, "gaussian", optional=False)
        fields.check_instances(GuidedConfig, "guided", optional=False)
        if self.crop is not None:
            self._check_crop(fields)
        for key in ("crop", "target_noise", "light_groups"):
            if getattr(self, key) not in (None, False) and self.whole_frame:
                raise BokehguideError(
                    f"{key}: {self.mode} reuses samples of the whole frame; leave it out, or choose another mode"
                )

    def _check_crop(self, fields: _Settings) -> None:
        """Keep the crop as whole pixels or as fractions. Raises BokehguideError for other numbers."""
        given = fields.values["crop"]
        fields.check_tuple("crop", 4)
        box = fields.values["crop"]
        if in_fractions(box) and any(isinstance(value, float) for value in given):
            if leaves_frame(*box):
                fields.fail("crop", "leaves the frame; give X,Y,W,H as fractions of it, between 0 and 1")
            return
        if any(value != int(value) for value in box):
            fields.fail("crop", "is in pixels and not whole; give whole pixels, or fractions of the frame")
        fields.keep("crop", tuple(map(int, box)))

    def window(self, width: int, height: int) -> tuple[int, int, int, int]:
        """The crop of a frame of this size, by default the whole frame. Raises BokehguideError if the crop leaves the frame."""
        x, y, across, down = crop_pixels(self.crop, width, height) if self.crop else (0, 0, width, height)
        if not (x >= 0 and y >= 0 and 0 < across <= width - x and 0 < down <= height - y):
            box = f"{x},{y},{across},{down}"
            raise BokehguideError(f"crop: {box} leaves the frame; give X,Y,W,H within its {width} x {height} pixels")
        return x, y, across, down

    @property
    def whole_frame(self) -> bool:
        """Whether one process must render the whole frame, without a crop and without a target noise."""
        return MODES[self.mode].whole_frame


def crop_pixels(box: Sequence[float], width: int, height: int) -> tuple[int, int, int, int]:
    """x, y, width and height in pixels of a crop of a frame: floats from 0 to 1 are fractions of the frame."""
    if in_fractions(box) and any(isinstance(value, float) for value in box):
        rows, columns = Inset(*box).pixels(width, height)
        return columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start
    x, y, across, down = map(int, box)
    return x, y, across, down


def _device_name(device: Any) -> Any:
    """The name of a `torch.device`: "cpu" for each CPU, and "cuda" for the present GPU; other values as they are."""
    if not isinstance(device, torch.device):
        return device
    present = torch.cuda.current_device() if device.type == "cuda" and torch.cuda.is_available() else 0
    return device.type if device.type == "cpu" or device.index in (None, present) else str(device)
