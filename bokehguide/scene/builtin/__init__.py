"""The built-in scenes, in the order of `bokehguide scenes`."""

from collections.abc import Callable

from bokehguide.scene.builtin import chrome, cutout, daylight, fairy_lights, glitter, night_street, occluded
from bokehguide.scene.types import Scene

BUILTIN: dict[str, Callable[[], Scene]] = {
    "fairy-lights": fairy_lights.fairy_lights,
    "occluded": occluded.occluded,
    "chrome": chrome.chrome,
    "night-street": night_street.night_street,
    "glitter": glitter.glitter,
    "cutout": cutout.cutout,
    "daylight": daylight.daylight,
}

DESCRIPTIONS = {
    "fairy-lights": fairy_lights.DESCRIPTION,
    "occluded": occluded.DESCRIPTION,
    "chrome": chrome.DESCRIPTION,
    "night-street": night_street.DESCRIPTION,
    "glitter": glitter.DESCRIPTION,
    "cutout": cutout.DESCRIPTION,
    "daylight": daylight.DESCRIPTION,
}
"""Descriptions of the scenes, available without building them."""
