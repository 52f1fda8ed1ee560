"""Time from a drag to a new picture on the page of `bokehguide view`: median and 95 %.

    scripts/view_drag.py SCENE --size 640x360 --drags 12

plays the page's side of the socket: a move every 16 ms during a drag, which waits while an earlier move is on its way. A drag
lasts 1.5 s, and a pause 0.2 to 3 s. The time of a move ends when a picture of its state, or of a later state, has arrived. The
page then takes some 10 ms to show the picture. With --first, only the first move of each drag counts.
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import statistics
import struct
import subprocess
import sys
import time
from collections import deque

from websockets.sync.client import ClientConnection, connect

FRAME, LONG = 0.016, 1.5


class Dragger:
    """Plays drags, and measures them. waits: state and time of each move without a picture; times: seconds of the others."""

    def __init__(self, socket: ClientConnection):
        self.socket = socket
        self.state = 0
        self.asked: deque[float] = deque()
        self.waits: list[tuple[int, float]] = []
        self.times: list[float] = []

    def receive(self, until: float) -> None:
        """Receive messages up to a time."""
        while (left := until - time.monotonic()) > 0.0:
            try:
                data = self.socket.recv(timeout=left)
            except TimeoutError:
                return
            if isinstance(data, bytes):
                (length,) = struct.unpack("<I", data[:4])
                data = data[4 : 4 + length].decode()
            facts, now = json.loads(data), time.monotonic()
            if facts["type"] == "state":
                self.state = facts["revision"]
                if self.asked:
                    self.waits.append((self.state, self.asked.popleft()))
            elif facts["type"] == "picture":
                self.times += [now - begun for state, begun in self.waits if state <= facts["revision"]]
                self.waits = [each for each in self.waits if each[0] > facts["revision"]]

    def drag(self, count: int) -> None:
        """One drag of `count` moves."""
        for number in range(count):
            frame = time.monotonic() + FRAME
            if not self.asked:
                self.asked.append(time.monotonic())
                self.socket.send(json.dumps({"type": "move", "kind": "orbit", "x": 0.004 * (-1) ** (number // 40), "y": 0.0}))
            self.receive(frame)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default="fairy-lights")
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--drags", type=int, default=12)
    parser.add_argument("--first", action="store_true", help="count the first move of each drag alone")
    options = parser.parse_args()
    command = [sys.executable, "-m", "bokehguide", "view", options.scene, "--port=0", "--no-browser", "--size", options.size]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        assert server.stdout
        address = server.stdout.readline().split()[0].replace("http:", "ws:") + "socket"
        dice = random.Random(0)
        try:
            with connect(address, max_size=None) as socket:
                dragger = Dragger(socket)
                dragger.receive(time.monotonic() + 5.0)
                for _ in range(options.drags):
                    dragger.drag(1 if options.first else int(LONG / FRAME))
                    dragger.receive(time.monotonic() + dice.uniform(0.2, 3.0))
        finally:
            server.send_signal(signal.SIGINT)
    times = sorted(1e3 * each for each in dragger.times)
    tail = times[min(int(0.95 * len(times)), len(times) - 1)]
    figures = f"median {statistics.median(times):.0f} ms, 95 % {tail:.0f} ms, max {times[-1]:.0f} ms"
    print(f"{options.scene}: {len(times)} moves, {figures}")


if __name__ == "__main__":
    main()
