"""Error measures of an image against a reference."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bokehguide.errors import BokehguideError
from bokehguide.image import read_rgb, tone_map

log = logging.getLogger(__name__)

EPSILON = 0.01
"""Added to the reference in denominators, so that the errors of black pixels count and stay finite."""

SSIM_WINDOW = 11
SSIM_PIXELS = 2**20
"""Pixels of a band in which SSIM is computed."""


@dataclass(frozen=True)
class Metrics:
    """MAPE and relMSE of the radiance; SSIM and PSNR (dB) of the tone-mapped values.

    ssim: None for an image smaller than its window of 11 × 11 pixels.
    """

    mape: float
    relmse: float
    ssim: float | None
    psnr: float


def mape(image: Tensor | np.ndarray, reference: Tensor | np.ndarray) -> float:
    """Mean over pixels and channels of |I - R| / (R + 0.01); radiance `[H, W, 3]`.

    Raises BokehguideError as `checked` does.
    """
    image, reference = checked(image, reference)
    return ((image - reference).abs() / (reference + EPSILON)).mean().item()


def relmse(image: Tensor | np.ndarray, reference: Tensor | np.ndarray) -> float:
    """Mean over pixels and channels of ((I - R) / (R + 0.01))²; radiance `[H, W, 3]`.

    Raises BokehguideError as `checked` does.
    """
    image, reference = checked(image, reference)
    return ((image - reference) / (reference + EPSILON)).square().mean().item()


def compare(image: Tensor | np.ndarray, reference: Tensor | np.ndarray, exposure: float = 0.0) -> Metrics:
    """All four measures of radiance `[H, W, 3]`; SSIM and PSNR tone-map it at `exposure` EV.

    Raises BokehguideError as `checked` does.
    """
    from kornia.metrics import psnr  # the import takes over a second, and renders do not need it

    image, reference = checked(image, reference)
    shown, expected = (tone_map(x, exposure).movedim(-1, 0)[None] for x in (image, reference))
    return Metrics(
        mape=mape(image, reference),
        relmse=relmse(image, reference),
        ssim=_mean_ssim(shown, expected) if min(image.shape[:2]) >= SSIM_WINDOW else None,
        psnr=psnr(shown, expected, 1.0).item(),
    )


def _mean_ssim(shown: Tensor, expected: Tensor) -> float:
    """Mean SSIM of display values `[1, 3, H, W]`. Large images are compared in bands of rows, as SSIM takes much memory."""
    from kornia.metrics import ssim

    height, width = shown.shape[2:]
    rows = max(SSIM_PIXELS // width, SSIM_WINDOW)
    if height <= rows + SSIM_WINDOW:
        return ssim(shown, expected, SSIM_WINDOW).mean().item()
    total = 0.0
    for top in range(0, height, rows):
        first, last = max(top - SSIM_WINDOW, 0), min(top + rows + SSIM_WINDOW, height)
        band = ssim(shown[:, :, first:last], expected[:, :, first:last], SSIM_WINDOW)
        total += band[:, :, top - first : top - first + rows].double().sum().item()
    return total / shown.numel()


def checked(image: Tensor | np.ndarray, reference: Tensor | np.ndarray) -> tuple[Tensor, Tensor]:
    """The images as tensors. Raises BokehguideError for other shapes, unequal ones, NaN or infinity, or a negative reference."""
    image, reference = _tensor("image", image), _tensor("reference", reference)
    if image.shape != reference.shape:
        raise BokehguideError(
            f"the image is {_size(image)} and the reference {_size(reference)} pixels; give two images of one size"
        )
    for name, pixels in (("image", image), ("reference", reference)):
        bad = int((~torch.isfinite(pixels)).sum())
        if bad:
            raise BokehguideError(f"the {name} has {bad} NaN or infinite values; their mean is undefined; render it again")
    if reference.min() < 0.0:
        least = f"{reference.min():g}"
        raise BokehguideError(f"the reference has a negative value, {least}; clamp it, or render it with more SPP")
    return image, reference


def _tensor(name: str, pixels: Tensor | np.ndarray) -> Tensor:
    """The pixels of an image `[H, W, 3]`; whole numbers and those of an array in single precision."""
    if isinstance(pixels, np.ndarray) and pixels.dtype.kind in "iuf":
        pixels = torch.from_numpy(np.require(pixels, np.float32, ("C", "W")))
    shape = tuple(pixels.shape) if hasattr(pixels, "shape") else None
    fits = shape is None or (len(shape) == 3 and shape[2] == 3 and 0 not in shape)
    if fits and isinstance(pixels, Tensor) and pixels.dtype != torch.bool and not pixels.is_complex():
        return pixels if pixels.is_floating_point() else pixels.float()
    found = f"type {getattr(pixels, 'dtype', type(pixels).__name__)}" if fits else f"shape {shape}"
    raise BokehguideError(f"the {name} has {found}; give an array or a tensor of numbers, height × width × 3")


def read_reference(path: str | Path, width: int | None = None, height: int | None = None) -> Tensor:
    """Radiance `[H, W, 3]` of a reference EXR for renders of this size, None for any. Negative values become 0, with a warning.

    Raises BokehguideError with the name of the file if it cannot be read, has another size, or fails `checked`.
    """
    reference = torch.from_numpy(read_rgb(path))
    negative = (reference < 0.0) & reference.isfinite()  # the control variate leaves some at few SPP
    reference = reference.masked_fill(negative, 0.0)
    try:
        checked(torch.zeros(height or len(reference), width or reference.shape[1], 3), reference)
    except BokehguideError as error:
        raise BokehguideError(f"{path}: {error}") from error
    if count := int(negative.sum()):
        log.warning("%s: the reference has %d negative values, 0 in their place; more SPP avoid such values", path, count)
    return reference


def _size(image: Tensor) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"
