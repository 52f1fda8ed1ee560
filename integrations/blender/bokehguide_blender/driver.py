"""Renders one scene. Runs in the Python environment of bokehguide, without Blender: `python driver.py JOB.json`.

The job: `scene`, the path of a scene file; `folder` for pictures; `options` of `bokehguide.render`. stdout gets one JSON object
per line: `stage`, `warning`, `step` with `of`, `picture` with a path, `metadata`, or `error`. A picture is an .npz file with the
layers of `bokehguide.Picture`, those of mattes and light groups among them; the reader removes it. `metadata` describes the
Cryptomatte layers, whose names begin with the job's `layer`.
"""

from __future__ import annotations

import json
import logging
import sys
import time
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

INTERVAL, SHARE = 1.0, 10.0
"""Seconds from one picture to the next: at least so many, and so many times the time that a picture takes."""
STEP_INTERVAL = 0.1
"""Seconds from one told step to the next."""
LAYERS = ("beauty", "alpha", "depth", "normal", "albedo", "denoised")


def tell(**fields: object) -> None:
    """Write one line to stdout. Threads may write at the same time."""
    sys.stdout.write(json.dumps(fields) + "\n")
    sys.stdout.flush()


class Stages(logging.Handler):
    """Tells the log of bokehguide."""

    def emit(self, record: logging.LogRecord) -> None:
        warning = record.levelno >= logging.WARNING
        tell(**{"warning" if warning else "stage": record.getMessage()})


def start(*modules: str) -> bool:
    """Import modules of bokehguide and tell its log; returns whether they can be imported."""
    tell(stage="starting")
    try:
        for name in modules:
            import_module(name)
    except ImportError as error:
        tell(error=f"{sys.executable}: bokehguide cannot be imported ({error}); install it from the add-on's preferences")
        return False
    log = logging.getLogger("bokehguide")
    log.addHandler(Stages())
    log.setLevel(logging.INFO)
    return True


class Pictures:
    """Writes pictures into a folder now and then."""

    def __init__(self, folder: Path, spp: int):
        self._folder, self._spp = folder, spp
        self._due = self._step_due = 0.0
        self._number = 0

    def step(self, step: int, picture: Callable[[], Any]) -> None:
        """Tell a step, and write its picture if one is due. The last picture is written by the caller."""
        if time.monotonic() >= self._step_due:
            tell(step=step, of=self._spp)
            self._step_due = time.monotonic() + STEP_INTERVAL
        if time.monotonic() >= self._due and step < self._spp:
            start = time.monotonic()
            self.write(picture())
            now = time.monotonic()
            self._due = now + max(INTERVAL, SHARE * (now - start))

    def write(self, picture: Any) -> None:
        """Write a picture. The file appears only when it is complete."""
        import numpy as np

        self._number += 1
        path = self._folder / f"picture-{self._number}.npz"
        partial = path.with_suffix(".part")
        with partial.open("wb") as file:
            np.savez(file, **{name: layer for name in LAYERS if (layer := getattr(picture, name)) is not None}, **_named(picture))
        partial.replace(path)
        tell(picture=str(path), step=picture.metadata["spp"])


def _render(path: str, options: dict[str, Any], step: Callable[[int, Callable[[], Any]], None]) -> Any:
    """The `Picture` of a scene file. Raises BokehguideError, also where the memory does not suffice."""
    import bokehguide
    from bokehguide.cli.memory import check_memory, explained
    from bokehguide.scene import Overrides
    from bokehguide.train import RenderSettings

    with explained():
        scene = bokehguide.load_scene(path, Overrides(), allow_outside=True)
        check_memory(scene, RenderSettings(**{name: value for name, value in options.items() if name != "time_limit"}))
        for warning in (*scene.warnings, *scene.likely_mistakes):
            tell(warning=warning)
        return bokehguide.render(scene, on_step=step, quiet=True, **options)


def _named(picture: Any) -> dict[str, Any]:
    """The mattes under the names of Cryptomatte, such as `CryptoObject00`, and the light groups under their own."""
    from bokehguide.image.cryptomatte import CHANNELS

    mattes = {CHANNELS[key][0].partition(".")[0]: layer for key, layer in picture.mattes.items()}
    return mattes | dict(picture.light_groups)


def _metadata(attributes: dict[str, Any], layer: str) -> dict[str, str]:
    """The attributes of Cryptomatte layers, under their names in Blender: those of the EXR after the view layer's."""
    from bokehguide.image.cryptomatte import layer_key

    given = {name: str(value) for name, value in attributes.items() if name.startswith("cryptomatte/")}
    names = {key.removesuffix("name"): f"{layer}.{name}" for key, name in given.items() if key.endswith("/name")}
    found = {}
    for old, name in names.items():
        facts = {key.removeprefix(old): value for key, value in given.items() if key.startswith(old)} | {"name": name}
        found |= {f"{layer_key(name)}/{fact}": value for fact, value in facts.items()}
    return found


def main(job_path: str) -> int:
    """Render the job; returns the exit code, 2 for a mistake of the user."""
    job = json.loads(Path(job_path).read_text(encoding="utf-8"))
    if not start("bokehguide"):
        return 2
    import bokehguide

    warnings.showwarning = lambda message, *_, **__: tell(warning=str(message))
    warnings.simplefilter("always")
    pictures = Pictures(Path(job["folder"]), job["options"]["spp"])
    try:
        picture = _render(job["scene"], job["options"], pictures.step)
    except (bokehguide.BokehguideError, MemoryError) as error:
        reason = str(error).removeprefix(f"{job['scene']}: ").replace("--size", "the resolution")
        tell(error=reason or "the memory does not suffice; give a smaller resolution or fewer triangles")
        return 2
    pictures.write(picture)
    if picture.mattes:
        tell(metadata=_metadata(picture.metadata, job["layer"]))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
