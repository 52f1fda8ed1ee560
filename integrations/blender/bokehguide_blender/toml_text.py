"""Text of scene files. Needs no Blender."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence


def dumps(tables: Mapping[str, object]) -> str:
    """The TOML text of `tables`: a mapping is a table, a list of mappings an array of tables."""
    lines: list[str] = []
    for name, content in tables.items():
        several = isinstance(content, list)
        for table in content if several else [content]:
            lines += [
                f"[[{name}]]" if several else f"[{name}]",
                *(f"{key} = {_value(value)}" for key, value in table.items()),
                "",
            ]
    return "\n".join(lines)


def _value(value: object) -> str:
    """A value in one line; mappings become inline tables."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_value(each)}" for key, each in value.items()) + " }"
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(_value, value)) + "]"
    raise TypeError(f"no TOML value: {value!r}")
