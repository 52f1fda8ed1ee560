"""KHR_draco_mesh_compression."""

import DracoPy
import numpy as np
import pytest

from bokehguide.errors import BokehguideError
from bokehguide.scene import load_scene
from tests.support.gltf_builder import INDICES, SQUARE, UVS, Builder

DRACO = "KHR_draco_mesh_compression"


def compressed(data: bytes, **attributes: int) -> Builder:
    """A square whose accessors have no data of their own."""
    builder = Builder()
    kinds = {"POSITION": SQUARE, "TEXCOORD_0": UVS}
    numbers = {name: builder.accessor(kinds[name], bufferView=None) for name in attributes}
    builder.mesh(indices=builder.accessor(INDICES, bufferView=None), **numbers)
    extension = {"bufferView": builder.view(data), "attributes": attributes}
    builder.gltf.meshes[0].primitives[0].extensions = {DRACO: extension}
    builder.gltf.extensionsRequired.append(DRACO)
    builder.node(mesh=0, translation=[0, 0, 3])
    return builder


def packed() -> bytes:
    triangles = INDICES.reshape(2, 3).astype(np.uint32)
    return DracoPy.encode(SQUARE, triangles, quantization_bits=0, tex_coord=UVS.astype(np.float64))


def test_a_packed_mesh(tmp_path):
    kinds = {a["attribute_type"]: a["unique_id"] for a in DracoPy.decode(packed()).attributes}
    builder = compressed(packed(), POSITION=kinds[0], TEXCOORD_0=kinds[3])
    (mesh,) = load_scene(builder.save(tmp_path / "packed.glb")).meshes
    corners = mesh.vertices[mesh.triangles].reshape(-1, 3) - [0, 0, 3]
    order = [np.flatnonzero((corner == SQUARE).all(axis=1))[0] for corner in corners]
    assert sorted(map(sorted, np.reshape(order, (2, 3)).tolist())) == [[0, 1, 2], [0, 2, 3]]
    np.testing.assert_allclose(mesh.uvs[mesh.triangles].reshape(-1, 2), UVS[order], atol=1e-3)


def test_an_attribute_that_is_not_in_there(tmp_path):
    with pytest.raises(BokehguideError, match=r"bad\.glb: .*attributes\.POSITION: 9 is not among the packed"):
        load_scene(compressed(packed(), POSITION=9).save(tmp_path / "bad.glb"))


@pytest.mark.parametrize("data", [b"junk" * 9, b"DRACO\2\2\1\1" + bytes(40)])
def test_damaged_data(tmp_path, data):
    with pytest.raises(BokehguideError, match=rf"bad\.glb: meshes\[0\]\.primitives\[0\]: damaged {DRACO}") as caught:
        load_scene(compressed(data, POSITION=0).save(tmp_path / "bad.glb"))
    assert "\n" not in str(caught.value)
