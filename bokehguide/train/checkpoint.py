"""Renders on disk that go on where they ended, with the same bits as if they had never stopped."""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

import torch
from torch import Tensor

from bokehguide import __version__
from bokehguide.errors import BokehguideError, printable
from bokehguide.image import replacing
from bokehguide.image.files import unwritable
from bokehguide.limits import LARGEST, MAX_INT
from bokehguide.scene.digest import digest
from bokehguide.scene.types import Scene
from bokehguide.train.adaptive import AdaptiveLoop
from bokehguide.train.guide import LensGuide
from bokehguide.train.loop import RenderLoop
from bokehguide.train.settings import RenderSettings
from bokehguide.train.spot_guide import SpotGuide

DATA = ("camera.aperture", "meshes", "materials", "environment", "suns")
"""Of what a render is made from, what no line can tell."""
NAMED = 4
"""Differences that a refusal names."""


def save_checkpoint(path: str | Path, loop: RenderLoop | AdaptiveLoop, seconds: float) -> None:
    """Write the whole state of a render; the file is the old one or the new one, never half of one. Collective.

    seconds: that the render has taken so far. Raises BokehguideError where it cannot be written.
    """
    whole = {"origin": origin(loop.scene, loop.settings), "seconds": seconds, "loop": loop.state_dict()}
    if not loop.ranks.first:
        return
    with replacing(path) as temporary:
        try:
            torch.save(whole, temporary)
        except RuntimeError as error:  # of torch's own writer, on a full disk
            raise unwritable(Path(path), error) from error


def load_checkpoint(path: str | Path, loop: RenderLoop | AdaptiveLoop) -> float:
    """Bring a fresh loop to where the render was when it was saved; returns the seconds it had taken.

    Raises BokehguideError for a file that is missing or damaged, or was made by another
    version, from another scene, or with another setting than the loop's (but SPP and threads).
    """
    whole = _read(path, loop)
    try:
        require_kind(whole["seconds"], 0.0)
        require_kind(whole["loop"], loop.state_dict())
        for half in whole["loop"].get("halves", [whole["loop"]]):
            _require_numbers(half)
        loop.load_state_dict(whole["loop"])
        for half in loop.halves if isinstance(loop, AdaptiveLoop) else (loop,):
            _require_fit(half.guide)
    except (AttributeError, IndexError, KeyError, RecursionError, RuntimeError, TypeError, ValueError) as error:
        raise _damaged(path) from error
    return float(whole["seconds"])


def saved_steps(path: str | Path, loop: RenderLoop | AdaptiveLoop) -> int:
    """How many steps of the loop's render a file holds; 0 where it is missing, damaged or of another one."""
    try:
        return _read(path, loop)["loop"]["step"]
    except (BokehguideError, KeyError, TypeError):
        return 0


def _read(path: str | Path, loop: RenderLoop | AdaptiveLoop) -> dict[str, object]:
    """What was saved, when it is of the loop's render. Raises as `load_checkpoint`."""
    try:
        with zipfile.ZipFile(path) as archive:
            records = archive.infolist()
            packed = any(record.compress_type != zipfile.ZIP_STORED for record in records)  # torch would unfold it
            lying = sum(record.file_size for record in records) > Path(path).stat().st_size
            whole_file = not packed and not lying and archive.testzip() is None  # torch does not look at checksums
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of odd pickles, to torch's own developers
            whole = torch.load(path, map_location="cpu", weights_only=True) if whole_file else None
    except OSError as error:
        raise BokehguideError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except Exception as error:  # what either reader raises for damaged bytes is not in their documentation
        raise _damaged(path) from error
    then = whole.get("origin") if isinstance(whole, dict) else None
    if not isinstance(then, dict) or not all(isinstance(text, str) and text.isprintable() for text in then.values()):
        raise _damaged(path)
    found = differences(then, origin(loop.scene, loop.settings))
    if found:
        more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
        named = ", ".join(found[:NAMED])
        raise BokehguideError(f"{path}: is of another render: {named}{more}; render without resuming to start anew")
    return whole


def require_kind(saved: object, own: object) -> None:
    """Raise ValueError unless `saved` can be what `own`, the same part of a fresh state, has become.

    A film's and a guide's own loading see to shapes; here, no tensor is of another type, not finite,
    larger than what is stored of it or, of whole numbers, negative or huge, and no number of another kind.
    """
    if isinstance(saved, Tensor):
        _require_tensor(saved, own)
    elif isinstance(own, int | float) and not isinstance(own, bool):
        if type(saved) is not type(own) or not 0 <= saved <= LARGEST:
            raise ValueError(f"{saved!r} is no number of the kind of {own!r}")
    elif own is not None and not isinstance(saved, dict if isinstance(own, dict) else type(own)):
        raise ValueError(f"{type(saved).__name__} in the place of {type(own).__name__}")
    elif isinstance(saved, dict):
        for name, part in saved.items():
            require_kind(part, own.get(name) if own else None)
    elif isinstance(saved, list | tuple):
        for number, part in enumerate(saved):
            require_kind(part, own[number] if own and number < len(own) else None)


def _require_tensor(saved: Tensor, own: object) -> None:
    stored = saved.numel() * saved.element_size() <= saved.untyped_storage().nbytes()
    finite = stored and (not saved.is_floating_point() or bool(saved.isfinite().all()))
    if finite and not saved.is_floating_point() and saved.dtype != torch.bool:  # places and counts
        finite = saved.numel() == 0 or bool((saved >= 0).all() and (saved <= MAX_INT).all())
    alike = own is None or isinstance(own, Tensor) and (saved.dtype, saved.ndim) == (own.dtype, own.ndim)
    if not finite or not alike:
        raise ValueError(f"a tensor of {saved.dtype} {tuple(saved.shape)} that is not finite, not there or of another kind")


def _require_numbers(state: Mapping[str, dict]) -> None:
    """Raise ValueError where the times and bad samples of a loop's state are none."""
    for seconds in state["phases"].values():
        require_kind(seconds, 0.0)
    for number in sum(map(tuple, state["film"]["bad_samples"]), ()):
        require_kind(number, 0)


def _require_fit(guide: LensGuide | SpotGuide | None) -> None:
    """Raise ValueError unless Adam's moments are as large as their parameters, at which its fused step does not look,
    and the spotlights are cells of the record buffer."""
    if guide is None:
        return
    if bool((guide.spotlights >= guide.record.height * guide.record.width).any()):
        raise ValueError("spotlights outside the record buffer")
    for optimizer in guide.optimizers.values():
        for parameter, state in optimizer.state.items():
            for name, moment in state.items():
                shape = () if name == "step" else parameter.shape
                if not isinstance(moment, Tensor) or moment.shape != shape or moment.dtype != torch.float32:
                    raise ValueError(f"{name} does not fit a parameter of {tuple(parameter.shape)}")


def _damaged(path: str | Path) -> BokehguideError:
    return BokehguideError(f"{path}: is damaged or no checkpoint of a render; remove it to start anew")


def origin(scene: Scene, settings: RenderSettings) -> dict[str, str]:
    """All that the bits of a render depend on, by name: values as text, those of DATA as digests."""
    camera, film = scene.camera, scene.film
    values = {"software": f"bokehguide {__version__}", "mode": settings.mode, "seed": settings.seed}
    values |= {"size": f"{film.width}x{film.height}", "max_depth": film.max_depth, "device": settings.device}
    values |= {"reuse_radius": settings.reuse_radius if settings.reuses else "unused"}
    values |= {"crop": settings.crop, "target_noise": settings.target_noise}
    values |= {f"camera.{field.name}": getattr(camera, field.name) for field in fields(camera) if field.name != "aperture"}
    data = (camera.aperture, scene.meshes, scene.materials, scene.environment, scene.suns)
    return {name: str(value) for name, value in values.items()} | dict(zip(DATA, map(digest, data), strict=True))


def differences(then: Mapping[str, object], now: Mapping[str, str]) -> list[str]:
    """In words, what is not as it was when a checkpoint was written."""
    other = [name for name in now if then.get(name) != now[name]]
    return [f"other {name}" if name in DATA else f"{name} was {printable(str(then.get(name)))} and is {now[name]}" for name in other]
