"""The kinds of Mitsuba's variants."""

from __future__ import annotations

import mitsuba as mi


def is_scalar() -> bool:
    """Whether the current variant traces one path at a time."""
    return str(mi.variant()).startswith("scalar")
