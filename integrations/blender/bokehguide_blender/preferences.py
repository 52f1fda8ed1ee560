"""The preferences of the add-on, and the installation of bokehguide."""

from __future__ import annotations

import threading
from pathlib import Path

import bpy

from .installer import base_python, chosen_source, environment_python, install
from .process import ProcessError

INTERVAL = 0.5
"""Seconds between two updates of the installation's last line."""


class BokehguidePreferences(bpy.types.AddonPreferences):
    """Where bokehguide is installed."""

    bl_idname = __package__

    python: bpy.props.StringProperty(
        name="Python", description="Interpreter of an environment with bokehguide; empty: the installed one", subtype="FILE_PATH"
    )
    source: bpy.props.StringProperty(
        name="Source",
        description="Folder of bokehguide's repository, or a wheel; empty: the bundled sources",
        subtype="FILE_PATH",
    )
    base: bpy.props.StringProperty(
        name="Base Python",
        description="Python 3.11 or newer that makes the environment; empty: the system's",
        subtype="FILE_PATH",
    )

    def draw(self, _context: bpy.types.Context) -> None:
        python = Path(interpreter())
        row = self.layout.row()
        row.label(text=f"Environment: {python if python.is_file() else 'not installed'}")
        row.operator(InstallBokehguide.bl_idname)
        if InstallBokehguide.line:
            self.layout.label(text=InstallBokehguide.line)
        for name in ("python", "source", "base"):
            self.layout.prop(self, name)


class InstallBokehguide(bpy.types.Operator):
    """Install bokehguide and its dependencies into an environment of the add-on; takes minutes and about 6 GB"""

    bl_idname = "bokehguide.install"
    bl_label = "Install"

    line = ""
    """The last line of the installation."""
    _thread: threading.Thread | None = None
    _error: str | None = None

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Install and wait for the end."""
        self._start()
        InstallBokehguide._thread.join()
        return self._finish()

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Install in the background."""
        if InstallBokehguide._thread is not None and InstallBokehguide._thread.is_alive():
            self.report({"INFO"}, "the installation is in progress")
            return {"CANCELLED"}
        self._start()
        self._timer = context.window_manager.event_timer_add(INTERVAL, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Show the last line, and the result at the end."""
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        for area in context.screen.areas if context.screen else ():
            area.tag_redraw()
        if InstallBokehguide._thread.is_alive():
            return {"PASS_THROUGH"}
        context.window_manager.event_timer_remove(self._timer)
        return self._finish()

    def _start(self) -> None:
        """Begin the installation in a thread. The thread touches no data of Blender."""
        own = preferences()
        InstallBokehguide._error = None
        arguments = own.base, own.source, environment_folder()
        InstallBokehguide._thread = threading.Thread(target=_install, args=arguments, daemon=True)
        InstallBokehguide._thread.start()

    def _finish(self) -> set[str]:
        """Report the result."""
        if InstallBokehguide._error is not None:
            self.report({"ERROR"}, InstallBokehguide._error)
            return {"CANCELLED"}
        self.report({"INFO"}, InstallBokehguide.line)
        return {"FINISHED"}


def _install(base: str, source: str, folder: Path) -> None:
    """Install bokehguide, in a thread of its own."""

    def tell(line: str) -> None:
        InstallBokehguide.line = line

    try:
        install(base_python(base), folder, chosen_source(source), tell)
    except (ProcessError, OSError) as error:
        InstallBokehguide._error = InstallBokehguide.line = str(error)


def preferences() -> BokehguidePreferences:
    return bpy.context.preferences.addons[__package__].preferences


def interpreter() -> str:
    """The interpreter that renders: the chosen one, else that of the add-on's environment."""
    chosen = preferences().python
    return bpy.path.abspath(chosen) if chosen else str(environment_python(environment_folder()))


def environment_folder() -> Path:
    """The folder of the add-on's environment. An extension has a folder for its files; other add-ons share one."""
    try:
        return Path(bpy.utils.extension_path_user(__package__, path="environment"))
    except ValueError:
        return Path(bpy.utils.user_resource("DATAFILES", path="bokehguide")) / "environment"


CLASSES = (InstallBokehguide, BokehguidePreferences)


def register() -> None:
    for each in CLASSES:
        bpy.utils.register_class(each)


def unregister() -> None:
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
