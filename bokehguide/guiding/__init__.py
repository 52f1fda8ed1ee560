"""Guided lens sampling: lens samplers, light strategies and sample reuse that learn during the render."""

from bokehguide.guiding.modes import register_mode

__all__ = ["register_mode"]
