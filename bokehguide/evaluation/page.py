"""Page and fonts of all figures."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from bokehguide.image import replacing

WIDTH = 7.2
"""Inches, across the two columns of a page."""
DPI = 300
SMALL, NORMAL = 6.5, 7.5
"""Font sizes in points."""


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG. Raises BokehguideError if the folder cannot be written."""
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=DPI, facecolor="white")
