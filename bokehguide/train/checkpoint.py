"""Checkpoints: the state of a render in a file. A resumed render has the bits of an uninterrupted one."""

from __future__ import annotations

import errno
import pickletools
import stat
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bokehguide import __version__
from bokehguide.errors import BokehguideError, printable
from bokehguide.image import replacing
from bokehguide.image.files import unwritable
from bokehguide.limits import LARGEST, MAX_INT
from bokehguide.scene.digest import digest
from bokehguide.scene.light_groups import find_light_groups
from bokehguide.scene.types import Scene
from bokehguide.train.adaptive import AdaptiveLoop
from bokehguide.train.loop import RenderLoop
from bokehguide.train.settings import RenderSettings

DATA = ("camera.aperture", "meshes", "materials", "environment", "suns", "light groups", "names of mattes")
"""Inputs of a render that do not fit in one line of a message, stored as digests."""
OTHER = {name: f"other {name}" for name in DATA} | {name: f"other settings of {name}" for name in ("gaussian", "guided")}
"""Words for differences that do not fit in one line of a message."""
TYPES = {"collections OrderedDict", "torch._utils _rebuild_tensor_v2"}
"""Types in the states of all modes, as pickle names them. Storages of tensors are permitted too."""
MAX_PICKLE = 2**20
"""Largest pickle in bytes. The pickles of all modes have less than 10,000."""
NAMED = 4
"""Largest number of differences in an error message."""


def save_checkpoint(path: str | Path, loop: RenderLoop | AdaptiveLoop, seconds: float, kept: bool = True) -> None:
    """Write the state of a render atomically; collective.

    seconds: of the render so far; kept: whether the file is to stay when the render has ended. Raises BokehguideError if the file
    cannot be written.
    """
    whole = {"fingerprint": fingerprint(loop.scene, loop.settings), "scene": loop.scene.name}
    whole |= {"seconds": seconds, "kept": kept, "loop": loop.state_dict()}
    if not loop.ranks.first:
        return
    with replacing(path) as temporary:
        try:
            with temporary.open("wb") as file:
                torch.save(whole, file)
        except RuntimeError as error:  # from torch's writer, after the error of the file
            cause = error.__context__
            raise unwritable(Path(path), cause if isinstance(cause, OSError) else error) from error


def load_checkpoint(path: str | Path, loop: RenderLoop | AdaptiveLoop) -> float:
    """Load the state of a saved render into a new loop; returns the seconds that the render had taken.

    Raises BokehguideError for a file that is missing or damaged, and for a file with another version, scene or setting than the
    loop. The number of samples per pixel and the number of threads may differ.
    """
    whole = _read(path)
    _require_same_render(path, whole, loop)
    try:
        require_kind(whole["seconds"], 0.0)
        require_kind(whole["loop"], loop.state_dict())
        for half in whole["loop"].get("halves", [whole["loop"]]):
            _require_numbers(half)
        loop.load_state_dict(whole["loop"])
    except (AttributeError, IndexError, KeyError, RecursionError, RuntimeError, TypeError, ValueError) as error:
        raise BokehguideError(
            f"{path}: does not fit bokehguide {__version__}: another commit wrote it, or it is damaged; "
            "render without --resume to start again"
        ) from error
    return float(whole["seconds"])


def _require_same_render(path: str | Path, whole: Mapping[str, Any], loop: RenderLoop | AdaptiveLoop) -> None:
    """Raise BokehguideError unless the content of a file is of the loop's render, and of this version."""
    then, now = whole["fingerprint"], fingerprint(loop.scene, loop.settings)
    writer, this = printable(str(then.get("software", "another version of bokehguide"))), now["software"]
    if writer != this or then.keys() != now.keys():
        both = f"{writer}, and this is {this}" if writer != this else f"another commit of {this}"
        raise BokehguideError(
            f"{path}: was written by {both}; resume with that bokehguide, or render without --resume to start again"
        )
    found, scenes = differences(then, now), [printable(str(scene)) for scene in (whole.get("scene"), loop.scene.name)]
    if found and "scene" in whole and scenes[0] != scenes[1]:
        found.insert(0, "scene was {} and is {}".format(*scenes))
    if found:
        more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
        named = ", ".join(found[:NAMED])
        raise BokehguideError(f"{path}: is of another render: {named}{more}; render without --resume to start again")


def saved_state(path: str | Path, loop: RenderLoop | AdaptiveLoop) -> tuple[int, bool, bool]:
    """The number of steps of the loop's render in a file, whether the file is to stay when the render has ended, and whether
    the file is a checkpoint of another render.

    0, False and False if the file is missing or damaged; 0, False and True if it is of another render.
    """
    try:
        whole = _read(path)
        if differences(whole["fingerprint"], fingerprint(loop.scene, loop.settings)):
            return 0, False, True
        step, kept = whole["loop"]["step"], whole.get("kept") is True
    except (BokehguideError, KeyError, TypeError):
        return 0, False, False
    return (step, kept, False) if type(step) is int and step > 0 else (0, False, False)


def _read(path: str | Path) -> dict[str, Any]:
    """The content of a checkpoint of any render. Raises BokehguideError for a file that is missing or damaged."""
    try:
        if not stat.S_ISREG(Path(path).stat().st_mode):  # opening a pipe could block for ever
            raise OSError(errno.EINVAL, "no regular file")
        with zipfile.ZipFile(path) as archive:
            records = archive.infolist()
            packed = any(record.compress_type != zipfile.ZIP_STORED for record in records)  # torch would expand it
            truncated = sum(record.file_size for record in records) > Path(path).stat().st_size
            whole_file = not packed and not truncated and archive.testzip() is None  # torch does not verify checksums
            whole_file = whole_file and all(map(_is_plain, _pickles(archive)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about unusual pickles, for developers of torch
            whole = torch.load(path, map_location="cpu", weights_only=True) if whole_file else None
    except OSError as error:
        raise BokehguideError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except Exception as error:  # neither reader documents its exceptions for damaged bytes
        raise _damaged(path) from error
    then = whole.get("fingerprint", whole.get("origin")) if isinstance(whole, dict) else None  # its name before 0.3.0
    if (
        whole is None
        or not isinstance(then, dict)
        or not all(isinstance(text, str) and text.isprintable() for text in then.values())
    ):
        raise _damaged(path)
    return whole | {"fingerprint": then}


def _pickles(archive: zipfile.ZipFile) -> Iterator[bytes]:
    """The pickles of a file. Raises ValueError for one that is larger than any state needs."""
    for record in archive.infolist():
        if record.filename.lower().endswith(".pkl"):
            if record.file_size > MAX_PICKLE:
                raise ValueError("the pickle is too large")
            yield archive.read(record)


def _is_plain(pickle: bytes) -> bool:
    """Whether a pickle names only TYPES and storages: others, such as a byte array of any length, take memory to be built."""
    named = {str(value) for code, value, _ in pickletools.genops(pickle) if code.name in ("GLOBAL", "INST", "STACK_GLOBAL")}
    return all(name in TYPES or (name.startswith("torch ") and name.endswith("Storage")) for name in named)


def require_kind(saved: object, own: Any, seen: set[tuple[int, int]] | None = None) -> None:
    """Raise ValueError unless `saved` can be a later state of `own`, the same part of a new loop's state.

    The check fails for numbers of another type, and for tensors of another type. It fails for tensors that are not finite or that
    exceed their storage, and for negative or very large whole numbers in tensors. The film and the strategies check the shapes of
    their states. seen: pairs of parts that the check has passed; a small file can refer to one part very often.
    """
    seen = set() if seen is None else seen
    if (id(saved), id(own)) in seen:
        return
    seen.add((id(saved), id(own)))
    if isinstance(saved, Tensor):
        _require_tensor(saved, own)
    elif isinstance(own, int | float) and not isinstance(own, bool):
        if type(saved) is not type(own) or not 0 <= saved <= LARGEST:
            raise ValueError(f"{saved!r} is no number of the type of {own!r}")
    elif own is not None and not isinstance(saved, dict if isinstance(own, dict) else type(own)):
        raise ValueError(f"{type(saved).__name__} in the place of {type(own).__name__}")
    elif isinstance(saved, dict):
        for name, part in saved.items():
            require_kind(part, own.get(name) if isinstance(own, dict) else None, seen)
    elif isinstance(saved, list | tuple):
        for number, part in enumerate(saved):
            require_kind(part, own[number] if isinstance(own, list | tuple) and number < len(own) else None, seen)


def _require_tensor(saved: Tensor, own: object) -> None:
    """The part of `require_kind` for a tensor."""
    stored = saved.numel() * saved.element_size() <= saved.untyped_storage().nbytes()
    finite = stored and (not saved.is_floating_point() or bool(saved.isfinite().all()))
    if finite and not saved.is_floating_point() and saved.dtype != torch.bool:  # indices and counts
        finite = saved.numel() == 0 or bool((saved >= 0).all() and (saved <= MAX_INT).all())
    matches = own is None or (isinstance(own, Tensor) and (saved.dtype, saved.ndim) == (own.dtype, own.ndim))
    if not finite or not matches:
        raise ValueError(f"a tensor of {saved.dtype} {tuple(saved.shape)} that is not finite, not stored or of another type")


def _require_numbers(state: Mapping[str, dict]) -> None:
    """Raise ValueError unless the times and bad samples of a loop's state are numbers."""
    for seconds in state["phases"].values():
        require_kind(seconds, 0.0)
    for *place, seed in state["film"]["bad_samples"]:
        for number in place:
            require_kind(number, 0)
        if type(seed) is not int:  # a seed may be negative or large
            raise ValueError(f"{seed!r} is no seed")


def _damaged(path: str | Path) -> BokehguideError:
    return BokehguideError(f"{path}: is damaged or no checkpoint of a render; remove it to start again")


def fingerprint(scene: Scene, settings: RenderSettings) -> dict[str, str]:
    """All inputs that determine the bits of a render, by name. Inputs in DATA are digests, and all other inputs are text."""
    camera, film = scene.camera, scene.film
    values = {"software": f"bokehguide {__version__}", "mode": settings.mode, "seed": settings.seed}
    values |= {"size": f"{film.width}x{film.height}", "max_depth": film.max_depth, "device": settings.device}
    values |= {"reuse_radius": settings.reuse_radius if settings.whole_frame else "unused"}
    values |= {"crop": settings.crop, "target_noise": settings.target_noise}
    values |= {"denoise": settings.denoise, "cryptomatte": settings.cryptomatte}
    values |= {"gaussian": settings.gaussian, "guided": settings.guided}
    values |= {f"camera.{field.name}": getattr(camera, field.name) for field in fields(camera) if field.name != "aperture"}
    groups = find_light_groups(scene) if settings.light_groups else None
    names = [[one.name for one in group] for group in (scene.meshes, scene.materials)] if settings.cryptomatte else None
    data = (camera.aperture, scene.meshes, scene.materials, scene.environment, scene.suns, groups, names)
    return {name: str(value) for name, value in values.items()} | dict(zip(DATA, map(digest, data), strict=True))


def differences(then: Mapping[str, object], now: Mapping[str, str]) -> list[str]:
    """The inputs that have changed since a checkpoint was written, in words."""
    other = [name for name in now if then.get(name) != now[name]]
    return [OTHER.get(name) or f"{name} was {printable(str(then.get(name)))} and is {now[name]}" for name in other]
