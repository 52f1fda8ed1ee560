"""Bokehguide as a render engine of Blender."""

from __future__ import annotations

from . import engine, panels, preferences, properties

MODULES = (properties, preferences, panels, engine)


def register() -> None:
    for module in MODULES:
        module.register()


def unregister() -> None:
    for module in reversed(MODULES):
        module.unregister()
