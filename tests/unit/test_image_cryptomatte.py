"""Cryptomatte: identifiers of names, manifests and layers, read by the decoder of another author."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest

from bokehguide.errors import BokehguideError
from bokehguide.image import read_metadata, write_exr
from bokehguide.image.cryptomatte import LAYERS, RANKS, attributes, floats, identifier, planes

pytest.importorskip("mmh3")
cryptomatte_api = pytest.importorskip("cryptomatte_api")

ODD_NAMES = ("Blätter 葉 🍂", 'a "quoted\\" name', "tab\there", "{}:,", "a" * 3000, " ", "line\nbreak", "/scene/tree.001")


def murmur(data: bytes) -> int:
    """MurmurHash3_x86_32 with seed 0, after the description of its author, A. Appleby."""

    def mixed(word: int) -> int:
        word = word * 0xCC9E2D51 & 0xFFFFFFFF
        return ((word << 15 | word >> 17) & 0xFFFFFFFF) * 0x1B873593 & 0xFFFFFFFF

    value, whole = 0, len(data) // 4 * 4
    for (word,) in struct.iter_unpack("<I", data[:whole]):
        value ^= mixed(word)
        value = ((value << 13 | value >> 19) * 5 + 0xE6546B64) & 0xFFFFFFFF
    value ^= mixed(int.from_bytes(data[whole:], "little"))
    value ^= len(data)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35), (16, 1)):
        value = (value ^ value >> shift) * factor & 0xFFFFFFFF
    return value


def names_by_exponent(wanted: int) -> list[str]:
    """Ten names whose hash has an exponent of these bits."""
    names = (f"name {number}" for number in range(100_000))
    return [name for name in names if murmur(name.encode()) >> 23 & 255 == wanted][:10]


def test_identifiers_are_those_of_the_sample_files_of_the_specification():
    assert {name: f"{identifier(name):08x}" for name in ("bunny", "default")} == {"bunny": "13851a76", "default": "42c9679f"}


def test_identifiers_are_the_hash_where_it_is_a_normal_float():
    for name in ("hello", *ODD_NAMES):
        assert murmur(name.encode()) >> 23 & 255 not in (0, 255)
        assert identifier(name) == murmur(name.encode())


def test_an_identifier_is_never_zero_denormal_infinite_or_nan():
    for exponent in (0, 255):
        for name in names_by_exponent(exponent):
            assert identifier(name) == murmur(name.encode()) ^ 1 << 23
    found = floats(["", *names_by_exponent(0), *names_by_exponent(255)])
    assert np.isfinite(found).all() and (np.abs(found) >= np.finfo(np.float32).tiny).all()


def test_the_float_of_a_name_has_the_bits_of_its_identifier():
    np.testing.assert_array_equal(floats(ODD_NAMES).view(np.uint32), [identifier(name) for name in ODD_NAMES])


def written(path, names: tuple[str, ...]) -> np.ndarray:
    """A file in which name i covers pixel i by half, and its successor by a quarter; returns the coverage `[names, pixels]`."""
    coverage = np.zeros((RANKS, 1, len(names)), np.float32)
    coverage[0], coverage[1] = 0.5, 0.25
    order = np.arange(len(names))
    ranks = np.zeros((RANKS, 1, len(names)), np.float32)
    ranks[0, 0], ranks[1, 0] = floats(names), floats(np.roll(names, -1).tolist())
    layers, facts = {"alpha": np.ones((1, len(names)), np.float32)}, {}
    for kind in LAYERS:
        layers |= planes(kind, ranks, coverage)
        facts |= attributes(kind, names)
    write_exr(path, layers, facts)
    return 0.5 * (order[:, None] == order) + 0.25 * (order[:, None] == (order + 1) % len(names))


def test_a_decoder_finds_odd_names(tmp_path):
    coverage = written(tmp_path / "a.exr", ODD_NAMES)
    mattes = cryptomatte_api.Cryptomatte.load(str(tmp_path / "a.exr"))
    assert sorted(matte.metadata().name() for matte in mattes) == sorted(LAYERS.values())
    for matte in mattes:
        masks = matte.masks()
        assert masks.keys() == set(ODD_NAMES)
        for name, expected in zip(ODD_NAMES, coverage):
            np.testing.assert_array_equal(masks[name].reshape(-1), expected)


def test_the_header_has_the_keys_of_the_specification(tmp_path):
    written(tmp_path / "a.exr", ODD_NAMES)
    facts = {key: value for key, value in read_metadata(tmp_path / "a.exr").items() if key.startswith("cryptomatte/")}
    for name in LAYERS.values():
        key = f"cryptomatte/{murmur(name.encode()):08x}"[:-1]
        found = {part: facts.pop(f"{key}/{part}") for part in ("name", "hash", "conversion", "manifest")}
        manifest = json.loads(found.pop("manifest"))
        assert manifest == {each: f"{identifier(each):08x}" for each in ODD_NAMES}
        assert found == {"name": name, "hash": "MurmurHash3_32", "conversion": "uint32_to_float32"}
    assert not facts


def test_a_recurring_name_stands_once_in_the_manifest():
    facts = attributes("object", ["tree", "rock", "tree"])
    (manifest,) = (value for key, value in facts.items() if key.endswith("/manifest"))
    assert manifest.count("tree") == 1 and json.loads(manifest).keys() == {"tree", "rock"}


def test_the_hash_is_an_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "mmh3", None)
    with pytest.raises(BokehguideError, match=r"pip install 'bokehguide\[cryptomatte\]'"):
        identifier("tree")
