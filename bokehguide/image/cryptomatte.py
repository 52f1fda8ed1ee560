"""Cryptomatte 1.2: mattes by name in an EXR file.

A layer holds the ranks of each pixel: pairs of an identifier and a coverage, by descending coverage. The identifier is a hash of
the name, whose 32 bits are those of a float. The header holds the manifest: the identifier of each name.
Source: J. Friedman and A. Jones, "Fully automatic ID mattes with support for motion blur and transparency", SIGGRAPH 2015
posters, and the specification of Psyop's repository.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from types import ModuleType

import numpy as np

from bokehguide.errors import BokehguideError

RANKS = 6
"""Names that a pixel can have; two ranks fill the four channels of an EXR layer."""
LAYERS = {"object": "CryptoObject", "material": "CryptoMaterial"}
"""Names of the layers by kind."""
CHANNELS = {
    f"{kind}{number:02}": tuple(f"{name}{number:02}.{channel}" for channel in "RGBA")
    for kind, name in LAYERS.items()
    for number in range(RANKS // 2)
}
"""Channels by the names that `write_exr` takes."""


def require_hash() -> ModuleType:
    """The module `mmh3`. Raises BokehguideError where it is not installed."""
    try:
        import mmh3  # pyright: ignore[reportMissingImports]  # an extra
    except ImportError as error:
        raise BokehguideError(f"cryptomatte: needs MurmurHash3 ({error}); pip install 'bokehguide[cryptomatte]'") from None
    return mmh3


def identifier(name: str) -> int:
    """The 32 bits of a name's identifier: MurmurHash3_32 of the name in UTF-8, with seed 0.

    Where the exponent of the float would be 0 or 255, its last bit is inverted, so that no identifier is 0, denormal, infinite or
    NaN.
    """
    bits = require_hash().hash(_encoded(name), 0, signed=False)
    exponent = bits >> 23 & 255
    return bits ^ (1 << 23) if exponent in (0, 255) else bits


def floats(names: Sequence[str]) -> np.ndarray:
    """The identifiers of names as floats, float32 `[N]`."""
    return np.array([identifier(name) for name in names], np.uint32).view(np.float32)


def layer_key(layer: str) -> str:
    """Prefix of the header attributes of a layer, of seven digits of its name's hash."""
    return f"cryptomatte/{require_hash().hash(_encoded(layer), 0, signed=False):08x}"[:-1]


def attributes(kind: str, names: Iterable[str]) -> dict[str, str]:
    """Header attributes of a layer. kind: a key of LAYERS; names: of all objects or materials, in which a name may recur."""
    layer = LAYERS[kind]
    key = layer_key(layer)
    manifest = {name: f"{identifier(name):08x}" for name in names}
    facts = {"name": layer, "hash": "MurmurHash3_32", "conversion": "uint32_to_float32"}
    facts["manifest"] = json.dumps(manifest, separators=(",", ":"))
    return {f"{key}/{fact}": text for fact, text in facts.items()}


def manifest(kind: str, attributes: Mapping[str, object]) -> dict[str, str]:
    """The identifier of each name, in hexadecimal digits, in header attributes; empty without the layer of `kind`."""
    prefix = next(
        (key.removesuffix("name") for key, value in attributes.items() if key.endswith("/name") and value == LAYERS[kind]), ""
    )
    return json.loads(str(attributes.get(f"{prefix}manifest", "{}"))) if prefix else {}


def mask(kind: str, digits: str, layers: Mapping[str, np.ndarray]) -> np.ndarray:
    """The coverage of a name, float32 `[H, W]`. digits: its identifier, of the manifest; layers: by the keys of CHANNELS."""
    wanted = np.uint32(int(digits, 16))
    planes_of_kind = [layers[f"{kind}{number:02}"] for number in range(RANKS // 2)]
    ranks = [np.ascontiguousarray(plane[..., start : start + 2]) for plane in planes_of_kind for start in (0, 2)]
    return sum(
        (rank[..., 1] * (rank[..., 0].view(np.uint32) == wanted) for rank in ranks), np.zeros(ranks[0].shape[:2], np.float32)
    )


def planes(kind: str, identifiers: np.ndarray, coverage: np.ndarray) -> dict[str, np.ndarray]:
    """Layers `[H, W, 4]` by the keys of CHANNELS; identifiers, coverage: of each rank, float32 `[RANKS, H, W]`."""
    pairs = np.stack((identifiers, coverage), axis=1).reshape(RANKS // 2, 4, *coverage.shape[1:])
    return {f"{kind}{number:02}": np.moveaxis(layer, 0, -1) for number, layer in enumerate(pairs)}


def _encoded(name: str) -> bytes:
    """UTF-8; a lone surrogate, which UTF-8 lacks, becomes a question mark."""
    return name.encode("utf-8", "replace")
