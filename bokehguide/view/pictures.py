"""Pictures of a job, for the page and for files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from io import BytesIO

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from bokehguide.color import LUMINANCE
from bokehguide.image import Display, to_8_bit
from bokehguide.models.candidates import MAX_CANDIDATES
from bokehguide.picture import Picture, picture_of
from bokehguide.render.film import NO_DEPTH
from bokehguide.train import RenderLoop, denoise_picture
from bokehguide.view.job import Job
from bokehguide.view.preview import QuickDenoiser, quick_display
from bokehguide.view.state import Source, ViewState, command_line

FARTHEST = 0.1
"""Brightness of the farthest surface in the picture of the depth."""


@dataclass(frozen=True)
class Shown:
    """A picture of the page. image: uint8 `[H, W, 3]`. exposure: EV, metered or not."""

    image: np.ndarray
    exposure: float


def preview(loop: RenderLoop, state: ViewState, denoiser: QuickDenoiser | None) -> Shown:
    """The picture so far, quickly, or the layer that the state chooses. denoiser: None shows the samples as they are."""
    radiance = loop.film.radiance().numpy()
    if denoiser is not None and state.denoise:
        radiance = denoiser(radiance)
    exposure = Display(state.exposure, state.view).metered(radiance, _alpha(loop)).exposure or 0.0
    image = quick_display(radiance, exposure, state.view) if state.layer == "picture" else layer_image(loop, state.layer)
    return Shown(image, exposure)


def exact(loop: RenderLoop, state: ViewState) -> Shown:
    """The picture as `bokehguide render` shows it."""
    layers = loop.film.layers()
    radiance = denoise_picture(loop.film, layers).radiance if state.denoise else layers["beauty"]
    display = Display(state.exposure, state.view).metered(radiance, layers["alpha"])
    return Shown(to_8_bit(display.show(radiance)), display.exposure or 0.0)


def _alpha(loop: RenderLoop) -> np.ndarray | None:
    """The alpha `[H, W]` of a picture, None where a visible environment makes it 1 everywhere."""
    environment = loop.scene.environment
    return None if environment is not None and environment.visible else loop.film.layers()["alpha"]


def finished(job: Job, state: ViewState, source: Source) -> Picture:
    """The picture as `bokehguide render` writes it with the options of `command_line`."""
    loop = job.loop
    settings = replace(loop.settings, spp=loop.step_number, threads=None)
    picture = picture_of(loop, settings, Display(state.exposure, state.view), state.denoise)
    command = {"command": command_line(state, source, loop.step_number)}
    return replace(picture, metadata=picture.metadata | command)


def layer_image(loop: RenderLoop, name: str) -> np.ndarray:
    """A layer as uint8 `[H, W, 3]`; a layer that the mode does not learn is black."""
    if name == "emitters":
        return to_8_bit(emitters_image(loop))
    if name == "beta":
        black = torch.zeros(loop.film.height, loop.film.width, 3)
        return to_8_bit(loop.guide_images().get("beta", black))
    return data_image(name, loop.film.layers())


def emitters_image(loop: RenderLoop) -> Tensor:
    """How many emitters and highlights each pixel may see through the lens, `[H, W, 3]` in 0 … 1, white for MAX_CANDIDATES.

    The places of highlights that the mode has found during the render are red.
    """
    height, width = loop.film.height, loop.film.width
    image, candidates = torch.zeros(height, width, 3), getattr(loop.mode.lens, "candidates", None)
    if candidates is not None:
        image += (candidates.counts().reshape(height, width, 1) / MAX_CANDIDATES).sqrt()
    found = loop.guide_images().get("highlights")
    if found is not None:  # with a margin around the frame
        top, left = (found.shape[0] - height) // 2, (found.shape[1] - width) // 2
        places = found[top : top + height, left : left + width, 0] > 0.0
        image[places] = torch.tensor([1.0, 0.2, 0.1])
    return image


def data_image(name: str, layers: dict[str, np.ndarray]) -> np.ndarray:
    """The layer `name` of a file's or a film's layers as uint8 `[H, W, 3]`.

    Near is bright in the depth. A variance shows as the relative standard error.
    """
    if name == "depth":
        image = depth_image(layers["depth"])
    elif name == "normal":
        image = 0.5 * layers["normal"] + 0.5
    elif name == "variance":
        brightness = (layers["beauty"] @ LUMINANCE).clip(min=0.0) + 0.01
        image = 1.0 - 1.0 / (1.0 + np.sqrt(layers["variance"].clip(min=0.0)) / brightness)
    else:
        image = layers[name].clip(0.0, 1.0) ** (1.0 / 2.2)
    image = np.broadcast_to(image if image.ndim == 3 else image[..., None], (*image.shape[:2], 3))
    return (np.nan_to_num(image).clip(0.0, 1.0) * 255.0).round().astype(np.uint8)


def depth_image(depth: np.ndarray) -> np.ndarray:
    """Depth `[H, W]` as brightness, even in the reciprocal: 1 is the nearest surface, FARTHEST the farthest, 0 no surface."""
    met = depth < 0.5 * NO_DEPTH
    near = np.where(met, 1.0 / depth.clip(min=1e-9), 0.0)
    low, high = (float(bound) for bound in (near.min(where=met, initial=np.inf), near.max()))
    if not high > low:  # one depth, or none
        return met.astype(near.dtype)
    return np.where(met, FARTHEST + (1.0 - FARTHEST) * (near - low) / (high - low), 0.0)


def png(image: np.ndarray) -> bytes:
    """An image uint8 `[H, W]` or `[H, W, C]` as PNG, written fast."""
    file = BytesIO()
    Image.fromarray(image).save(file, format="PNG", compress_level=1)
    return file.getvalue()
