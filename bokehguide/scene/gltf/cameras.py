"""Cameras of a glTF file in world space."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bokehguide.errors import printable
from bokehguide.scene.gltf.document import Document
from bokehguide.scene.gltf.nodes import Placed
from bokehguide.scene.model import ModelCamera
from bokehguide.scene.tables import Limits
from bokehguide.scene.types import as_vector

FIELD_OF_VIEW = Limits("radians between 0 and pi", low=1e-4, high=math.pi - 1e-4)


def read_cameras(document: Document, placed: Sequence[Placed]) -> list[ModelCamera]:
    """All perspective cameras of the scene, in the order of the node tree.

    The name is the node's, or the camera's if the node has none. Raises BokehguideError for a field
    of view that is missing or out of range.
    """
    cameras = []
    for node in placed:
        index = document.link(node.node, "camera", "cameras")
        if index is None:
            continue
        camera = document.items("cameras")[index]
        name = node.node.label if "name" in node.node else printable(camera.text("name")) or f"camera {len(cameras)}"
        if camera.values.get("type") != "perspective":
            document.note("orthographic cameras: left out", name)
            continue
        axes = node.matrix[:3, :3]
        lengths = np.linalg.norm(axes, axis=0)
        if not (lengths > 0.0).all() or not np.isfinite(lengths).all():
            document.note("cameras with a scale of 0: left out", name)
            continue
        if np.linalg.det(axes / lengths) < 0.0:
            document.note("mirrored cameras: the picture is not mirrored", name)
        cameras.append(
            ModelCamera(
                name=name,
                position=as_vector(node.matrix[:3, 3]),
                forward=as_vector(-axes[:, 2] / lengths[2]),
                up=as_vector(axes[:, 1] / lengths[1]),
                vertical_fov=math.degrees(camera.part("perspective").number("yfov", None, FIELD_OF_VIEW)),
            )
        )
    return cameras
