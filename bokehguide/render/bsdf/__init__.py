"""BSDFs: opaque, dielectric, and their mixture."""
