"""The messages of the page's socket."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from typing import Any

from bokehguide.errors import BokehguideError
from bokehguide.view.session import Message


def parsed(text: str | bytes) -> Mapping[str, Any]:
    """A request of a page. Raises BokehguideError for anything but a JSON object."""
    if isinstance(text, bytes):
        raise BokehguideError("files are not accepted")
    try:
        request = json.loads(text)
    except (ValueError, RecursionError):
        request = None
    if not isinstance(request, dict):
        raise BokehguideError("a request is a JSON object")
    return request


def encoded(message: Message) -> str | bytes:
    """A message as a JSON text, or, with a picture, as the length of the text (little endian, 32 bits), the text and the PNG."""
    text = json.dumps(_plain({"type": message.kind, **message.facts}), allow_nan=False)
    if not message.picture:
        return text
    data = text.encode()
    return struct.pack("<I", len(data)) + data + message.picture


def _plain(value: Any) -> Any:
    """A JSON value with null for NaN and infinities, which JSON lacks."""
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
