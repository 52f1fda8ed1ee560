"""The registry of modes: each name selects a lens sampler, a light strategy and a sample reuse."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint, entry_points
from inspect import signature
from pkgutil import resolve_name
from typing import TYPE_CHECKING, cast

from bokehguide.errors import BokehguideError

if TYPE_CHECKING:
    from bokehguide.guiding.protocols import Mode, ModeContext

GROUP = "bokehguide.modes"
"""Group of the entry points by which installed packages add modes."""
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,63}")
"""Names of modes, which are parts of file names and of lists between commas."""
OTHER_PICTURES = ("reference", "convergence", "insets")
"""Pictures that `bokehguide compare` writes beside the picture of each mode."""


@dataclass(frozen=True)
class ModeEntry:
    """An entry of the registry.

    builder: function that builds the mode from a `ModeContext`, or the name "module:function" of this function. summary: short
    description of the lens points. rows_per_band: number of consecutive film rows that one rank renders. whole_frame: whether one
    process must render the whole frame, without a crop and without a noise target.
    """

    builder: Callable[[ModeContext], Mode] | str
    summary: str = ""
    rows_per_band: int = 1
    whole_frame: bool = False

    @property
    def origin(self) -> str:
        """The name "module:function" of the builder."""
        if isinstance(self.builder, str):
            return self.builder
        return f"{self.builder.__module__}:{getattr(self.builder, '__qualname__', repr(self.builder))}"

    def build(self, context: ModeContext) -> Mode:
        """The strategies of a render. For a pinhole, which has one lens point, the uniform lens replaces the lens sampler.

        Raises BokehguideError for a builder that cannot be imported, that does not take one argument, or that returns no `Mode`.
        """
        from bokehguide.guiding.protocols import Mode  # here, as both imports take the time of PyTorch
        from bokehguide.guiding.uniform import UniformLens

        function = self._function()
        self._require_one_argument(function, context.settings.mode)
        mode = function(context)
        if not isinstance(mode, Mode):
            raise BokehguideError(f"mode: {self.origin} returned a {type(mode).__name__}; return a Mode")
        return replace(mode, lens=UniformLens(context, mode.lens.paths_per_sample)) if is_pinhole(context) else mode

    def _require_one_argument(self, function: Callable[..., object], mode: str) -> None:
        """Raise BokehguideError if a function cannot be called with a `ModeContext`. mode: name of the mode."""
        try:
            taken = signature(function)
        except ValueError:  # some functions of extension modules have none
            return
        try:
            taken.bind(None)
        except TypeError:
            name = self.origin.rpartition(":")[2].rpartition(".")[2]
            told = f"{self.origin}{taken} does not take one ModeContext; define it as {name}(context)"
            raise BokehguideError(f"mode: {mode}: the builder {told}") from None

    def _function(self) -> Callable[[ModeContext], Mode]:
        if not isinstance(self.builder, str):
            return self.builder
        try:
            function = resolve_name(self.builder)
        except Exception as error:  # the module may be another author's
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise BokehguideError(f"mode: {self.builder} cannot be imported ({reason}); repair its module") from error
        if not callable(function):
            raise BokehguideError(f"mode: {self.builder} is no function; name it as module:function")
        return cast("Callable[[ModeContext], Mode]", function)


def is_pinhole(context: ModeContext) -> bool:
    """Whether the aperture radius is 0."""
    return context.scene.camera.aperture_radius == 0.0


MODES = {
    "uniform": ModeEntry("bokehguide.guiding.builders:uniform", "evenly over the aperture"),
    "lis": ModeEntry("bokehguide.guiding.builders:lis", "from projected Gaussians, with a fixed β"),
    "lis-b": ModeEntry("bokehguide.guiding.builders:lis_b", "from projected Gaussians, with a learned β"),
    "lis-o": ModeEntry("bokehguide.guiding.builders:lis_o", "from Gaussians with learned β and polynomial offsets"),
    "guided": ModeEntry("bokehguide.guiding.builders:guided", "from the scene's emitters and found highlights", rows_per_band=8),
    "area-restir": ModeEntry(
        "bokehguide.baselines.restir.mode:area_restir", "evenly, then resampled among neighbours", whole_frame=True
    ),
    "area-restir+lis": ModeEntry(
        "bokehguide.baselines.restir.mode:area_restir_lis", "as lis-o, then resampled", whole_frame=True
    ),
}
"""All modes by name: built-in modes, modes of installed packages, and modes of `register_mode`. A mode's module is imported when
a render first needs the mode."""


def register_mode(name: str, builder: Callable[[ModeContext], Mode], whole_frame: bool = False) -> None:
    """Add a mode to the registry of this process.

    name: letters, digits and `. _ + -`. builder: function that builds the mode; a second call with a function of the same module
    and name replaces the mode, so that a notebook cell can run again. whole_frame: whether one process must render the whole
    frame, because pixels use samples of the whole frame.
    Raises BokehguideError for a name that is taken, and for other values out of range.
    """
    if not callable(builder):
        raise BokehguideError(f"register_mode: builder: {builder!r} is no function; give one that builds a Mode")
    entry = ModeEntry(builder, whole_frame=whole_frame)
    if problem := _problem(name, entry):
        raise BokehguideError(f"register_mode: name: {name!r} {problem}; choose another")
    MODES[name] = entry


def _problem(name: str, entry: ModeEntry) -> str | None:
    """Why a mode cannot have a name, if so."""
    if not isinstance(name, str) or NAME.fullmatch(name) is None:
        return "is no name of at most 64 letters, digits and . _ + -"
    if name in OTHER_PICTURES:
        return "is another picture of `bokehguide compare`"
    taken = name in MODES and MODES[name].origin != entry.origin
    return f"is the mode of {MODES[name].origin}" if taken else None


def _add_installed() -> None:
    """Add the modes of installed packages. A name that cannot be used stays in the registry, and its build explains why."""
    for point in entry_points(group=GROUP):
        entry = ModeEntry(point.value)
        problem = _problem(point.name, entry)
        MODES[point.name] = _refused(point, problem) if problem else entry


def _refused(point: EntryPoint, problem: str) -> ModeEntry:
    package = point.dist.name if point.dist else point.module

    def refuse(context: ModeContext) -> Mode:
        raise BokehguideError(f"mode: {point.name!r} of the package {package} {problem}; rename the mode, or remove the package")

    return ModeEntry(refuse)


_add_installed()
