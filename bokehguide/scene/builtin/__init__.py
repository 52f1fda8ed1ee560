"""The built-in scenes, in the order in which `bokehguide scenes` lists them."""

from collections.abc import Callable

from bokehguide.scene.builtin.chrome import chrome
from bokehguide.scene.builtin.cutout import cutout
from bokehguide.scene.builtin.daylight import daylight
from bokehguide.scene.builtin.fairy_lights import fairy_lights
from bokehguide.scene.builtin.glitter import glitter
from bokehguide.scene.builtin.night_street import night_street
from bokehguide.scene.builtin.occluded import occluded
from bokehguide.scene.types import Scene

BUILTIN: dict[str, Callable[[], Scene]] = {
    "fairy-lights": fairy_lights,
    "occluded": occluded,
    "chrome": chrome,
    "night-street": night_street,
    "glitter": glitter,
    "cutout": cutout,
    "daylight": daylight,
}
