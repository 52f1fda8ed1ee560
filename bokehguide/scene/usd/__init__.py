"""USD files as models."""

from bokehguide.scene.usd.isolation import load_usd

__all__ = ["load_usd"]
