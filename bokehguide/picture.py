"""A whole render in one call: `bokehguide.render(scene)` returns a `Picture`."""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field, fields, replace
from inspect import signature
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from bokehguide.errors import BokehguideError
from bokehguide.guiding.config import GaussianConfig, GuidedConfig
from bokehguide.image import Display, group_layers, to_8_bit, write_exr, write_png
from bokehguide.image.cryptomatte import LAYERS, manifest, mask, require_hash
from bokehguide.image.oidn import require_denoiser
from bokehguide.limits import VIEWS
from bokehguide.runtime.bars import on_terminal, terminal_size
from bokehguide.runtime.device import check_device
from bokehguide.runtime.interrupt import Interrupt
from bokehguide.scene import Overrides, Scene, load_scene
from bokehguide.scene.checks import plain, read_exposure
from bokehguide.scene.overrides import OVERRIDES
from bokehguide.scene.tables import Table, did_you_mean, is_number, shown
from bokehguide.train import (
    AdaptiveLoop,
    RenderLoop,
    RenderSettings,
    denoise_picture,
    describe_render,
    make_loop,
    matte_attributes,
    matte_layers,
)

if TYPE_CHECKING:
    from torch import Tensor

SETTINGS = tuple(field.name for field in fields(RenderSettings) if field.name not in ("mode", "spp", "denoise"))
SYNONYMS = {"height": "size", "resolution": "size", "samples": "spp", "samples_per_pixel": "spp", "width": "size"}
"""Keywords by names that users may give in their place."""
RESULT = {
    **dict.fromkeys(("exposure", "view"), 'give it to the result, as in picture.developed(exposure=1.0, view="srgb")'),
    **dict.fromkeys(("alpha", "bits"), 'give it to the result, as in picture.save("picture.png", alpha=True, bits=16)'),
    **dict.fromkeys(("out", "output"), 'save the result, as in picture.save("picture.exr")'),
}
"""Hints for options of the command line that methods of `Picture` take in Python."""


@dataclass(frozen=True, repr=False)
class Picture:
    """A rendered picture. The arrays are the layers of the EXR file: float32, top row first, colours in linear Rec.709.

    beauty, normal, albedo, emission: `[H, W, 3]`; beauty is the radiance. alpha, depth (metres along the axis), variance
    (estimated, of the luminance) and sample_count: `[H, W]`. denoised: `[H, W, 3]`, None where it was not asked for. mattes:
    Cryptomatte layers `[H, W, 4]` by the keys of `bokehguide.image.cryptomatte.CHANNELS`, empty where they were not asked for.
    light_groups: radiance of each light group by name, `[H, W, 3]`; the sum is beauty; empty where they were not asked for.
    metadata: scene, mode, samples per pixel, seed, size, software, settings, exposure and view, as in the EXR's header.
    estimated_mape: estimated error of the denoised picture, or of beauty without one, relative to the radiance; None after a
    single step. display: how the picture is shown. corner: column and row of the first pixel in the frame. frame: width and
    height of the frame, which a crop is a part of.
    """

    beauty: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    normal: np.ndarray
    albedo: np.ndarray
    emission: np.ndarray
    variance: np.ndarray
    sample_count: np.ndarray
    metadata: dict[str, str | int | float]
    denoised: np.ndarray | None = None
    estimated_mape: float | None = None
    display: Display = Display()
    corner: tuple[int, int] = (0, 0)
    frame: tuple[int, int] | None = None
    mattes: Mapping[str, np.ndarray] = field(default_factory=dict)
    light_groups: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def layers(self) -> dict[str, np.ndarray]:
        """The layers by the names that `bokehguide.image.write_exr` takes."""
        arrays = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: array for name, array in arrays.items() if isinstance(array, np.ndarray)} | {
            **self.mattes,
            **group_layers(self.light_groups),
        }

    def developed(self, exposure: float | str | None = None, view: str | None = None) -> Picture:
        """The same picture, shown with another exposure in EV or another view ("photo", "aces" or "srgb").

        exposure: "auto" meters the picture; None keeps the exposure.

        Raises BokehguideError for an exposure out of range and for an unknown view.
        """
        display = self.display
        if exposure is not None:
            table = Table({"exposure": plain(exposure)}, "Picture.developed", "", ("exposure",))
            display = replace(display, exposure=read_exposure(table)).metered(self._delivered(), self.alpha)
        if view is not None:
            if view not in VIEWS:
                raise BokehguideError(f"Picture.developed: view: {shown(view)} is unknown; choose one of {', '.join(VIEWS)}")
            display = replace(display, view=view)
        return replace(self, display=display, metadata=self.metadata | display.attributes)

    def image(self) -> np.ndarray:
        """The picture for a display, uint8 `[H, W, 3]` in sRGB; the denoised one where there is one."""
        return to_8_bit(self._shown())

    def save(self, path: str | os.PathLike[str], *, alpha: bool = False, bits: int = 8) -> Path:
        """Write an EXR with all layers, or a PNG, by the suffix of the path, as the command line does; returns the path.

        alpha: make the PNG transparent where the picture is, with straight alpha. bits: per channel of the PNG, 8 or 16. An EXR
        always has alpha and 32 bits. Raises BokehguideError for another suffix or number of bits, and for a path that cannot be
        written.
        """
        if not isinstance(path, str | os.PathLike):
            raise BokehguideError(f"Picture.save: path: {shown(path)} is no path; give one that ends in .exr or .png")
        path = Path(path)
        if path.suffix.lower() == ".exr":
            write_exr(path, self.layers, self.metadata, corner=self.corner, frame=self.frame)
        elif path.suffix.lower() == ".png":
            if bits not in (8, 16):
                raise BokehguideError(f"Picture.save: bits: {shown(bits)} is no depth of a PNG; give 8 or 16")
            write_png(path, self.display.show_straight(self._delivered(), self.alpha) if alpha else self._shown(), bits)
        else:
            raise BokehguideError(f"Picture.save: {shown(str(path))} has another suffix; give .exr or .png")
        return path

    def matte(self, name: str, kind: str = "object") -> np.ndarray:
        """The coverage of an object or a material through the lens, float32 `[H, W]` from 0 to 1. kind: "object" or "material".

        Raises BokehguideError for another name or kind, and for a picture without mattes.
        """
        if kind not in LAYERS:
            raise BokehguideError(f'Picture.matte: kind {shown(kind)} is unknown; give "object" or "material"')
        if not self.mattes:
            raise BokehguideError("Picture.matte: the picture has no mattes; render with cryptomatte=True")
        names = manifest(kind, self.metadata)
        if not isinstance(name, str):
            raise BokehguideError(f"Picture.matte: name {shown(name)}: give a string")
        if name not in names:
            raise BokehguideError(f"Picture.matte: no {kind} is named {shown(name)}; {did_you_mean(name, names)}")
        return mask(kind, names[name], self.mattes)

    def show(self) -> None:
        """Show the picture in the notebook, else in the desktop's image viewer."""
        image = Image.fromarray(self.image())
        if _in_notebook():
            from IPython.display import display  # type: ignore[import-not-found] - notebooks have it

            display(image)
        else:
            image.show()

    def _shown(self) -> Tensor:
        """Display values `[H, W, 3]` in 0 … 1."""
        return self.display.show(self._delivered(), self.alpha)

    def _delivered(self) -> np.ndarray:
        """The denoised picture where there is one, else beauty."""
        return self.beauty if self.denoised is None else self.denoised

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
    time_limit: float | None = None,
    quiet: bool = False,
    allow_outside: bool = False,
    on_step: Callable[[int, Callable[[], Picture]], object] | None = None,
    **options: Any,
) -> Picture:
    """Render a scene and return the picture.

    scene: a `Scene`, the name of a built-in scene, or the path of a scene file or of a model. mode: how the lens is sampled.
    spp: samples per pixel. size: width and height in pixels, by default the scene's. denoise: also give the denoised picture, for
    which the extra `denoise` must be installed. time_limit: seconds from the call, after which no step begins; one step is
    always taken. quiet: show neither a progress bar nor warnings of the scene.
    allow_outside: let a scene file name files outside its folder. on_step: called after each step with the samples per pixel so
    far, and a function that returns the picture so far.
    options: fields of `Overrides`, such as `environment` and `focus_distance`, and of `RenderSettings`, such as `seed`,
    `target_noise` and `crop`.

    Ctrl-C, or the stop button of a notebook, ends the render after the current step. The picture so far is returned; its
    metadata say how many samples it has. Raises BokehguideError for input that is missing, malformed or out of range.
    """
    deadline = _deadline(time_limit)
    if on_step is not None and not callable(on_step):
        remedy = "give one that takes the SPP and a function that returns the picture"
        raise BokehguideError(f"render: on_step: {shown(on_step)} is no function; {remedy}")
    width, height = size_pair(size, "render")
    overrides = Overrides(width=width, height=height, **_of(options, OVERRIDES))
    settings = RenderSettings(mode=mode, spp=spp, denoise=denoise, **_of(options, SETTINGS))
    require_known(render, options, OVERRIDES + SETTINGS)
    check_device(settings.device)
    if denoise:
        require_denoiser()
    if settings.cryptomatte:
        require_hash()
    loaded = load_scene(scene, overrides, allow_outside)
    for warning in () if quiet else (*loaded.warnings, *loaded.likely_mistakes):
        warnings.warn(warning, stacklevel=2)
    with make_loop(loaded, settings) as loop:
        _take_steps(loop, deadline, quiet, on_step)
        return _picture(loop)


def _picture(loop: RenderLoop | AdaptiveLoop) -> Picture:
    """The picture of a loop, as its scene and settings ask for it."""
    return picture_of(loop, loop.settings, Display(loop.scene.film.exposure), loop.settings.denoise)


def picture_of(loop: RenderLoop | AdaptiveLoop, settings: RenderSettings, display: Display, denoise: bool) -> Picture:
    """The picture of a loop. settings: for the metadata. denoise: whether to denoise, which requires a loop with a denoiser."""
    film = loop.picture()
    layers, error = film.layers(), None
    if denoise:
        layers["denoised"], error = denoise_picture(film, layers)
    elif loop.step_number > 1:
        error = film.relative_noise()
    display = display.metered(layers.get("denoised", layers["beauty"]), layers["alpha"])
    facts, mattes = describe_render(loop.scene, settings, loop.step_number), {}
    if settings.cryptomatte:
        facts |= matte_attributes(loop.scene)
        mattes = matte_layers(loop.scene, film)
    return Picture(
        **layers,
        metadata=facts | display.attributes,
        estimated_mape=error,
        display=display,
        corner=film.corner,
        frame=(loop.camera.width, loop.camera.height),
        mattes=mattes,
        light_groups=film.light_groups(),
    )


def _of(options: dict[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    """The options with some names."""
    return {name: value for name, value in options.items() if name in names}


def require_known(function: Callable[..., object], options: Iterable[str], fields: tuple[str, ...]) -> None:
    """Raise BokehguideError for an option that is none of `fields`, which `function` takes beside its keywords."""
    for name in options:
        if name not in fields:
            keywords = [each.name for each in signature(function).parameters.values() if each.kind is not each.VAR_KEYWORD]
            hint = did_you_mean(SYNONYMS.get(name, name), [*keywords, *fields])
            if function is render:
                hint = RESULT.get(name, hint)
            if function is render and (configs := _configs_with(name)):
                hint = f"give {configs}, from bokehguide.guiding.config"
            raise BokehguideError(f"{function.__name__}: {name}: no such option; {hint}")


def _configs_with(name: str) -> str:
    """The keywords of `render` whose dataclass has a field of this name, as Python code; empty where none has."""
    configs = {"gaussian": GaussianConfig, "guided": GuidedConfig}
    owners = {keyword: config for keyword, config in configs.items() if name in config.__dataclass_fields__}
    return " or ".join(f"{keyword}={config.__name__}({name}=...)" for keyword, config in owners.items())


def size_pair(size: tuple[int, int] | None, caller: str) -> tuple[int | None, int | None]:
    """Width and height, None for those of the scene. caller: the function that takes the size, for errors."""
    pair = (None, None) if size is None else plain(size)
    if not (isinstance(pair, (tuple, list)) and len(pair) == 2):
        raise BokehguideError(
            f"{caller}: size: {shown(size)} is no pair of whole numbers; give a width and a height, as in (640, 360)"
        )
    width, height = pair
    return width, height


def _deadline(time_limit: float | None) -> float:
    """The reading of `time.monotonic` after which no step begins."""
    if time_limit is None:
        return math.inf
    seconds: Any = plain(time_limit)
    if not (is_number(seconds) and 0.0 < seconds < math.inf):
        raise BokehguideError(f"render: time_limit: {shown(time_limit)} is no number above 0; give seconds")
    return time.monotonic() + seconds


def _take_steps(
    loop: RenderLoop | AdaptiveLoop,
    deadline: float,
    quiet: bool,
    on_step: Callable[[int, Callable[[], Picture]], object] | None,
) -> None:
    """Take all steps, or those until an interruption or the deadline. A SIGTERM takes effect after the step."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # tqdm warns in notebooks without ipywidgets, and shows a bar of text
        from tqdm.auto import tqdm

    spp, title = loop.settings.spp, f"{loop.scene.name} {loop.settings.mode}"
    main = threading.current_thread() is threading.main_thread()
    size = terminal_size() if on_terminal() else {}  # the bar of a notebook has the width of its cell
    # Python lets only the main thread handle signals.
    with (
        Interrupt() if main else nullcontext() as interrupt,
        tqdm(total=spp, desc=title, unit="SPP", disable=quiet or sys.stderr is None, **size) as bar,
    ):
        while not loop.complete:
            loop.step(last=loop.step_number + 1 == spp)
            bar.update()
            if on_step is not None:
                on_step(loop.step_number, lambda: _picture(loop))
            if time.monotonic() > deadline or (interrupt is not None and interrupt.requested):
                break
    if interrupt is not None and interrupt.signal == signal.SIGTERM:
        signal.raise_signal(signal.SIGTERM)


def _in_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return shell is not None and "IPKernelApp" in shell.config
