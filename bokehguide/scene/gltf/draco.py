"""KHR_draco_mesh_compression, decoded by DracoPy."""

from __future__ import annotations

import DracoPy
import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.scene.gltf.document import Document
from bokehguide.scene.gltf.parts import Part
from bokehguide.stopping import default_signals

DRACO = "KHR_draco_mesh_compression"


def read_draco(document: Document, primitive: Part) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Attributes `[V, width]` by their glTF names, in their stored types, and indices int64.

    Raises BokehguideError if the data are damaged.
    """
    packed = primitive.extension(DRACO)
    view = document.required(packed, "bufferView", "bufferViews")
    try:
        with default_signals():  # the decoder may hold the interpreter's lock
            mesh = DracoPy.decode(bytes(document.view(view)))
    except (DracoPy.FileTypeException, ValueError, RuntimeError) as error:
        place = f"{document.file}: {primitive.path}"
        raise BokehguideError(f"{place}: damaged {DRACO} ({error}); fetch the file again") from None
    by_id = {attribute["unique_id"]: attribute["data"] for attribute in mesh.attributes}
    names = packed.part("attributes")
    arrays = {}
    for name in names.values:
        if names.whole(name, None) not in by_id:
            names.fail(name, f"is not among the packed attributes {sorted(by_id)}; repair the file")
        arrays[name] = np.asarray(by_id[names.whole(name, 0)])
    faces = getattr(mesh, "faces", np.arange(len(mesh.points)))  # point clouds have no faces
    return arrays, np.asarray(faces, dtype=np.int64).reshape(-1)
