"""The world lights and shows as in Cycles."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
import scenes


def world_map(folder, suffix, rotation=0.0, kind="POINT"):
    """A map with a different colour in each part, in a file or within Blender; returns the mapping node."""
    tree = scenes.world(strength=0.7)
    rows, columns = np.mgrid[0:32, 0:64]
    colors = np.stack(((columns // 8) / 8.0, (rows // 8) / 4.0, ((columns + rows) // 16 % 2) * 0.5, np.ones((32, 64))), axis=-1)
    image = bpy.data.images.new("map", 64, 32, float_buffer=suffix != ".png")
    image.pixels.foreach_set(colors.astype(np.float32).ravel())
    if suffix:
        image.filepath_raw = str(folder / f"map{suffix}")
        image.file_format = {".exr": "OPEN_EXR", ".hdr": "HDR", ".png": "PNG"}[suffix]
        image.save()
        image = bpy.data.images.load(image.filepath_raw)
    texture = tree.nodes.new("ShaderNodeTexEnvironment")
    mapping, coordinates = tree.nodes.new("ShaderNodeMapping"), tree.nodes.new("ShaderNodeTexCoord")
    texture.image, texture.interpolation, mapping.vector_type = image, "Closest", kind
    mapping.inputs["Rotation"].default_value[2] = rotation
    tree.links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
    tree.links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
    tree.links.new(texture.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    return mapping


MAPS = {"exr": (".exr", 0.0, "POINT"), "hdr turned": (".hdr", 0.6, "POINT"), "texture mapping": (".exr", 0.6, "TEXTURE")}
MAPS |= {"in Blender": ("", -1.1, "POINT"), "8 bits": (".png", 2.0, "POINT")}


@pytest.mark.parametrize("name", MAPS)
def test_map(scene, tmp_path, name):
    world_map(tmp_path, *MAPS[name])
    scenes.camera((0, 0, 0), (0.4, 1.0, 0.2), lens=14.0)
    cycles, ours = scenes.both(tmp_path, samples=16)
    assert cycles[..., :3].std() > 0.1
    assert np.median(np.abs(ours - cycles)) < 0.01
    assert np.abs(ours - cycles).mean() < 0.05  # the texels of bokehguide are interpolated


def test_map_in_another_color_space(scene, tmp_path):
    """Blender converts maps of floats."""
    mapping = world_map(tmp_path, ".exr")
    texture = mapping.outputs["Vector"].links[0].to_node
    texture.image.colorspace_settings.name = "ACEScg"
    scenes.camera((0, 0, 0), (0.4, 1.0, 0.2), lens=14.0)
    cycles, ours = scenes.both(tmp_path, samples=16)
    assert np.median(np.abs(ours - cycles)) < 0.01
    texture.image.colorspace_settings.name = "Linear Rec.709"
    other = scenes.colors(scenes.render("CYCLES", tmp_path, samples=16))
    assert np.median(np.abs(other - cycles)) > 0.02


def test_map_of_8_bits_in_another_color_space_is_told(scene, tmp_path, capfd):
    mapping = world_map(tmp_path, ".png")
    mapping.outputs["Vector"].links[0].to_node.image.colorspace_settings.name = "Display P3"
    scenes.camera()
    scenes.render("BOKEHGUIDE", tmp_path, size=(8, 8), samples=1)
    assert "of 8 bits is taken as sRGB, not as Display P3" in "".join(capfd.readouterr())


def test_light_of_the_map(scene, tmp_path):
    world_map(tmp_path, ".exr", 0.3)
    scenes.mesh("uv_sphere", location=(0, 0, 0), segments=64, ring_count=32)
    bpy.ops.object.shade_smooth()
    scenes.camera((0, -4, 1), lens=90.0)
    cycles, ours = scenes.both(tmp_path, samples=256)
    assert ours[..., :3].mean() == pytest.approx(cycles[..., :3].mean(), rel=0.02)
    np.testing.assert_allclose(ours[20:44, 30:66, :3].mean((0, 1)), cycles[20:44, 30:66, :3].mean((0, 1)), rtol=0.02)


@pytest.mark.parametrize("hidden", [False, True])
def test_color(scene, tmp_path, hidden):
    scenes.world((0.5, 0.25, 1.0), 3.0)
    scene.render.film_transparent = hidden
    scenes.mesh("plane", size=1.0)
    scenes.camera((0, -2, 2))
    cycles, ours = scenes.both(tmp_path, samples=128)
    np.testing.assert_allclose(ours.mean((0, 1)), cycles.mean((0, 1)), rtol=0.02)


def test_unknown_nodes_are_told(scene, tmp_path, capfd):
    tree = scenes.world()
    sky = tree.nodes.new("ShaderNodeTexSky")
    tree.links.new(sky.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    scenes.camera()
    scenes.render("BOKEHGUIDE", tmp_path, samples=1)
    assert "use an Environment Texture" in "".join(capfd.readouterr())


@pytest.mark.parametrize("transparent", [False, True])
def test_alpha_without_a_world(scene, tmp_path, transparent):
    """A black world is opaque, unless it is made transparent."""
    scene.render.film_transparent = transparent
    scenes.mesh("cube")
    scenes.light("POINT")
    scenes.camera()
    cycles, ours = scenes.both(tmp_path, samples=16)
    assert cycles[..., 3].min() == (0.0 if transparent else 1.0)
    assert np.abs(ours[..., 3] - cycles[..., 3]).max() < 0.3
    assert np.abs(ours[..., 3] - cycles[..., 3]).mean() < 0.01
