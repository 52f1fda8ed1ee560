"""Folders of the files that a command writes."""

from __future__ import annotations

from pathlib import Path

from bokehguide.cli.terminal import say
from bokehguide.image import make_folder


def make_folders(folders: list[Path]) -> list[Path]:
    """Create each folder that is missing in an existing one; returns these. Raises BokehguideError as `make_folder`."""
    return [folder for folder in folders if make_folder(folder)]


def print_folders(created: list[Path]) -> None:
    """Print the folders that the command has created on stderr."""
    for folder in created:
        say(f"created the folder {folder}")
