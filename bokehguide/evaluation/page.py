"""What all figures share: the page they are for."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from bokehguide.image import replacing

WIDTH = 7.2
"""Inches: the two columns of a page."""
DPI = 300
SMALL, NORMAL = 6.5, 7.5
"""Points of the letters."""


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG. Raises BokehguideError where the folder cannot be written."""
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=DPI, facecolor="white")
