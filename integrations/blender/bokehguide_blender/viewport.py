"""The picture of a 3D viewport in Rendered shading. bokehguide renders it in another process."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from .camera import camera_table, read_lens
from .framing import projected
from .messages import RenderError
from .preferences import interpreter
from .process import Preview
from .texture import ViewportTexture
from .viewport_scene import ViewportScene

TICK = 0.05
"""Seconds between two looks at the messages of the process."""


class Viewport:
    """One viewport and its process. area: pointer of the area that shows it. Raises ProcessError where no process can start.

    status: what the user should know now.
    """

    def __init__(self, area: int):
        self.status = "Starting"
        self._area = area
        self._folder = tempfile.TemporaryDirectory(prefix="bokehguide-")
        self.process = Preview(interpreter(), Path(self._folder.name))
        self.scene = ViewportScene(Path(self._folder.name))
        self.texture = ViewportTexture()
        self._view: dict[str, Any] | None = None
        self.closed = False
        bpy.app.timers.register(self.tick, first_interval=0.0)

    def close(self) -> None:
        """End the process and remove its files."""
        if not self.closed:
            self.closed = True
            self.process.close()
            self._folder.cleanup()

    def draw(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph, pixel_size: int) -> None:
        """Draw the latest picture, and ask for another one where the view has changed. pixel_size: of a pixel of the picture."""
        region = context.region
        if self.scene.path is not None and not self.closed:
            size = max(1, region.width // pixel_size), max(1, region.height // pixel_size)
            self.show(view_request(context.space_data, context.region_data, depsgraph, size))
        self.texture.draw(region.width, region.height)

    def show(self, view: dict[str, Any]) -> None:
        """Render this view of the present scene, unless the process already does."""
        view = {"scene": str(self.scene.path), **view}
        if view != self._view:
            self._view = view
            self.process.show(view)

    def tick(self) -> float | None:
        """Look after the process and the scene; a timer calls it in the main thread.

        Returns the seconds to the next call, None at the end.
        """
        place = None if self.closed else find_area(self._area)
        if place is None:
            self.close()
            return None
        news = self._receive()
        if not self.closed and self.scene.due and not bpy.app.is_job_running("RENDER"):
            with bpy.context.temp_override(**place):
                news |= self._export(bpy.context)
        if news:
            place["area"].tag_redraw()
        return TICK

    def _export(self, context: bpy.types.Context) -> bool:
        """Export the scene; returns whether there is something to draw. The exporter would leave the mode of an object."""
        status = self.status
        if context.mode != "OBJECT":
            self.status = "The picture follows the scene in Object Mode"
            return self.status != status
        try:
            changed = self.scene.export(context.evaluated_depsgraph_get())
        except RenderError as error:
            self.status = str(error)
            return True
        if changed and self.scene.warnings:
            print(*(f"Bokehguide: {warning}" for warning in self.scene.warnings), sep="\n")
        return changed

    def _receive(self) -> bool:
        """Read the messages of the process; returns whether there is something to draw."""
        news, picture, message = False, None, {}
        while not self.closed and (message := self.process.message(0.0)):
            news = True
            picture = message.get("picture", picture)
            self.status = _status(message) or self.status
            if "error" in message:
                self.close()
        if message is None:
            self.status = f"Bokehguide: {self.process.failure()}"
            self.close()
        if picture is not None:
            try:
                self.texture.pixels = np.load(picture)
                Path(picture).unlink()
            except OSError:  # a newer picture has taken its place
                pass
        return news


def _status(message: dict[str, Any]) -> str | None:
    """What a message says to the user."""
    for key in ("error", "failure", "warning"):
        if key in message:
            return f"Bokehguide: {message[key]}"
    if "picture" in message:
        return f"Sample {message['step']}/{message['of']}" if message["step"] else "Coarse picture"
    return message.get("stage")


def view_request(
    space: bpy.types.SpaceView3D, region: bpy.types.RegionView3D, depsgraph: bpy.types.Depsgraph, size: tuple[int, int]
) -> dict[str, Any]:
    """The view of a 3D viewport as `preview_driver.py` takes it. size: of the picture in pixels."""
    scene = depsgraph.scene
    framing, back = projected([tuple(row) for row in region.window_matrix], size, region.view_distance)
    camera = camera_table(region.view_matrix.inverted(), framing.fov, back)
    looked_through = space.camera if region.view_perspective == "CAMERA" else None
    if looked_through is not None and looked_through.type == "CAMERA" and back == 0.0:
        camera |= read_lens(looked_through.evaluated_get(depsgraph), [])
    return {
        "camera": camera,
        "size": framing.size,
        "window": framing.window,
        "spp": scene.bokehguide.viewport_samples,
        "seed": scene.bokehguide.seed,
        "denoise": scene.bokehguide.use_denoise,
        "transparent": scene.render.film_transparent,
    }


def find_area(pointer: int) -> dict[str, Any] | None:
    """The window, the area and its main region of a viewport in Rendered shading; None where it is closed."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.as_pointer() == pointer and area.type == "VIEW_3D" and area.spaces.active.shading.type == "RENDERED":
                region = next(each for each in area.regions if each.type == "WINDOW")
                return {"window": window, "area": area, "region": region}
    return None
