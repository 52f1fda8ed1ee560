"""Intel's Open Image Denoise, from the package `mitsuba-oidn`."""

from __future__ import annotations

from types import ModuleType

import numpy as np

from bokehguide.errors import BokehguideError


def require_denoiser() -> ModuleType:
    """The module `mitsuba_oidn`. Raises BokehguideError where it is not installed."""
    try:
        import mitsuba_oidn  # pyright: ignore[reportMissingImports]  # an extra
    except ImportError as error:
        raise BokehguideError(f"denoising: needs Open Image Denoise ({error}); pip install 'bokehguide[denoise]'") from None
    return mitsuba_oidn


def has_denoiser() -> bool:
    """Whether the module `mitsuba_oidn` is installed."""
    try:
        require_denoiser()
    except BokehguideError:
        return False
    return True


class Denoiser:
    """Denoises pictures of one view with the same auxiliary layers, which are denoised first (prefiltered).

    albedo, normal: as `Film.layers` has them, seen through the lens and premultiplied, float32 `[H, W, 3]`; None for no layers.
    Layers as noisy as these of a defocused picture harm when they are used as they come.
    """

    def __init__(self, albedo: np.ndarray | None = None, normal: np.ndarray | None = None):
        self._oidn = require_denoiser()
        self._device = self._oidn.Device(self._oidn.DeviceType.CPU)
        given = {"albedo": (albedo, 0.0), "normal": (normal, -1.0)}
        self._layers = {
            name: self._filtered({name: finite(layer, low, 1.0)}) for name, (layer, low) in given.items() if layer is not None
        }

    def __call__(self, radiance: np.ndarray) -> np.ndarray:
        """Radiance `[H, W, 3]` without noise, float32 and not negative. NaN and infinities count as black."""
        color = finite(radiance, 0.0, float(np.finfo(np.float32).max))
        return self._filtered({"color": color, **self._layers}, hdr=True, clean_aux=len(self._layers) > 0)

    def _filtered(self, images: dict[str, np.ndarray], **flags: bool) -> np.ndarray:
        output = np.empty_like(next(iter(images.values())))
        denoising = self._device.new_filter("RT")
        for name, image in images.items():
            denoising.set_image(name, image)
        denoising.set_image("output", output)
        for name, value in flags.items():
            setattr(denoising, name, value)
        denoising.execute()
        return output


def finite(image: np.ndarray, low: float, high: float) -> np.ndarray:
    """The image within low and high, contiguous float32 of the same shape; NaN and infinities become 0."""
    return np.ascontiguousarray(np.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0).clip(low, high), np.float32)
