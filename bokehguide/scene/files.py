"""The files that a scene may read, and the memory that its images may take."""

from __future__ import annotations

from pathlib import Path

from bokehguide.errors import BokehguideError
from bokehguide.limits import most_values
from bokehguide.scene.tables import Table, shown


class SceneFiles:
    """Access to the files below one folder, with a budget for decoded images.

    A downloaded scene must neither read the rest of the disk nor exhaust the memory.

    folder: of the scene file, or of a model that is rendered alone. allow_outside: permits paths
    that leave the folder by "..", by an absolute path or by a link.
    """

    def __init__(self, folder: Path, allow_outside: bool = False):
        self.folder, self.allow_outside = folder.resolve(), allow_outside
        self._values = self._stored = 0

    def find(self, folder: Path, name: str, place: str) -> Path:
        """The path of the file `name`, which is relative to `folder`.

        place: location of the name, for errors. Raises BokehguideError for an invalid path and for
        a path outside the scene's folder, even if no such file exists.
        """
        path = folder / name
        if not name.isprintable():
            raise BokehguideError(f"{place}: {shown(name)} is no path (control characters); repair it")
        try:
            inside = path.resolve().is_relative_to(self.folder)
        except (OSError, RuntimeError, ValueError) as error:  # RuntimeError: a cycle of links
            reason = getattr(error, "strerror", None) or shown(str(error))
            raise BokehguideError(f"{place}: {shown(name)} is no path ({reason}); repair it") from None
        if not inside and not self.allow_outside:
            raise BokehguideError(
                f"{place}: {shown(name)} lies outside the scene's folder; copy it there, or give --allow-outside"
            )
        return path

    def named(self, table: Table, key: str, what: str) -> Path:
        """The file under `key` of a scene file's table, relative to that file; what: its kind, for errors.

        Raises as `find` does, and as `require_file` does with the scene file and the key in front.
        """
        place = table.place(key)
        path = self.find(Path(table.file).parent, table.text(key), place)
        require_file(path, what, f"{place}: ")
        return path

    def reserve(self, values: int, stored: int, place: str) -> None:
        """Add an image of `values` numbers, stored in `stored` bytes, to the budget.

        Raises BokehguideError, naming `place`, if the scene's images exceed the budget.
        """
        self._values, self._stored = self._values + values, self._stored + stored
        if self._values > most_values(self._stored):
            raise BokehguideError(
                f"{place}: the scene's images would decode from {self._stored:,} bytes to {self._values:,} values, "
                "more than any picture needs; give smaller images"
            )


def require_file(path: Path, what: str, place: str = "") -> None:
    """Raise BokehguideError unless `path` is a readable regular file.

    what: the kind of file, for the message. place: stands before the path in the message, such as a key and ": ".
    """
    try:
        if path.is_dir():
            raise BokehguideError(f"{place}{path}: is a folder; give a file ({what})")
        if not path.exists():
            raise BokehguideError(f"{place}{path}: no such file ({what}); check the path")
        if not path.is_file():  # reading a pipe could block for ever
            raise BokehguideError(f"{place}{path}: is no regular file; give one ({what})")
        path.open("rb").close()
    except OSError as error:
        raise BokehguideError(f"{place}{shown(str(path))}: cannot be read ({error.strerror}); {what}") from None
