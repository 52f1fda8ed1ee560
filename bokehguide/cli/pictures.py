"""The images of `bokehguide render`: PATH.exr and PATH.png, during the render and at its end."""

from __future__ import annotations

import argparse
import shlex
import sys
from dataclasses import fields
from pathlib import Path

from bokehguide.errors import BokehguideError
from bokehguide.image import tone_map, write_exr, write_png
from bokehguide.render import Film
from bokehguide.scene import Overrides
from bokehguide.train import AdaptiveLoop, RenderLoop, describe_render
from bokehguide.train.adaptive import HalvesFilm

OVERRIDES = tuple(field.name for field in fields(Overrides) if field.name not in ("width", "height"))


class Pictures:
    """Writes the images of one render. path: the EXR; the PNG goes beside it."""

    def __init__(self, path: Path, options: argparse.Namespace):
        self.path, self.png, self._options = path, path.with_suffix(".png"), options

    def write(self, loop: RenderLoop | AdaptiveLoop, picture: Film | HalvesFilm) -> None:
        """Write the EXR with its metadata, and the PNG. Raises BokehguideError if they cannot be written."""
        facts = describe_render(loop.scene, loop.settings, loop.step_number)
        facts |= {"command": command_line(self._options, loop.step_number)}
        frame = (loop.camera.width, loop.camera.height)
        write_exr(self.path, picture.layers(), facts, corner=picture.corner, frame=frame)
        write_png(self.png, tone_map(picture.radiance(), self._options.exposure))

    def refresh(self, loop: RenderLoop | AdaptiveLoop) -> None:
        """Write the images so far; collective. Warns if they cannot be written, as the render can still succeed."""
        picture = loop.picture()
        if loop.ranks.first:
            try:
                self.write(loop, picture)
            except BokehguideError as error:
                print(f"bokehguide: warning: {error}", file=sys.stderr)


def command_line(options: argparse.Namespace, spp: int) -> str:
    """The command that renders this image again."""
    size = {"size": "x".join(map(str, options.size))} if options.size else {}
    names = ("mode", "reuse_radius", "seed", "device", "exposure", "crop", "target_noise", *OVERRIDES)
    kept = {name: getattr(options, name) for name in names}
    words = ["bokehguide", "render", options.scene]
    for name, value in (kept | size | {"spp": spp}).items():
        if value is not None:
            text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
            words.append(f"--{name.replace('_', '-')}={text}")
    return shlex.join(words + ["--allow-outside"] * options.allow_outside)
