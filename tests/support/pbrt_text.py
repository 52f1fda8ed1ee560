"""Scenes of pbrt-v4 as texts."""

from __future__ import annotations

import gzip

import pytest

from bokehguide.errors import BokehguideError
from bokehguide.scene import load_scene
from bokehguide.scene.types import Scene

HEAD = 'Camera "perspective" "float fov" 90\nFilm "rgb" "integer xresolution" 32 "integer yresolution" 16\nWorldBegin\n'
SQUARE = 'Shape "trianglemesh" "point3 P" [-1 -1 4 1 -1 4 1 1 4 -1 1 4] "integer indices" [0 1 2 0 2 3]\n'


def read(folder, body: str, head: str = HEAD, name: str = "scene.pbrt") -> Scene:
    path = folder / name
    path.write_bytes((head + body).encode() if name.endswith(".pbrt") else gzip.compress((head + body).encode()))
    return load_scene(str(path))


def message(folder, body: str, head: str = HEAD) -> str:
    with pytest.raises(BokehguideError) as caught:
        read(folder, body, head)
    assert len(str(caught.value).splitlines()) <= 2
    return str(caught.value)
