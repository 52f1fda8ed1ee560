"""The denoised picture of a render."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.image.denoise import denoise_halves
from bokehguide.render.film import Film
from bokehguide.render.halves_film import HalfFilm, HalvesFilm
from bokehguide.render.split_film import SplitFilm, relative_error


class DenoisedPicture(NamedTuple):
    """radiance: float32 `[H, W, 3]`; estimated_mape: None after a single step."""

    radiance: np.ndarray
    estimated_mape: float | None


def denoise_picture(picture: Film | HalvesFilm, layers: Mapping[str, np.ndarray] | None = None) -> DenoisedPicture:
    """The denoised radiance of a film, and its estimated MAPE.

    picture: of a loop whose settings have `denoise` or `target_noise`; layers: `picture.layers()`, if they are at hand.
    Raises BokehguideError for a film without halves, and where Open Image Denoise is not installed.
    """
    if not isinstance(picture, SplitFilm | HalfFilm | HalvesFilm):
        raise BokehguideError("denoise: the film has no halves; render with RenderSettings(denoise=True)")
    layers = picture.layers() if layers is None else layers
    first, second, share, *emission = (values.cpu() for values in picture.halves())
    seen = [half.numpy() for half in emission]
    features = layers["albedo"], layers["normal"]
    denoised = denoise_halves(first.numpy(), second.numpy(), share.numpy(), *features, seen, layers["variance"])
    if denoised.error_ratio is None:
        return DenoisedPicture(denoised.radiance, None)
    noise = relative_error(first.permute(2, 0, 1), second.permute(2, 0, 1), share).permute(1, 2, 0).numpy()
    return DenoisedPicture(denoised.radiance, float((noise * denoised.error_ratio[..., None]).mean()))
