"""Mitsuba 3's XML files as scenes."""

from bokehguide.scene.mitsuba_xml.reading import read_mitsuba

__all__ = ["read_mitsuba"]
