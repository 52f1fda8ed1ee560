"""Renders a viewport as it moves. Runs in the environment of bokehguide, without Blender: `python preview_driver.py FOLDER`.

stdin gets one view per line, a JSON object: `scene`, the path of a scene file; `camera`, a `[camera]` table; `size` and `window`
of the frame in pixels; `spp`, `seed`, `denoise`, and `transparent`, whether pictures keep their alpha. The latest view counts.
stdout gets one JSON object per line: `stage`, `warning`, `failure` of a view, `error`, or `picture` with a path, `step` and `of`.
A picture is a .npy file of linear RGBA, bottom row first, which the reader removes. The end of stdin ends the process.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from driver import start, tell

if TYPE_CHECKING:
    from bokehguide.view.live import LivePicture, LiveView


class Requests:
    """The views from stdin, read from the start on, so that Blender never waits for a full pipe."""

    def __init__(self) -> None:
        self.latest: dict[str, Any] | None = None
        self.changed = threading.Event()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in sys.stdin:
            self.latest = json.loads(line)
            self.changed.set()
        os._exit(0)  # Blender has ended, or closed the viewport


class Pictures:
    """Writes pictures into a folder. A picture that has not been read by then makes place for the next."""

    def __init__(self, folder: Path):
        self._folder, self._last = folder, folder / "none"
        self._number = 0
        self.transparent = True

    def write(self, picture: LivePicture) -> None:
        import numpy as np

        self._number += 1
        pixels = picture.pixels[::-1]
        if not self.transparent:
            pixels = np.concatenate((pixels[..., :3], np.ones_like(pixels[..., :1])), axis=-1)
        with suppress(OSError):  # Windows keeps a file that is being read
            self._last.unlink(missing_ok=True)
        path = self._folder / f"view-{self._number}.npy"
        partial = path.with_suffix(".part")
        with partial.open("wb") as file:
            np.save(file, np.ascontiguousarray(pixels))
        partial.replace(path)
        self._last = path
        tell(picture=str(path), step=picture.step, of=picture.view.spp)


def view_of(request: dict[str, Any]) -> LiveView:
    """The view of a request. Raises BokehguideError for values out of range."""
    from bokehguide.scene.cameras import read_camera
    from bokehguide.scene.files import SceneFiles
    from bokehguide.view.live import LiveView

    camera = read_camera(request["camera"], "viewport", SceneFiles(Path(request["scene"]).parent))
    names = ("scene", "spp", "seed", "denoise")
    return LiveView(camera=camera, size=tuple(request["size"]), window=tuple(request["window"]), **{n: request[n] for n in names})


def main(folder: str) -> int:
    """Render the views from stdin; returns the exit code, 2 for a mistake of the user."""
    requests = Requests()
    if not start("bokehguide", "bokehguide.view.live"):
        return 2
    import bokehguide
    from bokehguide.view.live import Live

    pictures = Pictures(Path(folder))
    live = Live(pictures.write, lambda view, reason: tell(failure=reason))
    threading.Thread(target=live.run, daemon=True).start()
    while requests.changed.wait():
        requests.changed.clear()
        request = requests.latest
        assert request is not None
        try:
            view = view_of(request)
        except bokehguide.BokehguideError as error:
            tell(failure=str(error))
            continue
        pictures.transparent = request["transparent"]
        live.show(view)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
