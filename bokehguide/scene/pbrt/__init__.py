"""Scenes of pbrt."""

from bokehguide.scene.pbrt.reading import read_pbrt

__all__ = ["read_pbrt"]
