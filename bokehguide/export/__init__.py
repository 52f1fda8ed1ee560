"""Scenes in the formats of other renderers."""

from bokehguide.export.mitsuba_xml import export_mitsuba

__all__ = ["export_mitsuba"]
