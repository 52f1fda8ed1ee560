"""The requests to a renderer, and its reports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from bokehguide.view.job import Job
from bokehguide.view.pictures import Shown
from bokehguide.view.state import ViewState


class Wanted(NamedTuple):
    """The state to show, and the number of the change that led to it."""

    state: ViewState
    revision: int


@dataclass(frozen=True)
class Sight:
    """A published picture: its job, its width in pixels, its number of steps, the request, and whether the job takes no further
    step."""

    job: Job
    width: int
    step: int
    wanted: Wanted
    rests: bool


class Listener:
    """Receives what a renderer has to tell, on threads of the renderer."""

    def shown(self, facts: dict[str, Any], shown: Shown) -> None:
        """A picture and the facts beside it."""

    def ended(self, job: Job, state: ViewState) -> None:
        """A render has all of its samples."""

    def failed(self, error: Exception) -> None:
        """A state cannot be rendered."""
