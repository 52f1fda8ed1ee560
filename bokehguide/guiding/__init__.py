"""Guided lens sampling: lens samplers, light strategies and sample reuse that learn during the render."""
