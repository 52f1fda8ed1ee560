"""What a scene may read: which files, and how much they may unfold to."""

from __future__ import annotations

from pathlib import Path

from bokehguide.errors import BokehguideError
from bokehguide.limits import most_values
from bokehguide.scene.tables import Table, shown


class SceneFiles:
    """The files below one folder, and all that their images come to.

    A scene that somebody else made must neither look into the rest of the disk nor fill the memory.

    folder: that of the scene file, or of the model that is a scene by itself. allow_outside:
    whether paths may lead out of it, as parts, absolutely or over a link.
    """

    def __init__(self, folder: Path, allow_outside: bool = False):
        self.folder, self.allow_outside = folder.resolve(), allow_outside
        self._values = self._stored = 0

    def find(self, folder: Path, name: str, place: str) -> Path:
        """The path of the file that is called `name` in the text of a file in `folder`.

        place: where that stands. Raises BokehguideError where the path leads out of the scene's
        folder, whether there is such a file or not, and where no path can be so.
        """
        path = folder / name
        if not name.isprintable():
            raise BokehguideError(f"{place}: {shown(name)} is no path (control characters); repair it")
        try:
            inside = path.resolve().is_relative_to(self.folder)
        except (OSError, RuntimeError, ValueError) as error:  # RuntimeError: links in a circle
            reason = getattr(error, "strerror", None) or shown(str(error))
            raise BokehguideError(f"{place}: {shown(name)} is no path ({reason}); repair it") from None
        if not inside and not self.allow_outside:
            raise BokehguideError(
                f"{place}: {shown(name)} lies outside the scene's folder; copy it there, or give --allow-outside"
            )
        return path

    def named(self, table: Table, key: str) -> Path:
        """The path that the text `key` of a scene file's table names, as `find` gives it."""
        return self.find(Path(table.file).parent, table.text(key), table.place(key))

    def unfold(self, values: int, stored: int, place: str) -> None:
        """Count an image of so many `values`, kept in so many bytes.

        Raises BokehguideError, naming `place`, where the scene's images come to too much.
        """
        self._values, self._stored = self._values + values, self._stored + stored
        if self._values > most_values(self._stored):
            raise BokehguideError(
                f"{place}: the scene's images would unfold from {self._stored:,} bytes to {self._values:,} values, "
                "which no picture needs; give smaller ones"
            )


def require_file(path: Path, what: str) -> None:
    """Raise BokehguideError unless `path` is a file that can be read."""
    try:
        if path.is_dir():
            raise BokehguideError(f"{path}: is a folder; give a file ({what})")
        if not path.exists():
            raise BokehguideError(f"{path}: no such file ({what}); check the path")
        if not path.is_file():  # a pipe could keep a render waiting for ever
            raise BokehguideError(f"{path}: is no regular file; give one ({what})")
        path.open("rb").close()
    except OSError as error:
        raise BokehguideError(f"{shown(str(path))}: cannot be read ({error.strerror}); {what}") from None
