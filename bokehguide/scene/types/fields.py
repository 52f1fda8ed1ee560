"""Limits and metadata that fields of several classes share."""

from __future__ import annotations

from bokehguide.scene.tables import Limits

LABEL = "label"
"""Metadata of fields that name something and change no picture; digests omit them."""
INDEX = Limits("an index, a whole number of 0 or more", low=0)
