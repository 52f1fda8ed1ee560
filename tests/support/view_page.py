"""A served page of `bokehguide view`, and a browser without a screen: the messages of its socket."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from websockets.sync.client import ClientConnection, connect

from bokehguide.scene import Overrides, load_scene
from bokehguide.view.server import ViewServer
from bokehguide.view.session import Session
from bokehguide.view.state import Source, ViewState

WAIT = 60.0
"""Seconds for a message on a loaded machine."""


@contextmanager
def served(spec: str, folder: Path, host: str = "127.0.0.1", **state: Any) -> Iterator[ViewServer]:
    """A server of the scene at `spec`. state: fields of `ViewState`."""
    overrides = state.pop("overrides", Overrides())
    source = Source(load_scene(spec, overrides), overrides, spec)
    server = ViewServer(Session(source, ViewState(overrides, **state), folder, denoiser=True, threads=2), host)
    server.start()
    try:
        yield server
    finally:
        server.close()


class Page:
    """One end of a page's socket. facts: of the latest message of each type; image: the latest picture, uint8 `[H, W, 3]`."""

    def __init__(self, connection: ClientConnection):
        self._connection = connection
        self.facts: dict[str, dict[str, Any]] = {}
        self.image = np.empty((0, 0, 3), np.uint8)

    def send(self, **request: Any) -> None:
        self.send_text(json.dumps(request))

    def send_text(self, text: str | bytes) -> None:
        self._connection.send(text)

    def close(self) -> None:
        self._connection.close()

    def receive(self) -> dict[str, Any]:
        """The next message."""
        data = self._connection.recv(timeout=WAIT)
        picture = b""
        if isinstance(data, bytes):
            (length,) = struct.unpack("<I", data[:4])
            data, picture = data[4 : 4 + length].decode(), data[4 + length :]
        facts = json.loads(data)
        self.facts[facts["type"]] = facts
        if facts["type"] == "picture":
            self.image = np.asarray(Image.open(BytesIO(picture)))
        return facts

    def until(self, kind: str, wanted: Callable[[dict[str, Any]], bool] = lambda facts: True) -> dict[str, Any]:
        """The next message of a type that is wanted."""
        while True:
            facts = self.receive()
            if facts["type"] == kind and wanted(facts):
                return facts

    def change(self, **request: Any) -> dict[str, Any]:
        """Send a request that leads to another state; returns the state."""
        before = self.facts["state"]["revision"]
        self.send(**request)
        return self.until("state", lambda facts: facts["revision"] > before)

    def rested(self) -> np.ndarray:
        """The exact picture of the present state."""
        revision = self.facts["state"]["revision"]
        self.until("picture", lambda facts: facts["exact"] and facts["revision"] >= revision)
        return self.image


@contextmanager
def opened(server: ViewServer, **options: Any) -> Iterator[Page]:
    """A page that has received its state and its role."""
    address = server.address.replace("http:", "ws:").replace("0.0.0.0", "127.0.0.1").replace("/?", "/socket?")
    address = address if "socket" in address else f"{address}socket"
    with connect(address, max_size=None, open_timeout=WAIT, **options) as connection:
        page = Page(connection)
        page.until("role")
        yield page
