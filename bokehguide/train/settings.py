"""What a render may be told."""

from __future__ import annotations

from dataclasses import dataclass

from bokehguide.errors import BokehguideError
from bokehguide.limits import MAX_SIDE

DEVICES = ("cpu", "cuda")
LENS_MODES = ("uniform", "lis", "lis-b", "lis-o", "guided")
"""Uniform lens sampling, independent from step to step as in the paper; the paper's modes: guided with
β = 0.8; with learnt β; with learnt β and polynomial offsets; and this project's own."""
REUSE_MODES = {"area-restir": "uniform", "area-restir+lis": "lis-o"}
"""Area ReSTIR, and the mode that draws the samples that it reuses."""
MODES = (*LENS_MODES, *REUSE_MODES)


@dataclass(frozen=True)
class RenderSettings:
    """Settings of one render.

    mode: one of MODES. spp: samples per pixel, one a step. seed: of all random numbers.
    device: "cpu" or "cuda" (shading, guiding and learning; Embree runs on the CPU).
    threads: worker threads, None for as many as there are processors. reuse_radius: of the
    neighbourhood in which Area ReSTIR reuses samples, in pixels; the paper's 50 is for a
    picture of 1920 × 1080, and 50 · width / 1920 takes in the same part of a smaller one.
    crop: x, y, width, height in pixels from the top left, of the part of the frame to render.
    target_noise: estimated relative error at which a block of pixels is done; None: all get spp samples.
    compile: whether kernels are compiled (see `render/kernels.py`), which takes minutes once on a machine and renders
    faster from then on; the picture is the same but for rounding.
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
    compile: bool = False

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise BokehguideError(f"mode: {self.mode!r} is unknown; choose one of {', '.join(MODES)}")
        if self.device not in DEVICES:
            raise BokehguideError(f"device: {self.device!r} is unknown; choose {' or '.join(DEVICES)}")
        if self.spp < 1:
            raise BokehguideError(f"spp: {self.spp} is not positive; give at least 1 sample per pixel")
        if self.threads is not None and self.threads < 1:
            raise BokehguideError(f"threads: {self.threads} is not positive; give at least 1 thread")
        if not 1.0 <= self.reuse_radius <= MAX_SIDE:
            raise BokehguideError(f"reuse_radius: {self.reuse_radius:g} is out of range; give pixels from 1 to {MAX_SIDE}")

        if self.crop is not None and self.reuses:
            raise BokehguideError(f"crop: {self.mode} reuses samples of the whole frame; render it whole, or choose another mode")

        if self.target_noise is not None and not 1e-6 <= self.target_noise <= 1.0:
            raise BokehguideError(f"target_noise: {self.target_noise:g} is out of range; give a relative error from 1e-06 to 1")
        if self.target_noise is not None and self.reuses:
            raise BokehguideError(f"target_noise: {self.mode} reuses samples of the whole frame; choose another mode")

    def window(self, width: int, height: int) -> tuple[int, int, int, int]:
        """The crop, or all, of a frame of this size. Raises BokehguideError where the crop leaves it."""
        x, y, across, down = self.crop or (0, 0, width, height)
        if not (0 <= x and 0 <= y and 0 < across <= width - x and 0 < down <= height - y):
            box = ",".join(map(str, self.crop))
            raise BokehguideError(f"crop: {box} leaves the frame; give X,Y,W,H within its {width} x {height} pixels")
        return x, y, across, down

    @property
    def lens_mode(self) -> str:
        """Which of LENS_MODES draws the lens points."""
        return REUSE_MODES.get(self.mode, self.mode)

    @property
    def reuses(self) -> bool:
        """Whether pixels reuse each other's samples."""
        return self.mode in REUSE_MODES
