"""Colours of pbrt in linear Rec.709: RGB of its colour spaces, black bodies, named spectra and sampled spectra.

pbrt-v4 divides the spectrum of an emitter by its luminance, except for an RGB colour, which it multiplies by the white of the
colour space. The luminance of any emitter without a `scale` is therefore 1, or that of its RGB colour.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from bokehguide.color import LUMINANCE, XYZ_TO_RGB, blackbody
from bokehguide.errors import printable
from bokehguide.scene.files import SceneFiles, require_file
from bokehguide.scene.pbrt.parameters import Parameters
from bokehguide.scene.tables import KELVIN, did_you_mean
from bokehguide.scene.vectors import Vector, as_vector

WHITE = (0.3127, 0.3290)
"""Chromaticity of D65."""
PRIMARIES = {
    "srgb": ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06)),
    "dci-p3": ((0.68, 0.32), (0.265, 0.690), (0.15, 0.06)),
    "rec2020": ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    "aces2065-1": ((0.7347, 0.2653), (0.0, 1.0), (0.0001, -0.077)),
}
"""Chromaticities of red, green and blue, by colour space."""
D65 = (46.6, 50.0, 82.8, 93.4, 104.9, 117.8, 115.9, 109.4, 104.8, 104.4, 100.0, 95.8)
D65 += (90.0, 87.7, 83.7, 80.2, 78.3, 71.6, 61.6, 75.1, 46.4, 63.4, 59.5, 57.4)
"""Relative power of CIE D65 at 360, 380, … 820 nm."""
ILLUMINANTS: dict[str, Vector] = {
    "stdillum-A": (1.8451, 0.8262, 0.2334),
    "stdillum-D50": (1.0866, 0.9996, 0.7496),
    "stdillum-D65": (1.0, 1.0, 1.0),
    "stdillum-F1": (0.9543, 1.0194, 0.9434),
    "stdillum-F2": (1.3401, 0.9431, 0.5627),
    "stdillum-F3": (1.5764, 0.8912, 0.3808),
    "stdillum-F4": (1.8063, 0.8344, 0.2671),
    "stdillum-F5": (0.9154, 1.0363, 0.8901),
    "stdillum-F6": (1.3161, 0.9579, 0.4864),
    "stdillum-F7": (1.0003, 1.0003, 0.9971),
    "stdillum-F8": (1.1767, 0.9758, 0.7199),
    "stdillum-F9": (1.3769, 0.9315, 0.5693),
    "stdillum-F10": (1.1776, 0.9757, 0.7182),
    "stdillum-F11": (1.4121, 0.9249, 0.5315),
    "stdillum-F12": (1.7685, 0.8452, 0.2708),
    "illum-acesD60": (1.0469, 0.9947, 0.9154),
}
"""Colours of luminance 1 of CIE's illuminants."""
METALS: dict[str, Vector] = {
    "Ag": (0.9715, 0.9599, 0.9153),
    "Al": (0.9132, 0.9215, 0.9245),
    "Au": (1.0, 0.7825, 0.3434),
    "Cu": (0.9553, 0.6376, 0.5382),
    "CuZn": (0.9097, 0.7783, 0.4228),
    "MgO": (0.0720, 0.0731, 0.0749),
    "TiO2": (0.2322, 0.2446, 0.2727),
}
"""Reflectance at normal incidence under D65, from measured η and k."""
GLASSES = {
    "glass-BK7": 1.5183,
    "glass-BAF10": 1.6726,
    "glass-FK51A": 1.4876,
    "glass-LASF9": 1.8550,
    "glass-F5": 1.6765,
    "glass-F10": 1.7329,
    "glass-F11": 1.7903,
}
"""Refractive indices, weighted by the luminous efficiency."""
COLORS = ("rgb", "color", "xyz")
"""Types of parameters with three numbers for a colour."""
WAVELENGTHS = np.arange(360.0, 831.0, 1.0)
"""Nanometres."""


def _to_rec709(primaries: tuple[tuple[float, float], ...]) -> np.ndarray:
    """The matrix `[3, 3]` from a colour space to linear Rec.709 that keeps white."""

    def to_xyz(each: tuple[tuple[float, float], ...]) -> np.ndarray:
        columns = np.array([(x, y, 1.0 - x - y) for x, y in each]).T
        x, y = WHITE
        return columns * np.linalg.solve(columns, np.array([x / y, 1.0, (1.0 - x - y) / y]))

    return np.linalg.solve(to_xyz(PRIMARIES["srgb"]), to_xyz(primaries))


COLOR_SPACES = {name: _to_rec709(primaries) for name, primaries in PRIMARIES.items()} | {"srgb": np.eye(3)}
"""Matrices to linear Rec.709, by the names of the directive `ColorSpace`."""


def matching() -> np.ndarray:
    """CIE 1931 colour matching functions `[3, N]`: sums of lobes (Wyman, Sloan and Shirley 2013, JCGT 2(2))."""

    def lobe(height: float, mean: float, below: float, above: float) -> np.ndarray:
        return height * np.exp(-0.5 * ((WAVELENGTHS - mean) / np.where(mean > WAVELENGTHS, below, above)) ** 2)

    x = lobe(1.056, 599.8, 37.9, 31.0) + lobe(0.362, 442.0, 16.0, 26.7) + lobe(-0.065, 501.1, 20.4, 26.2)
    y = lobe(0.821, 568.8, 46.9, 40.5) + lobe(0.286, 530.9, 16.3, 31.1)
    z = lobe(1.217, 437.0, 11.8, 36.0) + lobe(0.681, 459.0, 26.0, 13.8)
    return np.stack([x, y, z])


def luminous_mean(values: np.ndarray) -> float:
    """The mean of a spectrum at WAVELENGTHS, weighted by the luminous efficiency."""
    weights = matching()[1]
    return float(weights @ values / weights.sum())


def emitted(values: np.ndarray) -> np.ndarray:
    """The colour of luminance 1 of a spectrum of power at WAVELENGTHS; channels outside Rec.709 are 0. Black stays 0."""
    rgb = (XYZ_TO_RGB @ (matching() @ values)).clip(min=0.0)
    luminance = LUMINANCE @ rgb
    return rgb / luminance if luminance > 0.0 else np.zeros(3)


def reflected(values: np.ndarray) -> np.ndarray:
    """The colour under D65 of reflectances at WAVELENGTHS; 1 is white."""
    power = np.interp(WAVELENGTHS, np.arange(360.0, 821.0, 20.0), D65)
    white = XYZ_TO_RGB @ (matching() @ power)
    return ((XYZ_TO_RGB @ (matching() @ (power * values))) / white).clip(0.0, 1.0)


def sampled(parameters: Parameters, key: str, folder: Path, files: SceneFiles) -> np.ndarray | None:
    """The spectrum of `key` at WAVELENGTHS, from numbers or a file; None for a name, a colour and a texture."""
    found = parameters.values.get(key)
    if found is None or found.type != "spectrum":
        return None
    if isinstance(found.values, np.ndarray):
        pairs = parameters.numbers(key, 2)
    else:
        name = parameters.text(key)
        if name in ILLUMINANTS or name in GLASSES or (_metal(name) is not None and name.startswith("metal-")):
            return None
        path = files.find(folder, name, str(found.place))
        if not path.is_file():
            if _metal(name) is not None:
                return None
            known = [*ILLUMINANTS, *GLASSES, *(f"metal-{metal}-{part}" for metal in METALS for part in ("eta", "k"))]
            found.place.fail(f"{printable(name)!r} is neither a spectrum nor a file; {did_you_mean(name, known)}")
        pairs = _pairs(path, parameters, key)
    assert pairs is not None
    if not (np.diff(pairs[:, 0]) > 0.0).all():
        parameters.fail(key, "has wavelengths that do not rise; sort them")
    return np.interp(WAVELENGTHS, pairs[:, 0], pairs[:, 1])


def _pairs(path: Path, parameters: Parameters, key: str) -> np.ndarray:
    """Wavelengths and values `[N, 2]` of a file."""
    require_file(path, "spectrum")
    try:
        lines = path.read_text("utf-8", errors="replace").splitlines()
        numbers = np.array(" ".join(line.partition("#")[0] for line in lines).split(), np.float64)
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) == 0 or len(numbers) % 2 or not np.isfinite(numbers).all():
        parameters.fail(key, "names a file that does not hold pairs of wavelength and value; repair it")
    return numbers.reshape(-1, 2)


def _metal(name: str) -> str | None:
    """The metal of a spectrum such as "metal-Cu-eta", or of a file that pbrt-v3 comes with, such as "spds/Cu.eta.spd"."""
    found = re.fullmatch(r"metal-(\w+)-(?:eta|k)|(?:.*/)?(\w+)\.(?:eta|k)\.spd", name)
    metal = None if found is None else found[1] or found[2]
    return metal if metal in METALS else None


def _rgb(parameters: Parameters, key: str) -> np.ndarray:
    """A colour of a type in COLORS in linear Rec.709, not negative."""
    color = np.array(parameters.vector(key, (0.0, 0.0, 0.0)))
    if parameters.values[key].type == "xyz":
        return (XYZ_TO_RGB @ color).clip(min=0.0)
    if (color < 0.0).any():
        parameters.fail(key, "has a negative channel; give 0 or more")
    return (COLOR_SPACES[parameters.values[key].space] @ color).clip(min=0.0)


def emission(parameters: Parameters, key: str, folder: Path, files: SceneFiles) -> np.ndarray:
    """The colour of an emitter before its `scale`, `[3]`; white without the parameter."""
    found = parameters.values.get(key)
    if found is None:
        return np.ones(3)
    if found.type in COLORS:
        return _rgb(parameters, key)
    if found.type == "blackbody":
        kelvin = parameters.number(key, 6500.0)
        if not kelvin > 0.0:
            parameters.fail(key, "is no temperature; give kelvin above 0")
        return blackbody(min(max(kelvin, KELVIN.low), KELVIN.high))
    values = sampled(parameters, key, folder, files)
    if values is not None:
        return emitted(values.clip(min=0.0))
    return np.array(ILLUMINANTS.get(parameters.text(key), (1.0, 1.0, 1.0)))


def reflectance(parameters: Parameters, key: str, default: Vector, folder: Path, files: SceneFiles) -> Vector:
    """The colour of a surface, 0 or more; of a spectrum, at most 1."""
    found = parameters.values.get(key)
    if found is None:
        return default
    if found.type in COLORS:
        return as_vector(_rgb(parameters, key))
    if found.type == "float":
        return as_vector(np.full(3, max(parameters.number(key, 0.5), 0.0)))
    values = sampled(parameters, key, folder, files)
    return default if values is None else as_vector(reflected(values.clip(0.0, 1.0)))


def index(parameters: Parameters, key: str, default: float, folder: Path, files: SceneFiles) -> float:
    """A refractive index: a number, a glass, or the mean of a spectrum by luminous efficiency."""
    found = parameters.values.get(key)
    if found is None or found.type == "texture":
        return default
    if found.type == "float":
        return parameters.number(key, default)
    if found.type in COLORS:
        return float(np.mean(_rgb(parameters, key)))
    values = sampled(parameters, key, folder, files)
    if values is not None:
        return luminous_mean(values)
    return GLASSES.get(parameters.text(key), default)


def metal(parameters: Parameters, prefix: str, folder: Path, files: SceneFiles) -> Vector:
    """The reflectance at normal incidence of a conductor with the parameters PREFIXeta and PREFIXk; copper without them."""
    optical = []
    for part in ("eta", "k"):
        key = prefix + part
        found = parameters.values.get(key)
        if found is not None and found.type in COLORS:
            optical.append(_rgb(parameters, key))
        elif found is not None and found.type == "float":
            optical.append(np.full(3, parameters.number(key, 1.0)))
        else:
            optical.append(sampled(parameters, key, folder, files))
    eta, k = optical
    if eta is None or k is None or (len(eta) != len(k)):
        named = parameters.text(f"{prefix}eta", "metal-Cu-eta") if eta is None else "metal-Cu-eta"
        return METALS[_metal(named) or "Cu"]
    values = ((eta - 1.0) ** 2 + k**2) / np.maximum((eta + 1.0) ** 2 + k**2, 1e-12)
    return as_vector(values.clip(0.0, 1.0) if len(eta) == 3 else reflected(values))
