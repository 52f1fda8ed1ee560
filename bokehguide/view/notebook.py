"""The page in a notebook: `bokehguide.view(scene)`."""

from __future__ import annotations

import html
import os
from pathlib import Path
from typing import Any, Self

from bokehguide.image.oidn import has_denoiser
from bokehguide.picture import require_known, size_pair
from bokehguide.scene import Overrides, Scene, load_scene
from bokehguide.scene.overrides import OVERRIDES
from bokehguide.train import RenderSettings
from bokehguide.view.server import ViewServer, require_websockets
from bokehguide.view.session import Session
from bokehguide.view.state import Source, ViewState, command_line

HEIGHT = 860
"""Height of the page in a notebook, pixels."""


class Page:
    """A page that is being served on this machine. As the last value of a notebook's cell, it shows the page in the cell.

    address: of the page, for a browser. The object is a context manager that ends the page.
    """

    def __init__(self, session: Session, height: int):
        self._session, self._height = session, height
        self._server = ViewServer(session)
        self._server.start()
        self.address = self._server.address

    @property
    def command(self) -> str:
        """The command that renders the picture of the page."""
        return command_line(self._session.state, self._session.source)

    @property
    def scene(self) -> Scene:
        """The scene with the camera and the lens of the page."""
        return self._session.source.scene_of(self._session.state.overrides)

    def close(self) -> None:
        """End the page and its work. A second call does nothing."""
        self._server.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _repr_html_(self) -> str:
        if self._server.closed:
            return f"<p>{html.escape(repr(self))}</p>"
        address = html.escape(self.address)
        return f'<iframe src="{address}" width="100%" height="{self._height}" style="border: 0" allow="clipboard-write"></iframe>'

    def __repr__(self) -> str:
        return "Page(closed)" if self._server.closed else f"Page({self.address!r})"


def view(
    scene: Scene | str | os.PathLike[str],
    mode: str = "guided",
    spp: int = 64,
    *,
    size: tuple[int, int] | None = None,
    height: int = HEIGHT,
    allow_outside: bool = False,
    **overrides: Any,
) -> Page:
    """Show a scene on a page on which its depth of field can be set; returns the page.

    scene, mode, size, allow_outside: as of `bokehguide.render`. spp: samples per pixel of a render that the page begins.
    height: of the page in a notebook's cell, pixels. overrides: fields of `Overrides`.

    Raises BokehguideError for input that is missing, malformed or out of range, and where the extra `view` is not installed.
    """
    require_websockets()
    require_known(view, overrides, OVERRIDES)
    width, tall = size_pair(size, "view")
    given = Overrides(width=width, height=tall, **overrides)
    RenderSettings(mode, spp=spp)
    loaded = load_scene(scene, given, allow_outside)
    source = Source(loaded, given, "" if isinstance(scene, Scene) else os.fspath(scene), allow_outside)
    denoise = has_denoiser()
    state = ViewState(given, mode, spp, exposure=loaded.film.exposure, denoise=denoise)
    return Page(Session(source, state, Path.cwd(), denoise), height)
