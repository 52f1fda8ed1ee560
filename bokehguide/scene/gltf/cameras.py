"""A glTF file's cameras, where their nodes put them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bokehguide.errors import printable
from bokehguide.scene.gltf.document import Document
from bokehguide.scene.gltf.nodes import Placed
from bokehguide.scene.tables import Limits
from bokehguide.scene.types import ModelCamera

FIELD_OF_VIEW = Limits("radians between 0 and pi", low=1e-4, high=math.pi - 1e-4)


def read_cameras(document: Document, placed: Sequence[Placed]) -> list[ModelCamera]:
    """Every perspective camera of the scene, in the order of the node tree.

    A camera is called as its node, or as itself where the node has no name. Raises
    BokehguideError for a field of view out of range.
    """
    cameras = []
    for node in placed:
        index = document.link(node.node, "camera", "cameras")
        if index is None:
            continue
        camera = document.items("cameras")[index]
        name = node.node.label if "name" in node.node else printable(camera.text("name") or "") or f"camera {len(cameras)}"
        if camera.values.get("type") != "perspective":
            document.note("orthographic cameras: left out", name)
            continue
        axes = node.matrix[:3, :3]
        lengths = np.linalg.norm(axes, axis=0)
        if not (lengths > 0.0).all() or not np.isfinite(lengths).all():
            document.note("cameras that are scaled to nothing: left out", name)
            continue
        if np.linalg.det(axes / lengths) < 0.0:
            document.note("mirrored cameras: the picture is not mirrored", name)
        yfov = camera.part("perspective").number("yfov", None, FIELD_OF_VIEW)
        if yfov is None:
            camera.part("perspective").fail("yfov", "")
        cameras.append(ModelCamera(
            name=name,
            position=tuple(map(float, node.matrix[:3, 3])),
            forward=tuple(map(float, -axes[:, 2] / lengths[2])),
            up=tuple(map(float, axes[:, 1] / lengths[1])),
            vertical_fov=math.degrees(yfov),
        ))
    return cameras
