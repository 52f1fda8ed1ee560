"""A render that runs elsewhere, followed by the file that it writes."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.color import LUMINANCE
from bokehguide.errors import BokehguideError
from bokehguide.image import Display, read_layers, to_8_bit
from bokehguide.image.views import VIEW_ATTRIBUTE
from bokehguide.limits import MAX_EXPOSURE, VIEWS
from bokehguide.render.film import NO_DEPTH
from bokehguide.scene.tables import EXPOSURE, Table
from bokehguide.view.pictures import data_image, png
from bokehguide.view.session import Message, Send

INTERVAL = 0.5
"""Seconds between two looks at the file."""
PATIENCE = 4
"""Looks after which a file that cannot be read is told; a file that is being written can be read soon."""
LAYERS = ("picture", "depth", "normal", "albedo", "emission", "variance")


@dataclass(frozen=True)
class Look:
    """How the file is shown. exposure, view: None for those in the file. denoise: whether to show the denoised layer."""

    exposure: float | None = None
    view: str | None = None
    denoise: bool = True
    layer: str = LAYERS[0]


class WatchedFile:
    """Shows an EXR of `bokehguide render`, and shows it again when it changes. The file need not exist yet."""

    def __init__(self, path: Path):
        self._path, self._look = path, Look()
        self._layers: dict[str, np.ndarray] = {}
        self._header: dict[str, Any] = {}
        self._seen: tuple[int, int] | None = None
        self._written = 0.0
        """Time at which the file was written, seconds since the epoch."""
        self._curve: list[tuple[int, float]] = []
        """Samples per pixel and estimated error of the files so far."""
        self._reason, self._failures = "", 0
        """Why the file cannot be read, and the number of looks that failed alike."""
        self._revision = 0
        self._greeted: Mapping[str, Any] = {}
        """The greeting that was sent last."""
        self._send: Send = lambda message: None
        self._lock, self._end = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="watcher", daemon=True)

    def start(self, send: Send) -> None:
        self._send = send
        self._thread.start()

    def close(self) -> None:
        self._end.set()
        self._thread.join()

    def watch(self, watched: bool) -> None:
        """The file is followed in any case: reading it is little work."""

    def greeting(self) -> list[Message]:
        with self._lock:
            return self._messages()

    def handle(self, request: Mapping[str, Any]) -> Message | None:
        kind = request.get("type")
        if kind == "hover":
            return self._pixel(request)
        name, value = request.get("name"), request.get("value")
        if kind != "set" or name not in CHOICES:
            raise BokehguideError("this page follows a render that runs elsewhere; its camera cannot be set here")
        with self._lock:
            self._look = CHOICES[name](self._look, value)
            self._revision += 1
            for message in self._messages()[1:]:
                self._send(message)
        return None

    def _run(self) -> None:
        while not self._end.wait(INTERVAL if self._seen or self._revision else 0.0):
            self._revision += 1
            with self._lock:
                if self._reload():
                    self._publish()
                elif self._failures == PATIENCE:
                    self._send(self._failure())

    def _publish(self) -> None:
        """Send the file; a greeting would make the controls of the page anew, so an equal one is left out."""
        greeting, *others = self._messages()
        for message in others if greeting.facts == self._greeted else [greeting, *others]:
            self._send(message)
        self._greeted = greeting.facts

    def _reload(self) -> bool:
        """Read the file if it has changed; returns whether it has. A file that is being replaced is read next time."""
        try:
            status = self._path.stat()
            seen = (status.st_mtime_ns, status.st_ino)
            if seen != self._seen:
                self._take(*read_layers(self._path))
                self._seen, self._written = seen, status.st_mtime
                self._reason, self._failures = "", 0
                return True
            reason = ""
        except FileNotFoundError:
            reason = f"{self._path.name}: the file is gone; the page keeps its last picture" if self._seen else ""
        except (OSError, BokehguideError) as error:
            reason = str(error)
        self._failures = self._failures + 1 if reason and reason == self._reason else int(bool(reason))
        self._reason = reason
        return False

    def _take(self, layers: dict[str, np.ndarray], header: dict[str, Any]) -> None:
        """Take another file. Raises BokehguideError for a file without a picture."""
        if "beauty" not in layers:
            raise BokehguideError(f"{self._path}: no channels R, G and B; watch an EXR of `bokehguide render`")
        if any(header.get(key) != self._header.get(key) for key in ("scene", "mode", "seed", "size")):
            self._curve = []  # another render
        self._layers, self._header = layers, header
        spp, error = self._spp(), self._error()
        self._curve = [each for each in self._curve if each[0] < spp]
        if error is not None:
            self._curve.append((spp, error))

    def _failure(self) -> Message:
        return Message("failure", {"failure": self._reason})

    def _messages(self) -> list[Message]:
        shown = [Message("hello", self._facts()), Message("state", self._state())]
        if self._failures >= PATIENCE:
            shown.append(self._failure())
        if "beauty" not in self._layers:
            return [*shown, Message("note", {"note": f"waiting for {self._path.name}"})]
        image, exposure = self._image()
        height, width = image.shape[:2]
        spp = self._spp()
        limit = max(spp, self._limit())
        facts = {"revision": self._revision, "width": width, "height": height, "reduction": 1.0, "spp": spp, "limit": limit}
        facts |= {"rendering": False, "done": spp == limit, "age": max(time.time() - self._written, 0.0)}
        facts |= {"error": self._error(), "curve": self._curve[-512:], "exposure": exposure}
        return [*shown, Message("picture", facts, png(image))]

    def _facts(self) -> dict[str, Any]:
        shape = self._layers["beauty"].shape if "beauty" in self._layers else (360, 640)
        layers = [name for name in LAYERS if name == "picture" or name in self._layers]
        facts = {"scene": self._path.name, "width": shape[1], "height": shape[0], "modes": [], "views": list(VIEWS)}
        return facts | {"layers": layers, "denoiser": "denoised" in self._layers, "environment": False, "follows": True}

    def _state(self) -> dict[str, Any]:
        look = self._look
        values = {
            "exposure": look.exposure,
            "view": self._display().view,
            "denoise": look.denoise and "denoised" in self._layers,
            "layer": look.layer,
        }
        values |= {"mode": str(self._header.get("mode", "")), "spp": self._spp()}
        command = str(self._header.get("command", ""))
        return {"revision": self._revision, "values": values, "command": command, "rendering": False, "marked": False}

    def _spp(self) -> int:
        """Samples per pixel of the file, 0 where the file does not tell."""
        spp = self._header.get("spp")
        return spp if isinstance(spp, int) else 0

    def _limit(self) -> int:
        """Samples per pixel at which the render ends, 0 where the file does not tell."""
        try:
            spp = json.loads(self._header["settings"])["spp"]
        except (KeyError, TypeError, ValueError, RecursionError):
            return 0
        return spp if isinstance(spp, int) else 0

    def _display(self) -> Display:
        stored, view = self._header.get("exposure"), self._header.get(VIEW_ATTRIBUTE)
        known = isinstance(stored, float) and abs(stored) <= MAX_EXPOSURE
        exposure = self._look.exposure if self._look.exposure is not None else stored if known else None
        return Display(exposure, self._look.view or (view if view in VIEWS else VIEWS[0]))

    def _radiance(self) -> np.ndarray:
        denoised = self._layers.get("denoised") if self._look.denoise else None
        return self._layers["beauty"] if denoised is None else denoised

    def _image(self) -> tuple[np.ndarray, float]:
        """The picture or layer that is chosen, uint8 `[H, W, 3]`, and the exposure."""
        radiance = self._radiance()
        display = self._display().metered(radiance, self._layers.get("alpha"))
        if self._look.layer == "picture" or self._look.layer not in self._layers:
            return to_8_bit(display.show(radiance)), display.exposure or 0.0
        return data_image(self._look.layer, self._layers), display.exposure or 0.0

    def _error(self) -> float | None:
        """Estimated relative error of the file's picture, as `Film.relative_noise`; None for a single sample."""
        if "variance" not in self._layers or self._spp() < 2:
            return None
        mean = (self._layers["beauty"] @ LUMINANCE).clip(min=0.0)
        return float((np.sqrt(self._layers["variance"].clip(min=0.0)) / (mean + 0.01)).mean())

    def _pixel(self, request: Mapping[str, Any]) -> Message | None:
        x, y = request.get("x"), request.get("y")
        with self._lock:
            if "beauty" not in self._layers or not (isinstance(x, (int, float)) and isinstance(y, (int, float))):
                return None
            height, width = self._layers["beauty"].shape[:2]
            column, row = (min(max(int(at * size), 0), size - 1) for at, size in ((x, width), (y, height)))
            values = {name: np.asarray(layer[row, column], np.float64).tolist() for name, layer in self._layers.items()}
        depth = values.pop("depth", None)
        values["depth"] = depth if depth is not None and depth < 0.5 * NO_DEPTH else None
        return Message("pixel", {"pixel": [column, row], "reduced": [width, height], **values})


def _exposure(look: Look, value: Any) -> Look:
    table = Table({"exposure": value}, "page", "", ("exposure",))
    return replace(look, exposure=None if value is None else table.number("exposure", None, EXPOSURE))


def _chosen(name: str, known: tuple[object, ...]) -> Callable[[Look, Any], Look]:
    """A choice of one of some values."""

    def choose(look: Look, value: Any) -> Look:
        if not isinstance(value, (str, bool)) or value not in known:
            raise BokehguideError(f"{name}: {str(value)[:40]!r} is unknown; choose one of {', '.join(map(str, known))}")
        return replace(look, **{name: value})

    return choose


CHOICES: dict[str, Callable[[Look, Any], Look]] = {
    "exposure": _exposure,
    "view": _chosen("view", VIEWS),
    "denoise": _chosen("denoise", (True, False)),
    "layer": _chosen("layer", LAYERS),
}
"""Functions that change one value of a `Look`."""
