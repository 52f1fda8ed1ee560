"""The light groups of a scene: which emitters each group has."""

from __future__ import annotations

from dataclasses import dataclass

from bokehguide.errors import BokehguideError
from bokehguide.limits import MAX_LIGHT_GROUPS
from bokehguide.scene.types import Scene

UNGROUPED = "ungrouped"
"""Name of the group of all emitters without a group."""


@dataclass(frozen=True)
class LightGroups:
    """The groups of a scene by index.

    names: of the groups in the order of the materials, suns and environment, then UNGROUPED, where an emitter has no group.
    materials: group of each material, 0 for materials that emit nothing. suns: group of each sun. environment: group of the map,
    0 without one.
    """

    names: tuple[str, ...]
    materials: tuple[int, ...]
    suns: tuple[int, ...]
    environment: int


def find_light_groups(scene: Scene) -> LightGroups:
    """The light groups of a scene. Raises BokehguideError for a scene without groups, and for too many groups."""
    used = {mesh.material for mesh in scene.meshes}
    materials = [
        each.light_group or UNGROUPED if each.emits and number in used else "" for number, each in enumerate(scene.materials)
    ]
    suns = [sun.light_group or UNGROUPED for sun in scene.suns]
    sky = [] if scene.environment is None else [scene.environment.light_group or UNGROUPED]
    named = dict.fromkeys(name for name in (*materials, *suns, *sky) if name)
    names = sorted(named, key=lambda name: name == UNGROUPED)
    if names in ([], [UNGROUPED]):
        raise BokehguideError(
            f'light groups: no light of {scene.name} has a group; give a light or a material one, as in group = "lamps"'
        )
    if len(names) > MAX_LIGHT_GROUPS:
        raise BokehguideError(f"light groups: {scene.name} has {len(names)}; give at most {MAX_LIGHT_GROUPS}")
    place = {name: number for number, name in enumerate(names)} | {"": 0}
    return LightGroups(
        tuple(names), tuple(map(place.__getitem__, materials)), tuple(map(place.__getitem__, suns)), place[sky[0]] if sky else 0
    )
