"""Area ReSTIR's spatial reuse: pixels share their samples by resampling (Zhang et al. 2024)."""

from bokehguide.restir.spatial_reuse import SpatialReuse

__all__ = ["SpatialReuse"]
