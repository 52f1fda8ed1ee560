"""Ways to break a file: bytes, words, tokens of texts, and values of JSON, TOML and checkpoints."""

from __future__ import annotations

import copy
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from fuzzing.gltf_samples import packed_glb
from hypothesis import strategies

WORDS = (0, 1, -1, 2**15, 2**16, 2**20, 2**27, 2**30, 2**31 - 1, -(2**31), 9000, 12345678)
"""Counts, sizes and offsets."""
FLOATS = (float("nan"), float("inf"), -float("inf"), 1e38, -1e38, 1e-45, 0.0, 3e9)
VALUES = (
    *(None, True, -1, 0, 1, 0.5, 2**31, 2**53, 2**64, 10**400, -(10**30), 1e300, -1e300, 1e-320, 1e38, 3e9),
    *(float("nan"), float("inf"), "", "x", "\x1b[2J\n\0", "../" * 9, "a" * 4000, "data:;base64,QUJD", "%00", "\ud800"),
    *([], [None], [1, 2, 3], [float("nan")] * 3, [1e300] * 4, [[[[]]]], {}, {"a": {}}, {"index": 0}, [0] * 500),
)
TOKENS = (
    *("0", "-1", "1", "0.0", "-0.0", "1e400", "nan", "inf", "-inf", "1e18", "1e-320", "9" * 30, "9" * 5000, "4294967295"),
    *("2147483648", "1000000000", "99999999", "x", '""', '"\\u001b\\n"', "'../../x'", "true", "[]", "{}", "[" * 3000),
    *("{a=" * 300, "[1, 2, 3]", "[nan, 0, 0]", "[[1]]", "[1e18, 1e18, 1e18]", "a.b.c.d = 1", "1979-05-27", "\ud83d\ude00"),
    *("\0", "=", "\n", "#", '"' * 3, "[materials.x]", "[[object]]", "[a]\n[a]", "1/2/3", "-1/-1/-1", "9/9/9", "list"),
    *("property", "element", "vertex", "end_header"),
)


class Damage(NamedTuple):
    """One change of a file. where, what: choices among the places and the changes, modulo their numbers."""

    kind: str
    where: int
    what: int


def flip(data: bytes, where: int, what: int) -> bytes:
    at = where % len(data)
    return data[:at] + bytes([data[at] ^ (1 + what % 255)]) + data[at + 1 :]


def cut(data: bytes, where: int, what: int) -> bytes:
    return data[: where % len(data)]


def leave_out(data: bytes, where: int, what: int) -> bytes:
    at = where % len(data)
    return data[:at] + data[at + 1 + what % 64 :]


def insert(data: bytes, where: int, what: int) -> bytes:
    at = where % len(data)
    return data[:at] + bytes([what % 256]) * (1 + what // 256 % 300) + data[at:]


def repeat(data: bytes, where: int, what: int) -> bytes:
    at, length = where % len(data), 1 + what % 200
    return data[:at] + data[at : at + length] * (2 + what // 200 % 40) + data[at + length :]


def word(data: bytes, where: int, what: int) -> bytes:
    """A whole number or a float of four bytes in the place of others, more often near the start than anywhere."""
    at = where // 2 % (len(data) if where % 2 else min(len(data), 600))
    kinds = [struct.pack(order + "i", value) for value in WORDS for order in "<>"]
    kinds += [struct.pack("<f", value) for value in FLOATS]
    return data[:at] + kinds[what % len(kinds)] + data[at + 4 :]


def token(data: bytes, where: int, what: int) -> bytes:
    """Another word of a text."""
    found = list(re.finditer(rb"[^\s,\[\]=]+", data)) or [re.search(b"$", data)]
    start, end = found[where % len(found)].span()
    return data[:start] + TOKENS[what % len(TOKENS)].encode("utf-8", "surrogatepass") + data[end:]


def exchange(data: bytes, where: int, what: int) -> bytes:
    """A word of a text in the place of another one."""
    found = list(re.finditer(rb'"[^"\n]*"|[^\s\[\]"]+', data))
    if not found:
        return flip(data, where, what)
    start, end = found[where % len(found)].span()
    return data[:start] + found[what % len(found)].group() + data[end:]


def line(data: bytes, where: int, what: int) -> bytes:
    """A line again somewhere else, or many times, or the value after its = replaced."""
    lines = data.split(b"\n")
    at, to = where % len(lines), what // 4 % len(lines)
    if what % 4 == 0:
        lines.insert(to, lines[at])
    elif what % 4 == 1:
        lines[at : at + 1] = [lines[at]] * (2 + what // 4 % 50)
    else:
        key, equals, _ = lines[at].partition(b"=")
        lines[at] = key + (equals or b" ") + TOKENS[what // 4 % len(TOKENS)].encode("utf-8", "surrogatepass")
    return b"\n".join(lines)


def places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Every (container, key) of nested dicts and lists."""
    entries = list(value.items()) if isinstance(value, dict) else list(enumerate(value)) if isinstance(value, list) else []
    for key, inner in entries:
        yield value, key
        yield from places(inner)


def change(document: Any, where: int, what: int, values: tuple = VALUES) -> None:
    """Another value, none, the value of another place, or a list of many, in one place of nested data."""
    found = list(places(document))
    if not found:
        return
    container, key = found[where % len(found)]
    kind, what = what % 8, what // 8
    if kind == 0:
        del container[key]
    elif kind == 1:
        other, name = found[what % len(found)]
        container[key] = copy.deepcopy(other[name])  # a copy: JSON knows no circles
    elif kind == 2 and isinstance(container[key], list):
        container[key] = (container[key] * (2 + what % 300))[:1000]
    else:
        container[key] = values[what % len(values)]


def json_value(data: bytes, where: int, what: int) -> bytes:
    """In the JSON of a .gltf or .glb."""
    packed = data[:4] == b"glTF" and len(data) > 20
    length = struct.unpack_from("<I", data, 12)[0] if packed else 0
    try:
        document = json.loads(data[20 : 20 + length] if packed else data)
        change(document, where, what)
        text = json.dumps(document, ensure_ascii=what % 2 == 0).encode("utf-8", "replace")
    except (ValueError, RecursionError):
        return flip(data, where, what)
    return packed_glb(text, data[28 + length :]) if packed else text


def png_checksums(data: bytes, where: int, what: int) -> bytes:
    """A word changed in one chunk of a PNG, with the checksum that suits it: a decoder looks further."""
    if data[:8] != b"\x89PNG\r\n\x1a\n":
        return word(data, where, what)
    starts, at = [], 8
    while at + 12 <= len(data):
        starts.append(at)
        at += 12 + struct.unpack_from(">I", data, at)[0]
    if not starts:
        return word(data, where, what)
    start = starts[where % len(starts)]
    length = struct.unpack_from(">I", data, start)[0]
    chunk = bytearray(data[start + 4 : start + 8 + length])
    if length:
        flipped = bytearray(flip(bytes(chunk), 4 + where // 8 % length, what))
        chunk = flipped if what % 2 else chunk[:4] + word(bytes(chunk[4:]), where, what)[:length]
    return data[: start + 4] + bytes(chunk) + struct.pack(">I", zlib.crc32(chunk)) + data[start + 12 + length :]


def state_value(data: bytes, where: int, what: int) -> bytes:
    """Damage within the values of a checkpoint, saved again by torch."""
    try:
        state = torch.load(io.BytesIO(data), weights_only=True)
        change(state, where, what, (*VALUES, *TENSORS, CIRCLE))
    except Exception:  # damaged already, or with a circle in it
        return flip(data, where, what)
    stream = io.BytesIO()
    torch.save(state, stream)
    return stream.getvalue()


TENSORS = (
    *(torch.zeros(0), torch.zeros(3), torch.full((400,), torch.nan), torch.full((4,), 2**40), torch.tensor(7)),
    *(torch.full((4,), -1), torch.zeros(1).expand(10**9), torch.zeros(3, 3, dtype=torch.complex64)),
    torch.zeros(9, dtype=torch.bool),
)
CIRCLE: list = []
CIRCLE.append(CIRCLE)


def stored_record(data: bytes, where: int, what: int) -> bytes:
    """A byte or a word of one record of a zip file, with the checksum that suits it, and sometimes packed."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            records = {name: archive.read(name) for name in archive.namelist()}
    except Exception:  # already damaged
        return flip(data, where, what)
    name = list(records)[where % len(records)]
    if records[name]:
        records[name] = (flip if what % 2 else word)(records[name], where // 64, what // 2)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED if what % 5 == 0 else zipfile.ZIP_STORED) as archive:
        for name, record in records.items():
            archive.writestr(name, record)
    return stream.getvalue()


def attribute(data: bytes, where: int, what: int) -> bytes:
    """Another value of one attribute of an XML file."""
    found = list(re.finditer(rb'(?<==")[^"]*(?=")', data))
    if not found:
        return flip(data, where, what)
    start, end = found[where % len(found)].span()
    values = (*(word.encode("utf-8", "surrogatepass") for word in TOKENS), *(each.group() for each in found))
    return data[:start] + values[what % len(values)].replace(b'"', b"") + data[end:]


BYTES = (flip, cut, leave_out, insert, repeat, word)
TEXT = (token, token, line)
KINDS: dict[str, tuple[Callable[[bytes, int, int], bytes], ...]] = {
    ".glb": (*BYTES, *[json_value] * 6),
    ".gltf": (*BYTES, *TEXT, *[json_value] * 6),
    ".toml": (*BYTES, *TEXT * 4),
    ".xml": (*BYTES, *TEXT * 2, *[attribute] * 6),
    ".mtlx": (*BYTES, *TEXT * 2, *[attribute] * 6),
    ".pbrt": (*BYTES, *TEXT * 2, *[exchange] * 6),
    ".dat": (*BYTES, *TEXT * 4),
    ".pfm": (*BYTES, *TEXT),
    ".usda": (*BYTES, *TEXT * 4),
    ".hdr": (*BYTES, *TEXT),
    ".exr": (*BYTES, word, word),
    ".png": (*BYTES, *[png_checksums] * 4),
    ".obj": (*BYTES, *TEXT * 3),
    ".mtl": (*BYTES, *TEXT * 3),
    ".ply": (*BYTES, *TEXT * 3),
    ".stl": (*BYTES, *TEXT),
    ".ckpt": (*BYTES, *[stored_record] * 4, *[state_value] * 5),
}
"""Kinds of damage by the suffix of the file; other suffixes get BYTES."""


def damages(suffix: str) -> strategies.SearchStrategy[list[Damage]]:
    """Lists of damages to a file of that kind, one to three."""
    names = [kind.__name__ for kind in KINDS.get(suffix, BYTES)]
    number = strategies.integers(0, 2**32 - 1)
    one = strategies.builds(Damage, strategies.sampled_from(names), number, number)
    return strategies.lists(one, min_size=1, max_size=3)


def damaged(data: bytes, done: list[Damage]) -> bytes:
    """`data` after all of `done`."""
    for kind, where, what in done:
        if data:
            data = globals()[kind](data, where, what)
    return data
