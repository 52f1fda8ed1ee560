"""The render engine."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import bpy

from .light_groups import LightGroups
from .messages import Cancelled, RenderError
from .passes import MATTES, Passes, passes_of
from .preferences import interpreter
from .process import ProcessError, Render
from .scene_export import Exported, export_scene
from .viewport import Viewport

BUILT_IN = {"Combined", "Depth", "Normal"}
"""Passes that Blender makes by itself."""
POLL = 0.1
"""Seconds between two checks for a cancellation."""


class BokehguideEngine(bpy.types.RenderEngine):
    """Renders the scene by bokehguide in another process."""

    bl_idname = "BOKEHGUIDE"
    bl_label = "Bokehguide"
    bl_use_eevee_viewport = True
    bl_use_postprocess = True
    bl_use_shading_nodes_custom = False

    _viewport: Viewport | None = None

    def __del__(self) -> None:
        """Called when a viewport leaves Rendered shading, and when Blender ends."""
        # Blender has removed its own data of the engine by now, and refuses access to all attributes.
        viewport = object.__getattribute__(self, "_viewport")
        if viewport is not None:
            viewport.close()
        getattr(super(), "__del__", lambda: None)()  # from Blender 4.4 on

    def view_update(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Take note of changes of the scene in a viewport."""
        if self._viewport is None or self._viewport.closed:
            try:
                self._viewport = Viewport(context.area.as_pointer())
            except ProcessError as error:
                self.update_stats("", f"Bokehguide: {error}")
                return
        self._viewport.scene.note(depsgraph)

    def view_draw(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Draw a viewport."""
        if self._viewport is None:
            return
        self.update_stats("", self._viewport.status)
        self.bind_display_space_shader(depsgraph.scene)
        self._viewport.draw(context, depsgraph, int(self.get_preview_pixel_size(depsgraph.scene)))
        self.unbind_display_space_shader()

    def update_render_passes(self, scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> None:
        """Tell Blender which passes a render delivers."""
        for each in passes_of(scene, layer, LightGroups.of(layer).passes):
            self.register_pass(scene, layer, each.name, len(each.channels), each.channels, each.content)

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        """Render one view layer. A mistake of the user is told in Blender and ends the render."""
        try:
            with tempfile.TemporaryDirectory(prefix="bokehguide-") as folder:
                self.update_stats("", "Exporting the scene")
                exported = export_scene(self, depsgraph, Path(folder))
                for warning in exported.warnings:
                    self.report({"WARNING"}, warning)
                self._run(exported, Path(folder), depsgraph.scene, depsgraph.view_layer)
        except Cancelled:
            return
        except (RenderError, ProcessError) as error:
            self.report({"ERROR"}, f"Bokehguide: {error}")

    def _run(self, exported: Exported, folder: Path, scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> None:
        """Render a scene file and show the pictures. Raises RenderError, ProcessError and Cancelled."""
        names = exported.groups.passes
        for each in passes_of(scene, layer, names):
            if each.name not in BUILT_IN:
                self.add_pass(each.name, len(each.channels), each.channels, layer=layer.name)
        passes = Passes(self, layer.name, exported.framing.window[2:], not scene.render.film_transparent, names)
        with Render(interpreter(), exported.path, folder, layer.name, _options(scene, layer, exported)) as process:
            while (message := process.message(POLL)) is not None:
                if is_cancelled(self):
                    raise Cancelled
                self._show(message, passes)
            failure = process.failure()
        if failure is not None:
            raise RenderError(failure)

    def _show(self, message: dict[str, Any], passes: Passes) -> None:
        """Show one message of the driver. Raises RenderError for an error."""
        if "error" in message:
            raise RenderError(message["error"])
        if "warning" in message:
            self.report({"WARNING"}, message["warning"])
        elif "picture" in message:
            passes.show(Path(message["picture"]))
        elif "metadata" in message:
            passes.describe(message["metadata"])
        elif "step" in message:
            self.update_progress(message["step"] / message["of"])
            self.update_stats("", f"Sample {message['step']}/{message['of']}")
        elif "stage" in message:
            self.update_stats("", message["stage"])


def is_cancelled(engine: bpy.types.RenderEngine) -> bool:
    """Whether the user has ended the render."""
    return engine.test_break()


def _options(scene: bpy.types.Scene, layer: bpy.types.ViewLayer, exported: Exported) -> dict[str, Any]:
    """The options of `bokehguide.render`."""
    settings, framing = scene.bokehguide, exported.framing
    options: dict[str, Any] = {"spp": settings.samples, "seed": settings.seed, "denoise": settings.use_denoise}
    if settings.time_limit > 0.0:
        options["time_limit"] = settings.time_limit
    if framing.cropped:
        options["crop"] = framing.window
    if exported.has_groups:
        options["light_groups"] = True
    if any(getattr(layer, setting) for setting in MATTES):
        options["cryptomatte"] = True
    if scene.render.threads_mode == "FIXED":
        options["threads"] = scene.render.threads
    return options


def register() -> None:
    bpy.utils.register_class(BokehguideEngine)


def unregister() -> None:
    bpy.utils.unregister_class(BokehguideEngine)
