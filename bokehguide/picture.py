"""A whole render in one call: `bokehguide.render(scene)` returns a `Picture`."""

from __future__ import annotations

import os
import signal
import sys
import threading
import warnings
from contextlib import nullcontext
from dataclasses import dataclass, field, fields
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from bokehguide.errors import BokehguideError
from bokehguide.image import to_8_bit, tone_map, write_exr, write_png
from bokehguide.runtime.device import check_device
from bokehguide.runtime.interrupt import Interrupt
from bokehguide.scene import Overrides, Scene, load_scene
from bokehguide.scene.tables import did_you_mean, shown
from bokehguide.train import AdaptiveLoop, RenderLoop, RenderSettings, describe_render, make_loop

OVERRIDES = tuple(field.name for field in fields(Overrides) if field.name not in ("width", "height"))
SETTINGS = tuple(field.name for field in fields(RenderSettings) if field.name not in ("mode", "spp"))


@dataclass(frozen=True, repr=False)
class Picture:
    """A rendered picture. The arrays are the layers of the EXR file: float32, top row first, colours in linear Rec.709.

    beauty, normal, albedo, emission: `[H, W, 3]`; beauty is the radiance. alpha, depth (metres along the axis), variance
    (estimated, of the luminance) and sample_count: `[H, W]`. denoised: `[H, W, 3]`, None where it was not asked for.
    metadata: scene, mode, samples per pixel, seed, size, software and settings, as in the EXR's header.
    corner: column and row of the first pixel in the frame. frame: width and height of the frame, which a crop is a part of.
    """

    beauty: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    normal: np.ndarray
    albedo: np.ndarray
    emission: np.ndarray
    variance: np.ndarray
    sample_count: np.ndarray
    metadata: dict[str, str | int]
    corner: tuple[int, int] = (0, 0)
    frame: tuple[int, int] | None = None
    denoised: np.ndarray | None = field(default=None, kw_only=True)

    @property
    def layers(self) -> dict[str, np.ndarray]:
        """The layers by the names that `bokehguide.image.write_exr` takes."""
        arrays = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: array for name, array in arrays.items() if isinstance(array, np.ndarray)}

    def image(self, exposure: float = 0.0) -> np.ndarray:
        """The picture for a display, uint8 `[H, W, 3]` in sRGB; the denoised one where there is one. exposure: in EV."""
        return to_8_bit(self._display(exposure))

    def save(self, path: str | os.PathLike[str], exposure: float = 0.0) -> Path:
        """Write an EXR with all layers, or a PNG, by the suffix of the path, as the command line does; returns the path.

        exposure: of the PNG, in EV. Raises BokehguideError for another suffix and for a path that cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() == ".exr":
            write_exr(path, self.layers, self.metadata, corner=self.corner, frame=self.frame)
        elif path.suffix.lower() == ".png":
            write_png(path, self._display(exposure))
        else:
            raise BokehguideError(f"Picture.save: {shown(str(path))} has another suffix; give .exr or .png")
        return path

    def show(self, exposure: float = 0.0) -> None:
        """Show the picture in the notebook, else in the desktop's image viewer. exposure: in EV."""
        image = Image.fromarray(self.image(exposure))
        if _in_notebook():
            from IPython.display import display  # type: ignore[import-not-found] - notebooks have it

            display(image)
        else:
            image.show()

    def _display(self, exposure: float) -> torch.Tensor:
        radiance = self.beauty if self.denoised is None else self.denoised
        return tone_map(torch.from_numpy(radiance), exposure)

    def _repr_png_(self) -> bytes:
        """The picture as notebooks show it."""
        file = BytesIO()
        Image.fromarray(self.image()).save(file, format="PNG")
        return file.getvalue()

    def __repr__(self) -> str:
        height, width = self.alpha.shape
        facts = self.metadata
        return f"Picture({facts['scene']!r}, {width} × {height}, mode {facts['mode']!r}, {facts['spp']} SPP)"


def render(
    scene: Scene | str | os.PathLike[str],
    mode: str = "guided",
    spp: int = RenderSettings.spp,
    *,
    size: tuple[int, int] | None = None,
    denoise: bool = False,
    quiet: bool = False,
    allow_outside: bool = False,
    **options: Any,
) -> Picture:
    """Render a scene and return the picture.

    scene: a `Scene`, the name of a built-in scene, or the path of a scene file or of a model. mode: how the lens is sampled.
    spp: samples per pixel. size: width and height in pixels, by default the scene's. denoise: also give the denoised picture.
    quiet: show neither a progress bar nor warnings of the scene. allow_outside: let a scene file name files outside its folder.
    options: fields of `Overrides`, such as `environment` and `focus_distance`, and of `RenderSettings`, such as `seed`,
    `target_noise` and `crop`.

    Ctrl-C, or the stop button of a notebook, ends the render after the current step. The picture so far is returned; its
    metadata say how many samples it has. Raises BokehguideError for input that is missing, malformed or out of range.
    """
    width, height = _pair(size)
    overrides = Overrides(width=width, height=height, **_of(options, OVERRIDES))
    settings = RenderSettings(mode=mode, spp=spp, **_of(options, SETTINGS))
    for name in options:
        if name not in OVERRIDES + SETTINGS:
            raise BokehguideError(f"render: {name}: no such option; {did_you_mean(name, OVERRIDES + SETTINGS)}")
    check_device(settings.device)
    loaded = load_scene(scene, overrides, allow_outside)
    if denoise:
        raise BokehguideError("render: denoise: True needs a denoiser, which this version does not have; give False")
    for warning in () if quiet else loaded.warnings:
        warnings.warn(warning, stacklevel=2)
    with make_loop(loaded, settings) as loop:
        _take_steps(loop, quiet)
        film = loop.picture()
        facts = describe_render(loaded, settings, loop.step_number)
        frame = (loop.camera.width, loop.camera.height)
        return Picture(**film.layers(), metadata=facts, corner=film.corner, frame=frame)


def _of(options: dict[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    """The options with some names."""
    return {name: value for name, value in options.items() if name in names}


def _pair(size: tuple[int, int] | None) -> tuple[int | None, int | None]:
    """Width and height, None for those of the scene."""
    if size is None:
        return None, None
    if not (isinstance(size, (tuple, list)) and len(size) == 2):
        raise BokehguideError(
            f"render: size: {shown(size)} is no pair of whole numbers; give a width and a height, as in (640, 360)"
        )
    width, height = size
    return width, height


def _take_steps(loop: RenderLoop | AdaptiveLoop, quiet: bool) -> None:
    """Take all steps, or those until an interruption. A SIGTERM takes effect after the step."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # tqdm warns in notebooks without ipywidgets, and shows a bar of text
        from tqdm.auto import tqdm

    spp, title = loop.settings.spp, f"{loop.scene.name} {loop.settings.mode}"
    main = threading.current_thread() is threading.main_thread()
    # Python lets only the main thread handle signals.
    with Interrupt() if main else nullcontext() as interrupt, tqdm(total=spp, desc=title, unit="SPP", disable=quiet) as bar:
        while loop.step_number < spp and not (isinstance(loop, AdaptiveLoop) and loop.finished):
            loop.step()
            bar.update()
            if interrupt is not None and interrupt.requested:
                break
    if interrupt is not None and interrupt.signal == signal.SIGTERM:
        signal.raise_signal(signal.SIGTERM)


def _in_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return shell is not None and "IPKernelApp" in shell.config
