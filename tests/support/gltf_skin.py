"""A skinned square for tests."""

from __future__ import annotations

import numpy as np
import pygltflib

from tests.support.gltf_builder import Builder

NORMALS = np.array([[0, 0, 1]] * 4, np.float32)
JOINTS = np.array([[0, 1, 0, 0]] * 4, np.uint8)
LEFT_AND_RIGHT = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 1, 0, 0], [1, 0, 0, 0]], np.float32)
"""The square's left vertices follow joint 0, the right ones joint 1."""
TURNED = [0.0, 0.7071068, 0.0, 0.7071068]
"""A quarter about +y: z becomes x, and x becomes -z."""


def skinned(weights=LEFT_AND_RIGHT, joints=JOINTS, bind=None, first=None, second=None, **node) -> Builder:
    """A square on two joints, whose own node is far away; bind: inverse bind matrices `[2, 4, 4]`."""
    builder = Builder()
    mesh = builder.mesh(NORMAL=NORMALS, JOINTS_0=joints, WEIGHTS_0=weights)
    builder.node(mesh=mesh, **({"skin": 0, "translation": [100.0, 0.0, 0.0]} | node))
    inner = builder.node(root=False, **(second or {}))
    outer = builder.node(children=[inner], **(first or {}))
    skin = pygltflib.Skin(joints=[outer, inner])
    if bind is not None:
        columns = np.ascontiguousarray(np.asarray(bind, np.float32).transpose(0, 2, 1)).reshape(-1, 16)
        view = builder.view(columns.tobytes())
        builder.gltf.accessors.append(pygltflib.Accessor(bufferView=view, componentType=5126, count=len(columns), type="MAT4"))
        skin.inverseBindMatrices = len(builder.gltf.accessors) - 1
    builder.gltf.skins.append(skin)
    return builder
