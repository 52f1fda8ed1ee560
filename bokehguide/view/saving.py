"""Files that the page saves, under names that no file has."""

from __future__ import annotations

from pathlib import Path

from bokehguide.view.job import Job
from bokehguide.view.pictures import finished
from bokehguide.view.state import Source, ViewState


def save(job: Job, state: ViewState, source: Source, folder: Path) -> str:
    """Write the picture as EXR and PNG; returns a note with their names. Raises BokehguideError."""
    exr, png = free_paths(folder, f"{source.scene.name}-view", (".exr", ".png"))
    picture = finished(job, state, source)
    picture.save(exr)
    picture.save(png)
    return f"wrote {exr.name} and {png.name}, {job.loop.step_number} SPP"


def free_paths(folder: Path, stem: str, suffixes: tuple[str, ...]) -> list[Path]:
    """Paths in a folder with these suffixes and the first of the names STEM, STEM-2, STEM-3, … that no file has."""
    number = 1
    while True:
        name = stem if number == 1 else f"{stem}-{number}"
        paths = [folder / f"{name}{suffix}" for suffix in suffixes]
        if not any(path.exists() for path in paths):
            return paths
        number += 1
