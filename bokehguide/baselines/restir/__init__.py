"""Spatial reuse of Area ReSTIR: pixels resample their neighbours' samples (Zhang et al. 2024)."""

from bokehguide.baselines.restir.spatial_reuse import SpatialReuse

__all__ = ["SpatialReuse"]
