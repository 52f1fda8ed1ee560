"""USD files as models."""

from bokehguide.scene.usd.loading import load_usd

__all__ = ["load_usd"]
