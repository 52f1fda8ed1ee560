"""What a render may be told."""

from __future__ import annotations

from dataclasses import dataclass

from bokehguide.errors import BokehguideError
from bokehguide.limits import MAX_SIDE

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
    Raises BokehguideError for a value out of range.
    """

    mode: str = "guided"
    spp: int = 256
    seed: int = 0
    device: str = "cpu"
    threads: int | None = None
    reuse_radius: float = 50.0

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise BokehguideError(f"mode: {self.mode!r} is unknown; choose one of {', '.join(MODES)}")
        if self.device not in ("cpu", "cuda"):
            raise BokehguideError(f"device: {self.device!r} is unknown; choose cpu or cuda")
        if self.spp < 1:
            raise BokehguideError(f"spp: {self.spp} is not positive; give at least 1 sample per pixel")
        if self.threads is not None and self.threads < 1:
            raise BokehguideError(f"threads: {self.threads} is not positive; give at least 1 thread")
        if not 1.0 <= self.reuse_radius <= MAX_SIDE:
            raise BokehguideError(f"reuse_radius: {self.reuse_radius:g} is out of range; give pixels from 1 to {MAX_SIDE}")

    @property
    def lens_mode(self) -> str:
        """Which of LENS_MODES draws the lens points."""
        return REUSE_MODES.get(self.mode, self.mode)

    @property
    def reuses(self) -> bool:
        """Whether pixels reuse each other's samples."""
        return self.mode in REUSE_MODES
