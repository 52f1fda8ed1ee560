"""The settings of a render."""

from __future__ import annotations

from dataclasses import dataclass, field

from bokehguide.errors import BokehguideError
from bokehguide.guiding.config import GaussianConfig, GuidedConfig
from bokehguide.guiding.modes import MODES
from bokehguide.limits import MAX_SIDE
from bokehguide.scene.checks import Fields
from bokehguide.scene.tables import Limits

DEVICES = ("cpu", "cuda")
LENS_MODES = tuple(name for name, entry in MODES.items() if not entry.whole_frame)
"""Modes that render any part of a frame by itself."""

WHOLE = {
    "spp": Limits("a whole number of samples per pixel, at least 1", low=1),
    "seed": Limits("a whole number", low=-(2**63), high=2**63),
    "threads": Limits("a whole number of threads, at least 1", low=1),
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
    seed: of all random numbers.
    device: "cpu" or "cuda" (shading, guiding and learning; Embree runs on the CPU).
    threads: worker threads; None: one for each core.
    reuse_radius: radius in pixels of the neighbourhood in which Area ReSTIR reuses samples. The paper's 50 is for a width of
    1920 pixels; 50 · width / 1920 covers the same part of a smaller picture.
    crop: x, y, width, height in pixels from the top left, of the part of the frame to render.
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
    crop: tuple[int, int, int, int] | None = None
    target_noise: float | None = None
    denoise: bool = False
    cryptomatte: bool = False
    light_groups: bool = False
    gaussian: GaussianConfig = field(default_factory=GaussianConfig)
    guided: GuidedConfig = field(default_factory=GuidedConfig)

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise BokehguideError(f"mode: {self.mode!r} is unknown; choose one of {', '.join(MODES)}")
        if self.device not in DEVICES:
            raise BokehguideError(f"device: {self.device!r} is unknown; choose {' or '.join(DEVICES)}")
        fields = _Settings(self)
        absent = {key for key in ("threads", "target_noise") if getattr(self, key) is None}
        fields.check_wholes(**{key: limits for key, limits in WHOLE.items() if key not in absent})
        fields.check_numbers(**{key: limits for key, limits in NUMBERS.items() if key not in absent})
        fields.check_flags("denoise", "cryptomatte", "light_groups")
        if self.crop is not None:
            fields.check_tuple("crop", 4)
            fields.keep("crop", tuple(map(int, self.crop)))
        for key in ("crop", "target_noise", "light_groups"):
            if getattr(self, key) not in (None, False) and self.whole_frame:
                raise BokehguideError(
                    f"{key}: {self.mode} reuses samples of the whole frame; leave it out, or choose another mode"
                )

    def window(self, width: int, height: int) -> tuple[int, int, int, int]:
        """The crop of a frame of this size, by default the whole frame. Raises BokehguideError if the crop leaves the frame."""
        x, y, across, down = self.crop or (0, 0, width, height)
        if not (x >= 0 and y >= 0 and 0 < across <= width - x and 0 < down <= height - y):
            box = f"{x},{y},{across},{down}"
            raise BokehguideError(f"crop: {box} leaves the frame; give X,Y,W,H within its {width} x {height} pixels")
        return x, y, across, down

    @property
    def whole_frame(self) -> bool:
        """Whether one process must render the whole frame, without a crop and without a target noise."""
        return MODES[self.mode].whole_frame
