"""Spatial reuse of Area ReSTIR: each pixel resamples the samples of its neighbours (Zhang et al. 2024)."""

from bokehguide.baselines.restir.spatial_reuse import SpatialReuse

__all__ = ["SpatialReuse"]
