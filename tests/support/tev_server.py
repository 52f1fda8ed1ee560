"""A server that takes pictures by tev's protocol.

A packet is its length in bytes (uint32), an operation (byte) and the operation's fields, all little-endian. A zero ends a string.
"""

from __future__ import annotations

import socket
import struct
import threading
from dataclasses import dataclass, field
from typing import Self

import numpy as np

CREATE, UPDATE = 4, 6


class _Fields:
    """The fields of a packet, one after the other."""

    def __init__(self, data: bytes):
        self._data = data

    def numbers(self, form: str, count: int = 1) -> list[int]:
        size = struct.calcsize(f"<{count}{form}")
        found, self._data = struct.unpack(f"<{count}{form}", self._data[:size]), self._data[size:]
        return list(found)

    def text(self) -> str:
        text, _, self._data = self._data.partition(b"\0")
        return text.decode()

    def texts(self, count: int) -> list[str]:
        return [self.text() for _ in range(count)]

    def rest(self) -> np.ndarray:
        return np.frombuffer(self._data, "<f4")


@dataclass
class TevServer:
    """Listens on a free port of 127.0.0.1 for one connection.

    images: channels `[H, W]` by name, by the name of the picture. updates: of a channel so far, by (picture, channel). reads:
    False for a server that accepts and then stops reading. dies_after: number of packets after which the server closes the
    connection.
    """

    reads: bool = True
    dies_after: int | None = None
    images: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    updates: dict[tuple[str, str], int] = field(default_factory=dict)
    created: int = 0
    history: list[tuple[str, np.ndarray]] = field(default_factory=list)
    """Each update's channel and its pixels `[h, w]`, in order."""

    def __enter__(self) -> Self:
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listening.getsockname()[1]}"
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._listening.shutdown(socket.SHUT_RDWR)  # ends an `accept` that waits
        self._listening.close()
        self._thread.join()

    def wait(self) -> None:
        """Wait until the connection has ended."""
        self._thread.join(20.0)
        assert not self._thread.is_alive()

    def _serve(self) -> None:
        try:
            connection, _ = self._listening.accept()
        except OSError:
            return
        with connection:
            if not self.reads:
                self._done.wait()
                return
            packets = 0
            with connection.makefile("rb") as stream:
                while packets != self.dies_after and (header := stream.read(4)):
                    (length,) = struct.unpack("<I", header)
                    self._take(stream.read(length - 4))
                    packets += 1

    def _take(self, packet: bytes) -> None:
        fields = _Fields(packet)
        operation, _grab_focus = fields.numbers("b", 2)
        name = fields.text()
        if operation == CREATE:
            self.created += 1
            width, height, count = fields.numbers("i", 3)
            self.images[name] = {channel: np.zeros((height, width), np.float32) for channel in fields.texts(count)}
        elif operation == UPDATE:
            self._update(name, fields)
        else:
            raise ValueError(f"operation {operation}")

    def _update(self, name: str, fields: _Fields) -> None:
        (count,) = fields.numbers("i")
        channels = fields.texts(count)
        x, y, width, height = fields.numbers("i", 4)
        offsets, strides = fields.numbers("q", count), fields.numbers("q", count)
        data = fields.rest()
        for channel, offset, stride in zip(channels, offsets, strides):
            pixels = data[offset::stride][: width * height].reshape(height, width)
            self.images[name][channel][y : y + height, x : x + width] = pixels
            self.updates[name, channel] = self.updates.get((name, channel), 0) + 1
            self.history.append((channel, pixels.copy()))
