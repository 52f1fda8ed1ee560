"""Checkpoints: the state of a render in a file. A resumed render has the bits of an uninterrupted one."""

from __future__ import annotations

import errno
import pickletools
import stat
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch

from bokehguide import __version__
from bokehguide.errors import BokehguideError, printable
from bokehguide.image import replacing
from bokehguide.image.files import unwritable
from bokehguide.scene.digest import digest
from bokehguide.scene.light_groups import find_light_groups
from bokehguide.scene.tables import NOT_NEGATIVE, is_number, shown
from bokehguide.scene.types import Scene
from bokehguide.train.adaptive import AdaptiveLoop
from bokehguide.train.loop import RenderLoop
from bokehguide.train.loop_state import require_kind
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
"""Largest number of differences in a message."""
ANOTHER, UNREADABLE = "was of another render", "is no readable checkpoint of bokehguide"
"""What a file is that has no state of a render. Files of other versions have words with their version."""


@dataclass(frozen=True)
class SavedState:
    """The state that a file has for a render.

    step: number of steps, 0 without a state of the render. kept: whether the file is to stay when the render has ended. stranger:
    what another file is, such as ANOTHER; empty for a file of the render, an empty file and a missing one. changed: the
    inputs that differ from ANOTHER render, with both values.
    """

    step: int = 0
    kept: bool = False
    stranger: str = ""
    changed: str = ""


def save_checkpoint(path: str | Path, loop: RenderLoop | AdaptiveLoop, seconds: float, kept: bool = True) -> None:
    """Write the state of a render atomically; collective.

    seconds: of the render so far; kept: whether the file is to stay when the render has ended. Raises BokehguideError if the file
    cannot be written, and for negative seconds, NaN and other values than numbers.
    """
    if not (is_number(seconds) and NOT_NEGATIVE.contains(seconds)):
        raise BokehguideError(f"save_checkpoint: seconds: {shown(seconds)} is out of range; give {NOT_NEGATIVE.remedy}")
    whole = {"fingerprint": fingerprint(loop.scene, loop.settings), "scene": loop.scene.name}
    whole |= {"seconds": float(seconds), "kept": kept, "loop": loop.state_dict()}
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
        loop.load_state_dict(whole["loop"])
    except (BokehguideError, KeyError, ValueError) as error:
        raise BokehguideError(
            f"{path}: does not fit bokehguide {__version__}: another commit wrote it, or it is damaged; "
            "render without --resume to start again"
        ) from error
    return float(whole["seconds"])


def _require_same_render(path: str | Path, whole: Mapping[str, Any], loop: RenderLoop | AdaptiveLoop) -> None:
    """Raise BokehguideError unless the content of a file is of the loop's render, and of this version."""
    then, now = whole["fingerprint"], fingerprint(loop.scene, loop.settings)
    if writer := _other_writer(then, now):
        both = writer if then.get("software") == now["software"] else f"{writer}, and this is {now['software']}"
        raise BokehguideError(
            f"{path}: was written by {both}; resume with that bokehguide, or render without --resume to start again"
        )
    if found := _changes(whole, loop):
        alone = len(found) == 1 and then.get("size") != now["size"]
        size = f"give --size {printable(str(then.get('size')))} to continue, or " if alone else ""
        raise BokehguideError(f"{path}: is of another render: {_named(found)}; {size}render without --resume to start again")


def _changes(whole: Mapping[str, Any], loop: RenderLoop | AdaptiveLoop) -> list[str]:
    """As `differences`, of the content of a file and a loop's render; the name of another scene comes first."""
    found = differences(whole["fingerprint"], fingerprint(loop.scene, loop.settings))
    scenes = [printable(str(scene)) for scene in (whole.get("scene"), loop.scene.name)]
    renamed = found and "scene" in whole and scenes[0] != scenes[1]
    return ["scene was {} and is {}".format(*scenes), *found] if renamed else found


def _named(found: list[str]) -> str:
    """The first NAMED of some differences, and the number of further ones."""
    more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
    return ", ".join(found[:NAMED]) + more


def _other_writer(then: Mapping[str, Any], now: Mapping[str, str]) -> str:
    """The version or the commit that has written a fingerprint; empty for this one."""
    writer = printable(str(then.get("software", "another version of bokehguide")))
    if writer != now["software"]:
        return writer
    return "" if then.keys() == now.keys() else f"another commit of {writer}"


def saved_state(path: str | Path, loop: RenderLoop | AdaptiveLoop) -> SavedState:
    """The state that the file at `path` has for the loop's render."""
    try:
        whole = _read(path)
        then, now = whole["fingerprint"], fingerprint(loop.scene, loop.settings)
        if writer := _other_writer(then, now):
            return SavedState(stranger=f"was written by {writer}")
        if found := _changes(whole, loop):
            return SavedState(stranger=ANOTHER, changed=_named(found))
        step = whole["loop"]["step"]
        require_kind(step, 0)
    except (BokehguideError, KeyError, TypeError, ValueError):
        filled = Path(path).is_file() and Path(path).stat().st_size > 0
        return SavedState(stranger=UNREADABLE if filled else "")
    return SavedState(step, whole.get("kept") is True)


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


def _damaged(path: str | Path) -> BokehguideError:
    return BokehguideError(f"{path}: is damaged or no checkpoint of a render; render without --resume to start again")


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
