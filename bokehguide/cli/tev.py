"""Live pictures of a render in the image viewer tev, over tev's TCP protocol."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack
from types import ModuleType

import numpy as np

from bokehguide.cli.terminal import say
from bokehguide.errors import BokehguideError, reason

CHANNELS = {"beauty": ("R", "G", "B"), "denoised": ("denoised.R", "denoised.G", "denoised.B")}
"""Channels in tev by layer."""
INTERVAL = 1.0
"""Least number of seconds from one picture to the next."""
SHARE = 0.02
"""Largest share of the render's time that the pictures take."""
PATIENCE = 3.0
"""Longest wait for the last picture, seconds."""


def require_client() -> ModuleType:
    """The module `tevclient`. Raises BokehguideError where it is not installed."""
    try:
        import tevclient  # pyright: ignore[reportMissingImports]  # an extra
    except ImportError as error:
        raise BokehguideError(f"--tev: needs tev's client ({error}); pip install 'bokehguide[tev]'") from None
    return tevclient


class TevViewer:
    """Sends the pictures of one render to tev. A thread connects and sends, so that the render never waits for tev.

    The thread sends only the latest picture of each layer. The first failure ends the connection, and one line on stderr tells
    it.

    address: host and port. title: name of the picture in tev. size: width and height in pixels. denoised: whether the picture has
    denoised channels.
    """

    def __init__(self, address: tuple[str, int], title: str, size: tuple[int, int], denoised: bool):
        self._client, self._address, self._title, self._size = require_client(), address, title, size
        self._layers = {name: channels for name, channels in CHANNELS.items() if denoised or name == "beauty"}
        self._changed = threading.Condition()
        self._waiting: dict[str, np.ndarray] = {}
        self._sending = True
        """Whether the thread connects, sends, or has pictures to send."""
        self._ended = False
        self._failure: Exception | None = None
        self._told = False
        self._next = 0.0
        threading.Thread(target=self._run, name="tev", daemon=True).start()

    def due(self) -> bool:
        """Whether tev should get a new picture now. Tells a failure."""
        self._tell()
        with self._changed:
            return not (self._sending or self._ended) and time.monotonic() >= self._next

    def show(self, layers: Mapping[str, np.ndarray], seconds: float = 0.0) -> None:
        """Hand over layers float32 `[H, W, 3]` by the keys of CHANNELS; others are ignored. seconds: that their making took."""
        self._next = time.monotonic() + max(INTERVAL, seconds / SHARE)
        with self._changed:
            if not self._ended:
                self._waiting |= {name: layers[name] for name in self._layers if name in layers}
                self._sending = True
                self._changed.notify_all()

    def finish(self) -> None:
        """Wait until tev has the last picture, PATIENCE at most, and end the connection."""
        with self._changed:
            complete = self._changed.wait_for(lambda: self._ended or not self._sending, PATIENCE)
            if not complete:
                self._failure = TimeoutError("no answer in time")
            self._ended = True
            self._changed.notify_all()
        self._tell()

    def _tell(self) -> None:
        if self._failure is not None and not self._told:
            self._told = True
            host, port = self._address
            why = getattr(self._failure, "strerror", None) or reason(self._failure)
            say(f"warning: --tev: {host}:{port} takes no pictures ({why}); the render goes on; check that tev runs there")

    def _run(self) -> None:
        try:
            with ExitStack() as stack:
                tev = stack.push(self._client.Ipc(*self._address))  # ends its socket where the next line fails, too
                tev.__enter__()
                channels = [name for names in self._layers.values() for name in names]
                tev.create_image(self._title, *self._size, channels, grab_focus=True)
                while (layers := self._taken()) is not None:
                    for name, image in layers.items():
                        tev.update_image(self._title, image, list(CHANNELS[name]))
        except (OSError, ValueError) as error:  # ValueError: of a host name that is none
            self._failure = self._failure or error
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _taken(self) -> dict[str, np.ndarray] | None:
        """The next pictures to send, None at the end."""
        with self._changed:
            self._sending = bool(self._waiting)
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._waiting or self._ended)
            taken, self._waiting = self._waiting, {}
            return None if self._ended and not taken else taken
