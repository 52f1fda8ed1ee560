"""Names of the objects and materials of a scene, one for each mesh and each material."""

from __future__ import annotations

from bokehguide.scene.types import Scene


def object_names(scene: Scene) -> list[str]:
    """The name of the object of each mesh; meshes of one object have one name. "mesh 3" stands for a missing name."""
    return [mesh.name or f"mesh {number}" for number, mesh in enumerate(scene.meshes)]


def material_names(scene: Scene) -> list[str]:
    """The name of each material, "material 3" for a missing name."""
    return [material.name or f"material {number}" for number, material in enumerate(scene.materials)]
