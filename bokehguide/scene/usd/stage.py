"""A USD file as a composed stage, with its time, its units, and what is lost on the way."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.errors import BokehguideError, printable
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.losses import Losses
from bokehguide.scene.model import ModelState
from bokehguide.scene.usd.documents import MISSING, SUFFIX, Documents
from bokehguide.scene.usd.libraries import Ar, Sdf, Tf, Usd, UsdGeom, UsdUtils
from bokehguide.scene.usd.messages import problem_of
from bokehguide.scene.usd.variants import select_variants
from bokehguide.stopping import default_signals

MAX_NESTING = 1000
"""Brackets within brackets of a text file: the parser of USD is recursive, and each level takes some of its stack."""
NOT_BRACKETS = re.compile(rb"#[^\n]*|\"(?:[^\"\\\n]|\\.)*\"|'(?:[^'\\\n]|\\.)*'|@[^@\n]*@|[^][(){}#\"'@]+|[\"'@]")
SILENT = ("MaterialBindingAPI is not applied",)
"""Parts of messages of USD about files that are read all the same."""


@dataclass
class Stage:
    """An open stage.

    stage: of `pxr.Usd`. time: a `pxr.Usd.TimeCode`. world: the matrix `[4, 4]` from scene units to metres with y up. unit:
    metres of a scene unit. lost: with the names of the prims. current: the prim that is read.
    """

    path: Path
    files: SceneFiles
    stage: Any
    time: Any
    world: np.ndarray
    unit: float
    lost: Losses = field(default_factory=Losses)
    current: Any = None

    def lose(self, what: str, name: str) -> None:
        """Note a loss at a prim."""
        self.lost.add(what, printable(name, 120))

    def place(self, prim: Any) -> str:
        """The file and the path of a prim, for errors."""
        return f"{self.path}: {printable(str(prim.GetPath()), 120)}"

    def fail(self, prim: Any, problem: str) -> None:
        """Raise the error that a prim has `problem`."""
        raise BokehguideError(f"{self.place(prim)}: {problem}")


class BinaryLayer(Exception):
    """A layer that is no text."""


@contextmanager
def open_stage(path: Path, files: SceneFiles, state: ModelState, binary: bool) -> Iterator[Stage]:
    """The stage of a file, with all files that it is composed of.

    files: the files that the stage may name. state: the variants, and the time of the animation; without a time, the start of the
    stage. binary: whether layers may be binary. Raises BokehguideError for missing USD libraries, an unreadable file, a layer
    outside the scene's folder, and a variant that the stage lacks, and BinaryLayer.
    """
    if find_spec("pxr") is None:
        raise BokehguideError(f"{path}: a USD scene, and the USD libraries are missing\nRun pip install 'bokehguide[usd]'")
    if not binary and not _is_text(path):  # without importing the USD libraries
        raise BinaryLayer
    messages = UsdUtils.CoalescingDiagnosticDelegate()  # replaces the printing of messages to stderr
    documents = Documents(path, files)
    try:
        with default_signals():
            root = _checked_layers(path, files, binary, documents)
            stage = _opened(path, lambda: Usd.Stage.Open(root))
        world, unit = _to_world(path, stage)
        opened = Stage(path, files, stage, _time(stage, state.time), world, unit, documents.lost)
        try:
            if state.variant is not None:
                select_variants(path, stage, state.variant)
            yield opened
        except (Tf.ErrorException, TypeError, ValueError, ArithmeticError) as error:  # attributes of any type, on any prim
            place = str(path) if opened.current is None else opened.place(opened.current)
            raise BokehguideError(f"{place}: cannot be read ({problem_of(error, path)}); repair the file") from None
        _note_messages(opened, messages)
    finally:
        documents.restore()
        messages.TakeUncoalescedDiagnostics()
        del messages


def _opened(path: Path, read: Any) -> Any:
    """The result of `read`. Raises BokehguideError where USD fails."""
    try:
        result = read()
    except (Tf.ErrorException, RuntimeError, ValueError, MemoryError) as error:
        raise BokehguideError(f"{path}: not a readable USD file ({problem_of(error, path)}); repair it") from None
    if not result:
        raise BokehguideError(f"{path}: not a readable USD file; give an intact copy")
    return result


def _checked_layers(path: Path, files: SceneFiles, binary: bool, documents: Documents) -> Any:
    """The root layer of `path`. documents: replace those of MaterialX. Raises as `open_stage` does."""
    seen, waiting, root, stored = set[str](), [str(path.resolve())], None, 0
    while waiting:
        name = waiting.pop()
        if name in seen:
            continue
        seen.add(name)
        outer = Path(Ar.SplitPackageRelativePathOuter(name)[0])
        if _is_text(outer):
            _check_nesting(outer)
        elif not binary:
            raise BinaryLayer
        stored += outer.stat().st_size if str(outer) == name else 0
        layer = _opened(outer, lambda name=name: Sdf.Layer.FindOrOpen(name))
        root = root or layer
        sublayers, references, payloads = UsdUtils.ExtractExternalReferences(layer.identifier)
        for asset in {*sublayers, *references, *payloads}:
            found = _layer_of(path, files, layer, asset)
            if found is not None:
                waiting.append(found)
        documents.replace(layer)
    files.add_geometry(stored)
    return root


def _layer_of(path: Path, files: SceneFiles, layer: Any, asset: str) -> str | None:
    """The resolved path of a layer that `layer` names, None for a missing file and for a file of another kind."""
    name = Sdf.Layer.SplitIdentifier(asset)[0]
    if Sdf.FileFormat.FindByExtension(Ar.GetResolver().GetExtension(name)) is None:
        return None
    absolute = Sdf.ComputeAssetPathRelativeToLayer(layer, name)
    resolved = str(Ar.GetResolver().Resolve(absolute))
    files.find(path.parent, Ar.SplitPackageRelativePathOuter(resolved or absolute)[0], f"{path}: {printable(name, 200)}")
    return resolved or None


def _is_text(path: Path) -> bool:
    if path.suffix.lower() != ".usd":
        return path.suffix.lower() == ".usda"
    with path.open("rb") as file:
        return file.read(5) == b"#usda"


def _check_nesting(path: Path) -> None:
    """Raise BokehguideError for more than MAX_NESTING brackets within brackets."""
    brackets = NOT_BRACKETS.sub(b"", path.read_bytes())
    steps = np.frombuffer(brackets, np.uint8)
    opening = np.isin(steps, np.frombuffer(b"([{", np.uint8))
    if len(steps) and np.cumsum(np.where(opening, 1, -1)).max() > MAX_NESTING:
        raise BokehguideError(f"{path}: has more than {MAX_NESTING} brackets within brackets; flatten the hierarchy")


def _to_world(path: Path, stage: Any) -> tuple[np.ndarray, float]:
    """The matrix from scene units to metres with y up, and the metres of a scene unit."""
    unit = float(UsdGeom.GetStageMetersPerUnit(stage))
    if not 1e-9 <= unit <= 1e9:
        raise BokehguideError(f"{path}: metersPerUnit: {unit:g} is out of range; give metres above 0, such as 0.01")
    world = np.diag([unit, unit, unit, 1.0])
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z:
        world = world @ np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)
    return world, unit


def _time(stage: Any, seconds: float | None) -> Any:
    """The time code of `seconds`; without them, the start of the stage, or the first samples."""
    if seconds is not None:
        return Usd.TimeCode(seconds * stage.GetTimeCodesPerSecond())
    if stage.HasAuthoredTimeCodeRange():
        return Usd.TimeCode(stage.GetStartTimeCode())
    return Usd.TimeCode.EarliestTime()


def _note_messages(opened: Stage, messages: Any) -> None:
    """Tell the messages of USD, such as of references to missing files."""
    silent = (*SILENT, f"{SUFFIX}@") if MISSING in opened.lost else SILENT
    for message in messages.TakeUncoalescedDiagnostics():
        text = message.commentary.strip() or "an unknown problem"
        if not any(part in text for part in silent):
            opened.lose("USD reports", text.splitlines()[0].replace(f"{opened.path.resolve().parent}/", ""))
