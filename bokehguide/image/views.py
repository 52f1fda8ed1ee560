"""Views: transforms of radiance to display values.

`photo` compresses radiance above ROLL_OFF by a logarithm of the largest channel, with the ratio of the channels unchanged, and
shows the result by the output transform of ACES 2.0 for standard displays. Emitters are a thousand times brighter than a lit wall
even out of focus. ACES 2.0 alone shows an emitter of any hue white from about 30 times diffuse white on. With the compression, an
emitter becomes white beyond 10,000 times diffuse white. Radiance below ROLL_OFF is shown as by `aces`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bokehguide.errors import BokehguideError
from bokehguide.image.exposure import metered_exposure
from bokehguide.image.tonemap import tone_map
from bokehguide.limits import VIEWS

CONFIG = "ocio://cg-config-v4.0.0_aces-v2.0_ocio-v2.5"
"""A configuration within OpenColorIO, which OpenImageIO contains; its name fixes the colours whatever the release."""
SOURCE, DISPLAY, OUTPUT = "Linear Rec.709 (sRGB)", "sRGB - Display", "ACES 2.0 - SDR 100 nits (Rec.709)"
BRIGHTEST = 1e6
"""Radiance that ACES shows as the brightest white; infinities would become black."""
ROLL_OFF = 1.5
"""Radiance above which `photo` compresses; diffuse white has 1."""
BAND, ROWS = 1 << 20, 32
"""Pixels that are shown at once, in a multiple of so many rows.

Fewer pixels need less memory, but each call of OpenColorIO takes time of its own. PyTorch rounds powers and logarithms otherwise
in the last values of an array, which do not fill its vectors."""

LEAST_ALPHA = 1e-6
"""Alpha that divides radiance at least, so that quotients stay finite; a PNG of 16 bits has 0 below 7.6e-6."""

VIEW_ATTRIBUTE = "display_view"
"""Header attribute of an EXR that holds the view: `view` is the standard attribute for the eye of a stereo picture."""


@dataclass(frozen=True)
class Display:
    """The way radiance is shown. exposure: EV, None to meter each picture; view: a name in VIEWS."""

    exposure: float | None = None
    view: str = VIEWS[0]

    def metered(self, radiance: Tensor | np.ndarray, alpha: np.ndarray | None = None) -> Display:
        """The same with an exposure: its own, or the metered one of radiance `[H, W, 3]`, premultiplied by `alpha` `[H, W]`."""
        if self.exposure is not None:
            return self
        return replace(self, exposure=metered_exposure(torch.as_tensor(radiance).cpu().numpy(), alpha))

    @property
    def attributes(self) -> dict[str, str | float]:
        """Header attributes of an EXR."""
        return {"exposure": self.exposure or 0.0, VIEW_ATTRIBUTE: self.view}

    def show(self, radiance: Tensor | np.ndarray, alpha: np.ndarray | None = None) -> Tensor:
        """Display values `[H, W, 3]` of radiance `[H, W, 3]`, as of `to_display`. alpha: `[H, W]`, for the meter."""
        return to_display(radiance, self.metered(radiance, alpha).exposure or 0.0, self.view)

    def show_straight(self, radiance: Tensor | np.ndarray, alpha: Tensor | np.ndarray) -> Tensor:
        """Display values `[H, W, 4]` with straight alpha, of radiance premultiplied by `alpha` `[H, W]`.

        The colour of a pixel is that of its covered part, black where alpha is 0. Noisy alpha is clipped to 0 … 1.
        """
        linear = torch.as_tensor(radiance).detach().cpu().float()
        cover = torch.as_tensor(alpha).detach().cpu().float().nan_to_num(0.0).clamp(0.0, 1.0)[..., None]
        straight = torch.where(cover > 0.0, linear / cover.clamp(min=LEAST_ALPHA), 0.0)
        exposure = self.metered(linear, cover[..., 0].numpy()).exposure or 0.0
        return torch.cat((to_display(straight, exposure, self.view), cover), dim=-1)


def to_display(radiance: Tensor | np.ndarray, exposure: float = 0.0, view: str = VIEWS[0]) -> Tensor:
    """Linear Rec.709 radiance `[H, W, 3]` as sRGB display values in 0..1, float32 on the CPU.

    exposure: EV, a factor 2^exposure, rounded to single precision, in which files store exposures; view: "photo", "aces" or
    "srgb", a clip of each channel. NaN becomes black. Raises BokehguideError for an unknown view.
    """
    if view not in VIEWS:
        raise BokehguideError(f"view: {view!r} is unknown; choose one of {', '.join(VIEWS)}")
    linear, exposure = torch.as_tensor(radiance).detach().cpu().float(), float(np.float32(exposure))
    shown = torch.empty(linear.shape)
    rows = max(1, BAND // (ROWS * max(1, linear.shape[1]))) * ROWS
    for part, of_radiance in zip(shown.split(rows), linear.split(rows)):
        part.copy_(_displayed(of_radiance, exposure, view))
    return shown


def _displayed(linear: Tensor, exposure: float, view: str) -> Tensor:
    """`to_display` of some rows."""
    linear = linear.nan_to_num(0.0, posinf=torch.finfo(torch.float32).max, neginf=0.0)
    if view == "srgb":
        return tone_map(linear, exposure)
    linear = (linear.double() * 2.0**exposure).clamp(0.0, 1e300)
    if view == "photo":
        linear = rolled_off(linear)
    return aces(linear.clamp(max=BRIGHTEST).float())


def rolled_off(linear: Tensor) -> Tensor:
    """Linear radiance `[..., 3]` with highlights rolled off.

    A largest channel m above s = ROLL_OFF becomes s (1 + ln(m / s)), which continues the slope 1 at s.
    """
    peak = linear.amax(-1, keepdim=True).clamp(min=ROLL_OFF)
    return linear * (ROLL_OFF * (1.0 + (peak / ROLL_OFF).log()) / peak)


def aces(linear: Tensor) -> Tensor:
    """The output transform of ACES 2.0 for a standard sRGB display, of float32 `[H, W, 3]`."""
    from OpenImageIO import FLOAT, ImageBuf, ImageBufAlgo  # not needed for files of radiance alone

    image = ImageBuf(np.ascontiguousarray(linear.numpy()))
    shown = ImageBufAlgo.ociodisplay(image, DISPLAY, OUTPUT, fromspace=SOURCE, colorconfig=CONFIG)
    if shown.has_error:
        raise RuntimeError(f"OpenColorIO: {shown.geterror()}")
    return torch.from_numpy(shown.get_pixels(FLOAT)).clamp(0.0, 1.0)
