"""Materials look as in Cycles, and losses are told by name."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
import scenes


def test_materials(scene, tmp_path):
    """Emission, metal and gloss have the brightness of Cycles."""
    scenes.world((0.6, 0.6, 0.6))
    made = {
        "emission": scenes.material("emission", (1.0, 0.5, 0.2), emission=2.0),
        "metal": scenes.material("metal", (0.9, 0.6, 0.3), Metallic=1.0, Roughness=0.3),
        "gloss": scenes.material("gloss", (0.1, 0.3, 0.8), Roughness=0.4, Specular_IOR_Level=0.5),
    }
    for x, each in zip((-1.2, 0.0, 1.2), made.values()):
        scenes.mesh("uv_sphere", each, radius=0.5, location=(x, 0, 0), segments=64, ring_count=32)
        bpy.ops.object.shade_smooth()
    scenes.camera((0, -6, 0), lens=50.0)
    cycles, ours = scenes.both(tmp_path, samples=256)
    for number in range(3):
        columns = slice(12 + 25 * number, 32 + 25 * number)
        means = [each[22:42, columns, :3].mean((0, 1)) for each in (cycles, ours)]
        print(list(made)[number], means[1] / means[0])
        np.testing.assert_allclose(means[1], means[0], rtol=0.06)


def test_glass_refracts(scene, tmp_path):
    """A glass sphere shows the bright half of the world upside down, and a thin sheet shows it upright."""
    scenes.mesh("plane", scenes.material("sky", emission=1.0), size=40, location=(0, 10, 20), rotation=(1.5708, 0, 0))
    glass = scenes.material("glass", (1, 1, 1), Roughness=0.0, Transmission_Weight=1.0, Specular_IOR_Level=0.5)
    scenes.mesh("uv_sphere", glass, radius=1.0, segments=64, ring_count=32)
    bpy.ops.object.shade_smooth()
    scenes.camera((0, -6, 0), lens=60.0)
    for picture in scenes.both(tmp_path, samples=64):
        upper, lower = picture[20:28, 40:56, 1].mean(), picture[36:44, 40:56, 1].mean()
        print("upper", upper, "lower", lower)
        assert lower > 4.0 * upper


def shader(name, kind, **inputs):
    """A material with a shader node at its output; returns the material and the node."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    tree = made.node_tree
    node = tree.nodes.new(kind)
    for key, value in inputs.items():
        node.inputs[key].default_value = value
    tree.links.new(node.outputs[0], tree.nodes["Material Output"].inputs["Surface"])
    return made, node


SIMPLE = {
    "diffuse": ("ShaderNodeBsdfDiffuse", {"Color": (0.7, 0.3, 0.1, 1.0)}),
    "glossy": ("ShaderNodeBsdfAnisotropic", {"Color": (0.7, 0.6, 0.3, 1.0), "Roughness": 0.3}),
    "glass": ("ShaderNodeBsdfGlass", {"Color": (1.0, 1.0, 1.0, 1.0), "Roughness": 0.0, "IOR": 1.3}),
    "emission": ("ShaderNodeEmission", {"Color": (0.7, 0.6, 0.3, 1.0), "Strength": 2.0}),
}


@pytest.mark.parametrize("name", SIMPLE)
def test_shader_nodes(scene, tmp_path, capfd, name):
    """A sphere between a dark floor and a bright world, of each shader that becomes a glTF material."""
    kind, inputs = SIMPLE[name]
    scenes.world((0.6, 0.7, 0.8))
    scenes.mesh("plane", scenes.material("floor", (0.1, 0.1, 0.1)), size=4, location=(0, 0, -1))
    scenes.mesh("uv_sphere", shader(name, kind, **inputs)[0], radius=0.8, segments=64, ring_count=32)
    bpy.ops.object.shade_smooth()
    scenes.camera((0, -5, 1), lens=60.0)
    cycles, ours = (each[16:48, 32:64, :3] for each in scenes.both(tmp_path, samples=256))
    print(name, ours.mean((0, 1)) / cycles.mean((0, 1)))
    np.testing.assert_allclose(ours.mean((0, 1)), cycles.mean((0, 1)), rtol=0.03)
    assert np.abs(ours - cycles).mean() < 0.08 * cycles.mean()
    assert "lose their look" not in "".join(capfd.readouterr())


def image(name, space="sRGB", floats=False):
    made = bpy.data.images.new(name, 4, 4, float_buffer=floats)
    made.colorspace_settings.name = space
    return made


def textured(name, picture=None, socket="Base Color", between=None, output=0):
    """A material with an image at an input, perhaps beyond another node; returns the material, the image node and the other."""
    made = scenes.material(name)
    tree = made.node_tree
    texture = tree.nodes.new("ShaderNodeTexImage")
    texture.image = picture or image(f"{name}.png")
    last, node = texture.outputs[output], None
    if between:
        node = tree.nodes.new(between)
        tree.links.new(last, next(each for each in node.inputs if each.name in ("Color", "Fac", "Factor", "Height")))
        last = node.outputs[0]
    tree.links.new(last, tree.nodes["Principled BSDF"].inputs[socket])
    return made, texture, node


def told(folder, capfd, *materials):
    """The warnings of a render of cubes with these materials."""
    scenes.world((0.5, 0.5, 0.5))
    for each in materials:
        scenes.mesh("cube", each)
    scenes.camera()
    capfd.readouterr()
    scenes.render("BOKEHGUIDE", folder, size=(8, 8), samples=1)
    return "".join(capfd.readouterr())


def test_nodes_that_are_lost_are_told(scene, tmp_path, capfd):
    ramp, curves = (textured(name, between=f"ShaderNode{kind}")[0] for name, kind in (("a", "ValToRGB"), ("b", "RGBCurve")))
    bump = textured("c", image("height", "Non-Color"), "Normal", "ShaderNodeBump")[0]
    noise = scenes.material("d")
    tree = noise.node_tree
    tree.links.new(tree.nodes.new("ShaderNodeTexNoise").outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    said = told(tmp_path, capfd, ramp, curves, bump, noise)
    assert "nodes of materials are ignored; bake them to images: a (Color Ramp), b (RGB Curves), c (Bump) and 1 more" in said


def test_shaders_that_are_lost_are_told(scene, tmp_path, capfd):
    mixed = shader("mixed", "ShaderNodeMixShader")[0]
    linked, node = shader("linked", "ShaderNodeBsdfDiffuse")
    picture = linked.node_tree.nodes.new("ShaderNodeTexImage")
    linked.node_tree.links.new(picture.outputs[0], node.inputs["Color"])
    said = told(tmp_path, capfd, mixed, linked)
    assert "materials without a Principled BSDF at their output lose their look: mixed, linked" in said


def test_inputs_that_are_lost_are_told(scene, tmp_path, capfd):
    skin, brushed = scenes.material("skin", Subsurface_Weight=0.5), scenes.material("brushed", Anisotropic=0.5)
    rough = shader("rough", "ShaderNodeBsdfDiffuse", Roughness=0.5)[0]
    relief = scenes.material("relief")
    tree = relief.node_tree
    node = tree.nodes.new("ShaderNodeDisplacement")
    tree.links.new(node.outputs[0], tree.nodes["Material Output"].inputs["Displacement"])
    said = told(tmp_path, capfd, skin, brushed, rough, relief)
    expected = "skin (Subsurface Weight), brushed (Anisotropic), rough (Roughness)"
    assert f"inputs of shader nodes are ignored: {expected}" in said
    assert "inputs of Material Output nodes are ignored: relief (Displacement)" in said


@pytest.mark.parametrize("light", ["world", "lamp"])
@pytest.mark.parametrize("distribution", ["GGX", "MULTI_GGX"])
@pytest.mark.parametrize("roughness", [0.2, 0.6, 0.9])
def test_rough_metals_equal_those_of_cycles(scene, tmp_path, roughness, distribution, light):
    """Light from everywhere, or from a lamp, whose rear would hide the world from bokehguide alone."""
    metal = scenes.material("metal", (0.8, 0.6, 0.4), Metallic=1.0, Roughness=roughness)
    metal.node_tree.nodes["Principled BSDF"].distribution = distribution
    scenes.mesh("plane", metal, size=10)
    scenes.world((0.5, 0.5, 0.5) if light == "world" else (0.0, 0.0, 0.0))
    if light == "lamp":
        lamp = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "AREA"))
        lamp.location, lamp.data.energy, lamp.data.size = (0.5, 1.5, 2.0), 60.0, 1.5
        bpy.context.collection.objects.link(lamp)
    scenes.camera((0, -2, 2))
    cycles, ours = (each[..., :3].mean((0, 1)) for each in scenes.both(tmp_path, size=(24, 16), samples=256))
    print(light, roughness, distribution, ours / cycles)
    np.testing.assert_allclose(ours, cycles, rtol=0.02)


def test_images_that_are_lost_are_told(scene, tmp_path, capfd):
    wide = textured("wide", image("wide", "ACEScg"))[0]
    numbers = textured("numbers", image("rough", "sRGB"), "Roughness")[0]
    clipped, node, _ = textured("clipped")
    node.extension = "CLIP"
    said = told(tmp_path, capfd, wide, numbers, clipped)
    assert "images of colours are taken as 8-bit sRGB; convert them: wide (ACEScg)" in said
    assert "images of data are taken as Non-Color: rough (sRGB)" in said
    assert "other projections, coordinates and extensions are ignored: clipped.png" in said


SPACES = {
    "floats": ("Linear Rec.709", True),
    "floats in ACEScg": ("ACEScg", True),
    "numbers as colours": ("Non-Color", False),
}


@pytest.mark.parametrize("name", SPACES)
def test_colors_of_images(scene, tmp_path, capfd, name):
    """Images in other colour spaces than sRGB have the colours of Cycles."""
    space, floats = SPACES[name]
    picture = image("picture", space, floats)
    picture.pixels = [(0.1, 0.3, 0.6, 1.0)[channel] for _ in range(16) for channel in range(4)]
    picture.filepath_raw, picture.file_format = str(tmp_path / "picture"), "OPEN_EXR" if floats else "PNG"
    picture.save()
    loaded = bpy.data.images.load(picture.filepath_raw)
    loaded.colorspace_settings.name = space
    scenes.world((0.5, 0.5, 0.5))
    scenes.mesh("plane", textured("surface", loaded)[0], size=10)
    scenes.camera((0, -2, 2))
    cycles, ours = (each[..., :3].mean((0, 1)) for each in scenes.both(tmp_path, size=(24, 16), samples=16))
    print(name, cycles, ours)
    np.testing.assert_allclose(ours, cycles, rtol=0.02)
    assert "images of colours" not in "".join(capfd.readouterr())


def test_what_the_exporter_stores_is_not_told(scene, tmp_path, capfd):
    """Images by factors, channels and mappings, alpha, normal maps and node groups."""
    factor, texture, _ = textured("factor")
    tree = factor.node_tree
    node = tree.nodes.new("ShaderNodeMix")
    node.data_type, node.blend_type, node.inputs[0].default_value = "RGBA", "MULTIPLY", 1.0
    tree.links.new(texture.outputs[0], node.inputs[6])
    tree.links.new(node.outputs[2], tree.nodes["Principled BSDF"].inputs["Base Color"])
    channel = textured("channel", image("channels", "Non-Color"), "Roughness", "ShaderNodeSeparateColor")[0]
    relief = textured("relief", image("normals", "Non-Color"), "Normal", "ShaderNodeNormalMap")[0]
    cut = textured("cut", None, "Alpha", output=1)[0]
    turned, node, _ = textured("turned")
    tree = turned.node_tree
    mapping, place = tree.nodes.new("ShaderNodeMapping"), tree.nodes.new("ShaderNodeTexCoord")
    tree.links.new(place.outputs["UV"], mapping.inputs["Vector"])
    tree.links.new(mapping.outputs[0], node.inputs["Vector"])
    shiny = scenes.material("shiny", Coat_Weight=1.0, Metallic=1.0, Roughness=0.3)
    said = told(tmp_path, capfd, factor, channel, relief, cut, turned, shiny)
    assert "Warning" not in said
