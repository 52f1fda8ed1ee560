"""pbrt-v3 and older: lights, shapes and textures with the parameters of pbrt-v4.

Colours of lights are not divided by their luminance before pbrt-v4, and a colour `scale` multiplies them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bokehguide.color import XYZ_TO_RGB, blackbody
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.pbrt.contents import Contents
from bokehguide.scene.pbrt.parameters import Parameter, Parameters
from bokehguide.scene.pbrt.spectra import COLORS, WAVELENGTHS, emission, luminous_mean, matching, sampled
from bokehguide.scene.tables import KELVIN

RENAMED = {"mapname": "filename", "nlevels": "levels"}
"""Parameters of lights and shapes that pbrt-v4 names otherwise."""
SECOND_RADIATION = 1.4387769e7
"""The second radiation constant of Planck's law, nm K."""


def upgrade(contents: Contents, folder: Path, files: SceneFiles) -> None:
    """Give the entries of an older scene the names and colours of pbrt-v4, in place.

    Raises BokehguideError for values out of range and for missing files of spectra.
    """
    shapes = [shape for each in (contents.shapes, *contents.objects.values()) for shape in each]
    areas = {id(shape.light): shape.light for shape in shapes if shape.light is not None}
    for light in (*(light.parameters for light in contents.lights), *areas.values()):
        light.kind = "diffuse" if light.kind == "area" else light.kind
        _rename(light)
        _fold_scale(light, "I" if light.kind in ("point", "spot", "goniometric", "projection") else "L", folder, files)
    for shape in shapes:
        _rename(shape.parameters)
    for texture in contents.textures.values():
        _fold_gamma(texture.parameters)


def _fold_gamma(texture: Parameters) -> None:
    """Replace `gamma`, a flag in pbrt-v3 and an exponent before, by the `encoding` of pbrt-v4."""
    gamma = texture.values.get("gamma")
    if gamma is not None:
        numeric = gamma.type == "float"
        encoding = f"gamma {texture.number('gamma', 1.0):g}" if numeric else "sRGB" if texture.flag("gamma") else "linear"
        texture.values["encoding"] = Parameter("string", [encoding], gamma.place)


def _rename(parameters: Parameters) -> None:
    """Give the parameters RENAMED their names of pbrt-v4."""
    for old, new in RENAMED.items():
        if old in parameters.values:
            parameters.values[new] = parameters.values.pop(old)


def _fold_scale(light: Parameters, key: str, folder: Path, files: SceneFiles) -> None:
    """Replace the colour `key` of a light and its colour `scale` by their product."""
    place = light.values[key].place if key in light.values else light.place
    color = _color(light, key, folder, files)
    if "scale" in light.values:
        scale = light.values["scale"]
        color = color * (light.number("scale", 1.0) if scale.type == "float" else _color(light, "scale", folder, files))
        del light.values["scale"]
    light.values[key] = Parameter("rgb", color.clip(min=0.0), place)


def _color(light: Parameters, key: str, folder: Path, files: SceneFiles) -> np.ndarray:
    """A colour of a light, linear Rec.709 `[3]`."""
    found = light.values.get(key)
    if found is None or found.type in COLORS:
        return emission(light, key, folder, files)
    if found.type == "blackbody":
        return _blackbody(light, key)
    values = sampled(light, key, folder, files)
    return emission(light, key, folder, files) if values is None else (XYZ_TO_RGB @ matching() @ values) / matching()[1].sum()


def _blackbody(light: Parameters, key: str) -> np.ndarray:
    """The colour of a black body whose largest spectral radiance is the second number, 1 without one."""
    numbers = light.numbers(key)
    assert numbers is not None
    kelvin = float(numbers[0, 0])
    if not kelvin > 0.0:
        light.fail(key, "is no temperature; give kelvin above 0")
    kelvin = min(max(kelvin, KELVIN.low), KELVIN.high)
    peak = SECOND_RADIATION / (4.965114 * kelvin)
    radiance = (peak / WAVELENGTHS) ** 5 * np.expm1(4.965114) / np.expm1(SECOND_RADIATION / (WAVELENGTHS * kelvin))
    return blackbody(kelvin) * luminous_mean(radiance) * (float(numbers[1, 0]) if len(numbers) > 1 else 1.0)
