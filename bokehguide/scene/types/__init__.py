"""Plain data of a scene in world space.

Lengths are in metres, angles in degrees, colours in linear Rec.709. Emission is radiance.
World space is right-handed with y up.

Each class checks its fields when an instance is built, and raises BokehguideError with the class, the field, the value and the
remedy. Lists and arrays of other types are converted.

Scenes, models, meshes, textures and environments are equal only to themselves: their arrays can be large.
"""

from bokehguide.scene.types.camera import SENSOR_WIDTH, Aperture, Camera
from bokehguide.scene.types.fields import LABEL
from bokehguide.scene.types.film import FilmSettings, Inset
from bokehguide.scene.types.lights import Cone, Environment, Sun
from bokehguide.scene.types.material import ALPHA_MODES, MATERIAL_COLORS, MATERIAL_NUMBERS, Material, Texture
from bokehguide.scene.types.mesh import Mesh
from bokehguide.scene.types.scene import Scene
from bokehguide.scene.vectors import Vector, as_vector

__all__ = [
    "ALPHA_MODES",
    "LABEL",
    "MATERIAL_COLORS",
    "MATERIAL_NUMBERS",
    "SENSOR_WIDTH",
    "Aperture",
    "Camera",
    "Cone",
    "Environment",
    "FilmSettings",
    "Inset",
    "Material",
    "Mesh",
    "Scene",
    "Sun",
    "Texture",
    "Vector",
    "as_vector",
]
