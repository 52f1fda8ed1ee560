"""The files that a scene may read, and the memory that its images may take."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from bokehguide.errors import BokehguideError, encoding_problem
from bokehguide.limits import FREE_INSTANCES, FREE_MESHES, MESH_BYTES, most_decoded, most_triangles, most_values
from bokehguide.memory import require_memory
from bokehguide.scene.tables import Table, shown

KINDS = {"file": "model", "image": "image", "base": "scene", "aperture_image": "image"}
"""The kinds of files by the keys that name them; other keys name textures."""
VALUE_BYTES, GEOMETRY_BYTES = 6, 2
"""Memory for each value of an image while an image of 8 bits is decoded, and least memory for each byte of a file with geometry:
the file and its arrays."""

LFS_POINTER = b"version https://git-lfs.github.com/spec/"
"""Begin of the small files that stand for large ones in a clone without Git LFS."""


class SceneFiles:
    """Access to the files below one folder, with a budget for decoded images.

    A downloaded scene must neither read the rest of the disk nor exhaust the memory.

    folder: of the scene file, or of a model that is rendered alone. allow_outside: permits paths
    that leave the folder by "..", by an absolute path or by a link.
    """

    def __init__(self, folder: Path, allow_outside: bool = False):
        self.folder, self.allow_outside = folder.resolve(), allow_outside
        self._searched: list[Path] = []
        self.found: set[Path] = set()
        """Resolved paths that `find` has returned. Some files may be missing."""
        self._values = self._stored = 0
        self._decoded = self._compressed = 0
        """Bytes of buffers after and before their decompression."""
        self._geometry = 0
        """Bytes of the files with geometry that were read."""
        self._images: dict[tuple[bytes, bool, bool], np.ndarray] = {}
        """Decoded images by the digest of their files, by `srgb` and by `alpha`."""

    def find(self, folder: Path, name: str, place: str) -> Path:
        """The path of the file `name`, which is relative to a folder of `search_first` or to `folder`.

        place: location of the name, for errors. Raises BokehguideError for an invalid path and for
        a path outside the scene's folder, even if no such file exists.
        """
        if not name.isprintable():
            raise BokehguideError(f"{place}: {shown(name)} is no path (control characters); write / between folders")
        if problem := encoding_problem(name):
            raise BokehguideError(f"{place}: {shown(name)} {problem}")
        try:
            path = next((each / name for each in self._searched if (each / name).is_file()), folder / name)
            resolved = path.resolve()
        except (OSError, RuntimeError, ValueError) as error:  # RuntimeError: a cycle of links
            reason = getattr(error, "strerror", None) or shown(str(error))
            raise BokehguideError(f"{place}: {shown(name)} is no path ({reason}); repair it") from None
        if not self.allow_outside and not resolved.is_relative_to(self.folder):
            raise BokehguideError(
                f"{place}: {shown(name)} lies outside the scene's folder; copy it there, or give --allow-outside"
            )
        self.found.add(resolved)
        return path

    def search_first(self, folder: Path) -> None:
        """Let `find` look for files in `folder` before all other folders."""
        self._searched.insert(0, folder)

    def named(self, table: Table, key: str) -> Path:
        """The path of the file under `key` of a scene file's table, relative to that file.

        Raises as `find` and `require_file` do, naming the table's file and the key.
        """
        path = self.find(Path(table.file).parent, table.text(key), table.place(key))
        if key in ("map", "environment"):
            require_map(path, table.place(key))
        else:
            require_file(path, KINDS.get(key, "texture"), table.place(key))
        return path

    def read(self, path: Path) -> bytes:
        """The bytes of a file with geometry. Raises OSError, and BokehguideError as `add_file` does."""
        self.add_file(path)
        return path.read_bytes()

    def add_file(self, path: Path) -> None:
        """Count a file with geometry, before it is read. Small files may make fewer triangles than large ones.

        Raises OSError, and BokehguideError for a file that is too large for the memory.
        """
        stored = path.stat().st_size
        require_memory(GEOMETRY_BYTES * stored, str(path), "smaller file")
        self.add_geometry(stored)

    def add_geometry(self, stored: int) -> None:
        """Count `stored` bytes of geometry."""
        self._geometry += stored

    @property
    def used(self) -> tuple[int, int, int]:
        """Bytes of geometry, and values and bytes of images, that were read."""
        return self._geometry, self._values, self._stored

    def add_used(self, used: tuple[int, int, int], place: str) -> None:
        """Count what another process `used`. Raises BokehguideError, naming `place`, if the images exceed the budget."""
        geometry, values, stored = used
        self.add_geometry(geometry)
        self._add_image(values, stored, place)

    @property
    def most_triangles(self) -> int:
        """Triangles that the scene may have."""
        return most_triangles(self._geometry)

    @property
    def most_instances(self) -> int:
        """Instances that the scene may have."""
        return FREE_INSTANCES + self._geometry

    @property
    def most_meshes(self) -> int:
        """Meshes that the scene may have."""
        return FREE_MESHES + self._geometry // MESH_BYTES

    def image(self, data: bytes, srgb: bool, alpha: bool, decode: Callable[[], np.ndarray]) -> np.ndarray:
        """The pixels of the image file `data`, decoded once for each combination of colour space and alpha."""
        key = (hashlib.sha256(data).digest(), srgb, alpha)
        if key not in self._images:
            self._images[key] = decode()
        return self._images[key]

    def reserve(self, values: int, stored: int, place: str) -> None:
        """Add an image of `values` numbers, stored in `stored` bytes, to the budget, before it is decoded.

        Raises BokehguideError, naming `place`, if the scene's images exceed the budget, and if this image exceeds the memory.
        """
        self._add_image(values, stored, place)
        require_memory(VALUE_BYTES * values, place, "smaller image")

    def _add_image(self, values: int, stored: int, place: str) -> None:
        """Add an image to the budget."""
        self._values, self._stored = self._values + values, self._stored + stored
        if self._values > most_values(self._stored):
            raise BokehguideError(
                f"{place}: the scene's images would decode from {self._stored:,} bytes to {self._values:,} values, "
                "more than any picture needs; give smaller images"
            )

    def reserve_decoded(self, decoded: int, stored: int, place: str) -> None:
        """Add a buffer of `decoded` bytes, compressed to `stored` bytes, to the budget.

        Raises BokehguideError, naming `place`, if the scene's buffers exceed the budget.
        """
        self._decoded, self._compressed = self._decoded + decoded, self._compressed + stored
        if self._decoded > most_decoded(self._compressed):
            raise BokehguideError(
                f"{place}: the scene's buffers would decode from {self._compressed:,} to {self._decoded:,} bytes, "
                "more than any mesh needs; save the file uncompressed"
            )


def is_file(name: str | os.PathLike[str]) -> bool:
    """Whether a text is the path of a regular file. A text that is too long for a path is none."""
    try:
        return Path(name).is_file()
    except OSError:
        return False


def require_map(path: Path, place: str = "") -> None:
    """As `require_file`, for an environment map, whose format its suffix names."""
    if path.suffix.lower() not in (".hdr", ".exr"):
        raise BokehguideError(f"{f'{place}: ' if place else ''}{path}: not an environment map; give a .hdr or .exr file")
    require_file(path, "environment map", place)


def require_file(path: Path, what: str, place: str = "") -> None:
    """Raise BokehguideError unless `path` is a readable regular file.

    what: the kind of file; place: where the path is named, such as a key of a scene file; for the message.
    """
    start = f"{place}: " if place else ""
    try:
        if path.is_dir():
            raise BokehguideError(f"{start}{path}: is a folder; give a file ({what})")
        if not path.exists():
            raise BokehguideError(f"{start}{path}: no such file ({what}); check the path")
        if not path.is_file():  # reading a pipe could block for ever
            raise BokehguideError(f"{start}{path}: is no regular file; give one ({what})")
        with path.open("rb") as file:
            pointer = file.read(len(LFS_POINTER)) == LFS_POINTER
    except OSError as error:
        raise BokehguideError(f"{start}{shown(str(path))}: cannot be read ({error.strerror}); {what}") from None
    if pointer:
        raise BokehguideError(f"{start}{path}: is a pointer of Git LFS, not the file itself ({what}); run git lfs pull")
