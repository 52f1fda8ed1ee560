"""BSDFs: opaque surfaces, dielectric surfaces, and the mixture of both."""
