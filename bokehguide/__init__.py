"""Defocused photographs by path tracing with guided lens sampling."""

__version__ = "0.3.0"
