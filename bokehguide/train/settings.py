"""What a render may be told."""

from __future__ import annotations

from dataclasses import dataclass

from bokehguide.errors import BokehguideError

MODES = ("uniform", "lis", "lis-b", "lis-o")
"""Uniform lens sampling; guided with β = 0.8; with learnt β; with learnt β and polynomial offsets."""


@dataclass(frozen=True)
class RenderSettings:
    """Settings of one render.

    mode: one of MODES. spp: samples per pixel, one a step. seed: of all random numbers.
    device: "cpu" or "cuda" (shading, guiding and learning; Embree runs on the CPU).
    threads: worker threads, None for as many as there are processors.
    Raises BokehguideError for a value out of range.
    """

    mode: str = "lis-o"
    spp: int = 256
    seed: int = 0
    device: str = "cpu"
    threads: int | None = None

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise BokehguideError(f"mode: {self.mode!r} is unknown; choose one of {', '.join(MODES)}")
        if self.device not in ("cpu", "cuda"):
            raise BokehguideError(f"device: {self.device!r} is unknown; choose cpu or cuda")
        if self.spp < 1:
            raise BokehguideError(f"spp: {self.spp} is not positive; give at least 1 sample per pixel")
        if self.threads is not None and self.threads < 1:
            raise BokehguideError(f"threads: {self.threads} is not positive; give at least 1 thread")
