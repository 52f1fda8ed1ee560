"""The registry of modes: each name selects a lens sampler, a light strategy and a sample reuse."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bokehguide.guiding.protocols import Mode, ModeContext


@dataclass(frozen=True)
class ModeEntry:
    """An entry of the registry.

    builder: name "module:function" of the function that builds the mode from a `ModeContext`. summary: short description of the
    lens points. rows_per_band: number of consecutive film rows that one rank renders. whole_frame: whether one process must
    render the whole frame, without a crop and without a noise target.
    """

    builder: str
    summary: str
    rows_per_band: int = 1
    whole_frame: bool = False

    def build(self, context: ModeContext) -> Mode:
        """The strategies of a render."""
        module, function = self.builder.split(":")
        return getattr(import_module(module), function)(context)


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
"""All modes by name. A mode's module is imported when a render first needs the mode."""
