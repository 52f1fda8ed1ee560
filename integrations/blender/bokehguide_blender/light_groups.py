"""The light groups of a view layer. Needs no Blender at import."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .messages import listed

if TYPE_CHECKING:
    import bpy

MOST = 31
"""Groups of a view layer that bokehguide keeps apart; one more has all other lights."""


class LightGroups:
    """The groups of a view layer, under names that scene files allow."""

    def __init__(self, names: list[str]):
        self._keys = {name: f"group_{number}" for number, name in enumerate(names[:MOST])}
        self._left_out = names[MOST:]

    @classmethod
    def of(cls, layer: bpy.types.ViewLayer) -> LightGroups:
        return cls([group.name for group in layer.lightgroups])

    @property
    def passes(self) -> dict[str, str]:
        """Names of the passes, as in Cycles, by the names of scene files."""
        return {key: f"Combined_{name}" for name, key in self._keys.items()}

    @property
    def warnings(self) -> list[str]:
        names = self._left_out
        return [f"light groups beyond the first {MOST} have no pass: {listed(names)}"] if names else []

    def key(self, name: str) -> str:
        """The name in a scene file, empty for a light without a group of the view layer."""
        return self._keys.get(name, "")

    def entry(self, item: bpy.types.Object | bpy.types.World) -> dict[str, Any]:
        """The key `group` of the table of a light or a world."""
        key = self.key(item.lightgroup)
        return {"group": key} if key else {}
