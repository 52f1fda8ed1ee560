"""The images of `bokehguide render`: PATH.exr and PATH.png, during the render and at its end."""

from __future__ import annotations

import argparse
import shlex
import time
from pathlib import Path

import numpy as np
from torch import Tensor

from bokehguide.cli.terminal import say
from bokehguide.cli.tev import TevViewer
from bokehguide.errors import BokehguideError
from bokehguide.image import Display, drained, group_layers, write_exr, write_png
from bokehguide.render import Film
from bokehguide.render.halves_film import HalvesFilm
from bokehguide.runtime.process import return_freed_memory
from bokehguide.scene.overrides import OVERRIDES, option_word
from bokehguide.train import AdaptiveLoop, RenderLoop, denoise_picture, describe_render, matte_attributes, matte_layers


class Pictures:
    """Writes the images of one render. path: the EXR; the PNG goes beside it.

    display: of the PNG. viewer: also shows the radiance, None for no viewer. Of the last images: `delivered`, the radiance
    `[H, W, 3]` of the PNG, denoised or not; its `estimated_mape`, None where unknown; `exposure` in EV; the `alpha` of the PNG
    `[H, W]`, None without one.
    """

    def __init__(self, path: Path, options: argparse.Namespace, display: Display, viewer: TevViewer | None = None):
        self.path, self.png, self.display, self._options = path, path.with_suffix(".png"), display, options
        self._viewer = viewer
        self.delivered: np.ndarray | None = None
        self.estimated_mape: float | None = None
        self.exposure = 0.0
        self.alpha: np.ndarray | None = None

    def write(self, loop: RenderLoop | AdaptiveLoop, picture: Film | HalvesFilm) -> None:
        """Write the EXR with its metadata, and the PNG. Raises BokehguideError if they cannot be written."""
        return_freed_memory()  # the layers are large, and freed memory of batches is in small pieces
        layers = picture.layers()
        if self._options.denoise:
            layers["denoised"], self.estimated_mape = denoise_picture(picture, layers)
        else:
            self.estimated_mape = picture.relative_noise() if loop.step_number > 1 else None
        self.delivered = layers.get("denoised", layers["beauty"])
        if self._viewer:
            self._viewer.show(layers)
        display = self.display.metered(self.delivered, layers["alpha"])
        self.exposure = display.exposure or 0.0
        facts = describe_render(loop.scene, loop.settings, loop.step_number)
        facts |= {"command": command_line(self._options, loop.step_number), **display.attributes}
        if self._options.cryptomatte:
            layers |= matte_layers(loop.scene, picture)
            facts |= matte_attributes(loop.scene)
        layers |= group_layers(picture.light_groups())
        self.alpha = layers["alpha"] if self._options.alpha else None
        frame = (loop.camera.width, loop.camera.height)
        write_exr(self.path, drained(layers), facts, corner=picture.corner, frame=frame)
        write_png(self.png, png_values(display, self.delivered, self.alpha), self._options.bits)
        return_freed_memory()

    @property
    def facts(self) -> dict[str, object]:
        """The exposure and the paths of the last images, ready for JSON."""
        return {"exposure": self.exposure, "exr": str(self.path), "png": str(self.png)}

    def due(self) -> bool:
        """Whether the viewer should get a new picture now."""
        return self._viewer is not None and self._viewer.due()

    def show(self, loop: RenderLoop | AdaptiveLoop) -> None:
        """Show the radiance so far in the viewer; collective."""
        start = time.monotonic()
        radiance = loop.picture().radiance().cpu().numpy()
        if self._viewer:
            self._viewer.show({"beauty": radiance}, time.monotonic() - start)

    def refresh(self, loop: RenderLoop | AdaptiveLoop) -> None:
        """Write the images so far; collective. Warns if they cannot be written, as the render can still succeed."""
        picture = loop.picture()
        if loop.ranks.first:
            try:
                self.write(loop, picture)
            except BokehguideError as error:
                say(f"warning: {error}")


def png_values(display: Display, radiance: np.ndarray, alpha: np.ndarray | None) -> Tensor:
    """Display values of a PNG, with alpha if it is given. display: metered."""
    return display.show(radiance) if alpha is None else display.show_straight(radiance, alpha)


def warn_if_opaque(alpha: np.ndarray | None) -> None:
    """Warn on stderr where the alpha of a PNG has no effect. alpha: None without one."""
    if alpha is not None and (alpha >= 1.0).all():
        hint = "`bokehguide render` with --hide-environment hides the environment from the camera"
        say(f"warning: --alpha: the picture is opaque everywhere; {hint}")


def chosen_exposure(given: float | str | None, stored: float | None) -> float | None:
    """Exposure in EV: the option's, or where it is absent the stored one; None to meter."""
    return stored if given is None else None if given == "auto" else float(given)


def command_line(options: argparse.Namespace, spp: int) -> str:
    """The command that renders this image again."""
    given = {"size": "x".join(map(str, options.size))} if options.size else {}
    given |= {"bits": options.bits} if options.bits != 8 else {}
    names = ("mode", "reuse_radius", "seed", "device", "exposure", "view", "crop", "target_noise", *OVERRIDES)
    kept = {name: getattr(options, name) for name in names}
    flags = ("alpha", "denoise", "cryptomatte", "light_groups", "allow_outside")
    given |= {"spp": spp} | {name: True for name in flags if getattr(options, name)}
    words = [option_word(name, value) for name, value in (kept | given).items() if value is not None]
    return shlex.join(["bokehguide", "render", options.scene, *words])
