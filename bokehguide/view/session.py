"""One scene that is shown and set: the state, the renderer, and the answers to the messages of a page."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.image import write_text
from bokehguide.limits import VIEWS
from bokehguide.scene.tables import did_you_mean
from bokehguide.train import MODES
from bokehguide.view.history import History
from bokehguide.view.job import Job
from bokehguide.view.motion import move
from bokehguide.view.pictures import Shown, png
from bokehguide.view.pixel import pixel_facts
from bokehguide.view.renderer import Renderer
from bokehguide.view.saving import free_paths, save
from bokehguide.view.sharpness import DepthFinder
from bokehguide.view.sights import Listener
from bokehguide.view.state import LAYERS, Source, ViewState, changed, command_line, moved, scene_file, values_of

Send = Callable[["Message"], None]


@dataclass(frozen=True)
class Message:
    """A message to the page: facts as JSON values, and a picture as PNG, empty without one. A later message of the same `kind`
    replaces an earlier one that has not been sent."""

    kind: str
    facts: Mapping[str, Any]
    picture: bytes = b""


class Exhibit(Protocol):
    """What a server shows to browsers: a `Session`, or the file of another render."""

    def start(self, send: Send) -> None:
        """Begin; `send` receives messages for all browsers, from any thread."""

    def close(self) -> None:
        """End all work."""

    def watch(self, watched: bool) -> None:
        """Whether any browser is connected."""

    def greeting(self) -> list[Message]:
        """The messages for a browser that connects."""
        ...

    def handle(self, request: Mapping[str, Any]) -> Message | Future[Message] | None:
        """Follow a request of a page; returns the answer for this page. Raises BokehguideError."""


FREE = ("hover",)
"""Requests that change nothing. All browsers may send them."""


class Session(Listener):
    """A scene whose camera, lens and display the page sets.

    denoiser: whether a denoiser is installed. folder: of files that the page saves.
    """

    def __init__(self, source: Source, state: ViewState, folder: Path, denoiser: bool, threads: int | None = None):
        self.source, self.folder, self.denoiser = source, folder, denoiser
        self._first = self.state = state
        self._revision = 0
        self._history, self._kind = History(), ("", "", "")
        """Earlier states, and the kind of the request that is followed."""
        self._warnings = (*source.scene.warnings, *source.scene.likely_mistakes)
        self._marked = False
        self._send: Send = lambda message: None
        self._latest: Message | None = None
        """The picture that was shown last, for browsers that connect."""
        self._depths = DepthFinder(source.scene)
        self._marking = ThreadPoolExecutor(1, "marker")
        self._lock = threading.Lock()
        self._layers: tuple[object, int, dict[str, np.ndarray]] | None = None
        self.renderer = Renderer(source, state, self, denoiser, threads)

    def start(self, send: Send) -> None:
        self._send = send
        self.renderer.start()

    def close(self) -> None:
        self._marked = False
        self._marking.shutdown()
        self.renderer.close()

    def watch(self, watched: bool) -> None:
        if self.renderer.watch(watched):
            self._send(Message("note", {"note": "the render goes on: it paused when the last page closed"}))

    def greeting(self) -> list[Message]:
        scene = self.source.scene
        facts = {
            "scene": scene.name,
            "width": scene.film.width,
            "height": scene.film.height,
            "modes": list(MODES),
            "views": list(VIEWS),
            "layers": list(LAYERS),
            "denoiser": self.denoiser,
            "environment": scene.environment is not None,
            "follows": False,
        }
        marker = [self._marker()] if self._marked else []
        picture = [] if self._latest is None else [self._latest]
        warnings = [Message("note", {"note": "\n".join(f"warning: {each}" for each in self._warnings)})] if self._warnings else []
        return [Message("hello", facts), self._state_message(), *picture, *marker, *warnings]

    def handle(self, request: Mapping[str, Any]) -> Message | Future[Message] | None:
        kind = request.get("type")
        if kind == "hover":
            return self._hover(request)
        if kind not in REQUESTS:
            raise BokehguideError(f"{str(kind)[:40]!r} is no request; {did_you_mean(str(kind), REQUESTS)}")
        with self._lock:
            self._kind = kind, str(request.get("name")), str(request.get("kind"))
            return REQUESTS[kind](self, request)

    def shown(self, facts: dict[str, Any], shown: Shown) -> None:
        self._latest = Message("picture", facts, png(shown.image))
        self._send(self._latest)

    def ended(self, job: Job, state: ViewState) -> None:
        try:
            self._send(Message("note", {"note": save(job, state, self.source, self.folder)}))
        except BokehguideError as error:  # the samples stay, so that the picture can be saved again
            self.failed(error)
        self._send(self._state_message())

    def failed(self, error: Exception) -> None:
        self._send(Message("failure", {"failure": str(error)}))
        self._send(self._state_message())

    def _change(self, state: ViewState) -> None:
        """Show another state. Raises BokehguideError for another picture while a render runs."""
        if self.renderer.rendering and (state.traced, state.spp) != (self.state.traced, self.state.spp):
            raise BokehguideError("a render is running; stop it before you change the picture")
        before, self.state = self.state, state
        if self._kind[0] != "undo":
            self._history.add(before, state, self._kind)
        self._revision += 1
        self.renderer.update(state, self._revision)
        self._send(self._state_message())
        if before.overrides != state.overrides:
            self._mark_later()

    def _state_message(self) -> Message:
        facts = {
            "revision": self._revision,
            "values": values_of(self.state, self.source),
            "command": command_line(self.state, self.source),
            "rendering": self.renderer.rendering,
            "paused": self.renderer.paused,
            "marked": self._marked,
            "changes": len(self._history),
        }
        return Message("state", facts)

    def _set(self, request: Mapping[str, Any]) -> None:
        self._change(changed(self.state, self.source, str(request.get("name")), request.get("value")))

    def _focus(self, request: Mapping[str, Any]) -> None:
        depth = self._depths.at(self.source.scene_of(self.state.overrides), *_place(request))
        self._change(changed(self.state, self.source, "focus_distance", depth))

    def _move(self, request: Mapping[str, Any]) -> None:
        camera = self.source.scene_of(self.state.overrides).camera
        place = move(camera, str(request.get("kind")), *_pair(request))
        self._change(moved(self.state, self.source, *place))

    def _reset(self, request: Mapping[str, Any]) -> None:
        self._change(replace(self._first, layer=self.state.layer))

    def _undo(self, request: Mapping[str, Any]) -> None:
        if self.renderer.rendering:
            raise BokehguideError("a render is running; stop it before you undo a change")
        self._change(self._history.undone(self.state))

    def _mark(self, request: Mapping[str, Any]) -> None:
        self._marked = bool(request.get("on"))
        self._send(self._state_message())
        if self._marked:
            self._mark_later()
        else:
            self._send(Message("marker", {"on": False}))

    def _mark_later(self) -> None:
        """Send the marker of the present state, unless another state has replaced it by then."""
        if self._marked:
            self._marking.submit(self._send_marker, self.state)

    def _send_marker(self, state: ViewState) -> None:
        if self._marked and state is self.state:
            self._send(self._marker())

    def _marker(self) -> Message:
        marker = self._depths.marker(self.source.scene_of(self.state.overrides))
        return Message("marker", {"on": True}, png(marker))

    def _render(self, request: Mapping[str, Any]) -> None:
        self.renderer.render(bool(request.get("on")))
        self._send(self._state_message())

    def _save_picture(self, request: Mapping[str, Any]) -> Future[Message]:
        """Save the exact picture, which may need its samples first."""
        state = self.state

        def saved(job: Job) -> Message:
            return Message("note", {"note": save(job, state, self.source, self.folder)})

        if not self.renderer.exact:
            self._send(Message("note", {"note": "the file follows when its samples are those of the command"}))
        return self.renderer.ask(saved, exact=True)

    def _save_scene(self, request: Mapping[str, Any]) -> Message:
        (path,) = free_paths(self.folder, f"{self.source.scene.name}-view", (".toml",))
        text = scene_file(self.state, self.source, self.folder, path.name)
        write_text(path, text)
        return Message("note", {"note": f"wrote {path.name}; its first line is the command that renders it"})

    def _hover(self, request: Mapping[str, Any]) -> Future[Message]:
        x, y = _place(request)
        return self.renderer.ask(lambda job: Message("pixel", pixel_facts(job.loop, self._layers_of(job), x, y)))

    def _layers_of(self, job: Job) -> dict[str, np.ndarray]:
        """The layers of a job's film, kept until its next step."""
        known = self._layers
        if known is None or known[0] is not job.loop or known[1] != job.loop.step_number:
            known = self._layers = (job.loop, job.loop.step_number, job.loop.film.layers())
        return known[2]


REQUESTS: dict[str, Callable[[Session, Mapping[str, Any]], Message | Future[Message] | None]] = {
    "set": Session._set,
    "focus": Session._focus,
    "move": Session._move,
    "reset": Session._reset,
    "undo": Session._undo,
    "mark": Session._mark,
    "render": Session._render,
    "save_picture": Session._save_picture,
    "save_scene": Session._save_scene,
}
"""Methods that follow the requests of the browser that steers."""


def _pair(request: Mapping[str, Any]) -> tuple[float, float]:
    """Finite numbers x and y of a request."""
    x, y = request.get("x"), request.get("y")
    if any(isinstance(each, bool) or not isinstance(each, (int, float)) or not abs(each) <= 1e3 for each in (x, y)):
        raise BokehguideError("x and y: give numbers, as fractions of the frame")
    return float(x), float(y)  # type: ignore[arg-type]


def _place(request: Mapping[str, Any]) -> tuple[float, float]:
    """A point of the frame in fractions, clamped to the frame."""
    x, y = _pair(request)
    return min(max(x, 0.0), 1.0), min(max(y, 0.0), 1.0)
