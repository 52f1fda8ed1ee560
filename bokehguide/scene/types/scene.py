"""Whole scenes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from bokehguide.scene.checks import FieldError, Fields
from bokehguide.scene.types.camera import Camera
from bokehguide.scene.types.film import FilmSettings, Inset
from bokehguide.scene.types.lights import Environment, Sun
from bokehguide.scene.types.material import Material
from bokehguide.scene.types.mesh import Mesh


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that a render needs.

    warnings: unsupported features of the input, one a line. supported: imported features of its
    models, one a line. likely_mistakes: values that the user may not have meant, one a line.
    files: resolved paths of the files that the scene was read from.
    """

    name: str
    camera: Camera
    meshes: tuple[Mesh, ...]
    materials: tuple[Material, ...]
    film: FilmSettings = FilmSettings()
    environment: Environment | None = None
    suns: tuple[Sun, ...] = ()
    insets: tuple[Inset, ...] = ()
    description: str = ""
    warnings: tuple[str, ...] = field(default=())
    supported: tuple[str, ...] = ()
    likely_mistakes: tuple[str, ...] = ()
    files: frozenset[Path] = frozenset()

    def __post_init__(self) -> None:
        fields = Fields(self)
        fields.check_texts("name", "description")
        fields.check_instances(Camera, "camera", optional=False)
        fields.check_instances(FilmSettings, "film", optional=False)
        fields.check_instances(Environment, "environment")
        for key, kind in {"meshes": Mesh, "materials": Material, "suns": Sun, "insets": Inset}.items():
            fields.check_sequence(key, kind)
        count = len(self.materials)
        for number, mesh in enumerate(self.meshes):
            if mesh.material >= count:
                known = f"there are {count} materials" if count != 1 else "there is one material"
                raise FieldError(f"Scene.meshes[{number}].material: {mesh.material} is out of range; {known}")
