"""Builds the extension for Blender with the sources of bokehguide: `python integrations/blender/build.py [FOLDER]`."""

from __future__ import annotations

import io
import sys
import tomllib
import zipfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
ADDON = HERE / "bokehguide_blender"
SOURCES = ("bokehguide", "native", "pyproject.toml", "README.md", "LICENSE")
"""The parts of the repository that an installation needs."""
PATTERNS = ("*.py", "*.typed", "*.html", "*.css", "*.js", "*.svg", "*.cpp", "*.h", "CMakeLists.txt")
"""Names of sources in folders; other files are products of a build."""
DATE = (1980, 1, 1, 0, 0, 0)
"""The same for all files, so that equal sources make equal archives."""


def main(folder: Path) -> Path:
    """Write the .zip into `folder`; returns its path."""
    manifest = tomllib.loads((ADDON / "blender_manifest.toml").read_text(encoding="utf-8"))
    path = folder / f"{manifest['id']}-{manifest['version']}.zip"
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in (*sorted(ADDON.glob("*.py")), ADDON / "blender_manifest.toml"):
            _add(archive, file.name, file.read_bytes())
        _add(archive, "LICENSE", (ROOT / "LICENSE").read_bytes())
        _add(archive, "bokehguide-source.zip", sources())
    return path


def sources() -> bytes:
    """A .zip of bokehguide's sources, which pip can install."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for start in map(ROOT.joinpath, SOURCES):
            found = [start] if start.is_file() else sorted(file for pattern in PATTERNS for file in start.rglob(pattern))
            for file in found:
                _add(archive, f"bokehguide-source/{file.relative_to(ROOT).as_posix()}", file.read_bytes())
    return stream.getvalue()


def _add(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    """Add a file with a fixed date."""
    archive.writestr(zipfile.ZipInfo(name, DATE), data, zipfile.ZIP_DEFLATED)


if __name__ == "__main__":
    print(main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "out"))
