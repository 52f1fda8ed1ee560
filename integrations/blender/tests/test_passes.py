"""Light groups and mattes are passes as in Cycles."""

from __future__ import annotations

import json

import bpy
import numpy as np
import OpenEXR
import pytest
import scenes

GROUPS = ("key light", "signs", "sky", "empty")


def add_groups(layer, names=GROUPS):
    for name in names:
        layer.lightgroups.add(name=name)


def grouped_scene():
    """A plane under a point light, two emissive spheres of one material, and a world; a sun has no group."""
    scenes.world((0.1, 0.2, 0.4))
    bpy.context.scene.world.lightgroup = "sky"
    scenes.light("POINT", (2.5, -3, 5), energy=400.0, shadow_soft_size=0.1).lightgroup = "key light"
    scenes.light("SUN", (1, 1, 4), energy=0.5)
    sign = scenes.material("sign", (1.0, 0.5, 0.2), emission=3.0)
    scenes.mesh("uv_sphere", sign, radius=0.3, location=(-1, 0, 0.5)).lightgroup = "signs"
    scenes.mesh("uv_sphere", sign, radius=0.3, location=(1, 0.5, 0.5))
    scenes.mesh("plane", size=20)
    scenes.camera((0, -5, 2.5), lens=35.0)
    return bpy.context.view_layer


def group(channels, name):
    return np.stack([channels[f"Combined_{name}.{channel}"] for channel in "RGB"], axis=-1)


def test_light_groups(scene, tmp_path):
    add_groups(grouped_scene())
    cycles, ours = (scenes.render(engine, tmp_path, samples=128) for engine in ("CYCLES", "BOKEHGUIDE"))
    total = np.zeros((*scenes.SIZE[::-1], 3))
    for name in GROUPS:
        expected, found = group(cycles, name), group(ours, name)
        print(name, expected.mean((0, 1)), found.mean((0, 1)))
        np.testing.assert_allclose(found.mean((0, 1)), expected.mean((0, 1)), rtol=0.03, atol=1e-6)
        assert np.abs(found - expected).mean() < 0.15 * max(expected.mean(), 1e-6)
        total += found
    rest = scenes.colors(ours)[..., :3] - total
    expected = scenes.colors(cycles)[..., :3] - sum(group(cycles, name) for name in GROUPS)
    np.testing.assert_allclose(rest.mean((0, 1)), expected.mean((0, 1)), rtol=0.03)


def test_unused_light_groups(scene, tmp_path):
    """A view layer with groups that no light has is rendered, and its passes are black."""
    add_groups(bpy.context.view_layer)
    scenes.light("POINT")
    scenes.mesh("plane")
    scenes.camera()
    channels = scenes.render("BOKEHGUIDE", tmp_path, samples=2)
    assert group(channels, "signs").max() == 0.0
    assert scenes.colors(channels).max() > 0.0


def test_too_many_light_groups(scene, tmp_path, capfd):
    names = [f"group {number}" for number in range(33)]
    add_groups(bpy.context.view_layer, names)
    for name in names:
        scenes.light("POINT", energy=1.0).lightgroup = name
    scenes.mesh("plane")
    scenes.camera()
    channels = scenes.render("BOKEHGUIDE", tmp_path, size=(16, 16), samples=32)
    assert "light groups beyond the first 31 have no pass: group 31, group 32" in "".join(capfd.readouterr())
    assert group(channels, "group 30").max() > 0.0


def matte(channels, manifest, kind, name):
    """The coverage of a name, `[H, W]`."""
    wanted, total = np.uint32(int(manifest[name], 16)), 0.0
    for number in range(3):
        for key, share in ("rg", "ba"):
            found = {each.lower(): channel for each, channel in channels.items()}
            place = f"crypto{kind}{number:02}."
            total = total + found[place + share] * (np.ascontiguousarray(found[place + key]).view(np.uint32) == wanted)
    return total


def manifests(path):
    """The manifest of each Cryptomatte layer of an EXR by its name."""
    header = {key: value for part in OpenEXR.File(str(path)).parts for key, value in part.header.items()}
    names = {key.removesuffix("name"): value for key, value in header.items() if key.endswith("/name")}
    return {name: json.loads(header[f"{key}manifest"]) for key, name in names.items()}


def test_cryptomatte(scene, tmp_path):
    """The mattes of defocused objects, read with the manifest of the file that Blender writes."""
    scenes.world((0.5, 0.5, 0.5))
    layer = bpy.context.view_layer
    layer.use_pass_cryptomatte_object = layer.use_pass_cryptomatte_material = True
    red, blue = scenes.material("red", (0.8, 0.1, 0.1)), scenes.material("blue", (0.1, 0.1, 0.8))
    scenes.mesh("cube", red, size=1.0, location=(-1, 0, 0)).name = "first cube"
    scenes.mesh("cube", red, size=1.0, location=(1, 0, 0)).name = "second.cube"
    scenes.mesh("uv_sphere", blue, radius=0.5, location=(0, 1.5, 0)).name = "ball"
    scenes.camera((0, -5, 1), lens=35.0, use_dof=True, focus_distance=3.0, aperture_fstop=0.2)
    pictures = {}
    for engine in ("CYCLES", "BOKEHGUIDE"):
        channels = scenes.render(engine, tmp_path, samples=128)
        known = manifests(tmp_path / f"{engine}.exr")
        for kind, names in (("object", ("first cube", "second.cube", "ball")), ("material", ("red", "blue"))):
            for name in names:
                manifest = known[f"{layer.name}.Crypto{kind.title()}"]
                pictures[engine, kind, name] = matte(channels, manifest, kind, name)
    for (engine, kind, name), ours in pictures.items():
        if engine == "BOKEHGUIDE":
            cycles = pictures["CYCLES", kind, name]
            print(kind, name, cycles.mean(), ours.mean())
            assert cycles.mean() > 0.01
            assert ours.mean() == pytest.approx(cycles.mean(), rel=0.02)
            assert np.abs(ours - cycles).mean() < 0.02


def compositor(scene):
    """A Cryptomatte node whose matte is the picture."""
    if bpy.app.version < (5, 0, 0):
        scene.use_nodes = True
        tree = scene.node_tree
        tree.nodes.clear()
        output = tree.nodes.new("CompositorNodeComposite")
    else:
        tree = scene.compositing_node_group = bpy.data.node_groups.new("compositor", "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        output = tree.nodes.new("NodeGroupOutput")
    node = tree.nodes.new("CompositorNodeCryptomatteV2")
    node.source, node.scene = "RENDER", scene
    tree.links.new(node.outputs["Matte"], output.inputs[0])
    return node


def test_cryptomatte_node(scene, tmp_path):
    """Blender's Cryptomatte node finds an object by its name."""
    scenes.world((0.5, 0.5, 0.5))
    scenes.mesh("cube", location=(-1, 0, 0)).name = "box"
    scenes.mesh("uv_sphere", location=(1, 0, 0)).name = "ball"
    scenes.camera((0, -6, 1))
    bpy.context.view_layer.use_pass_cryptomatte_object = True
    node = compositor(scene)
    cycles, ours = (composited(scene, node, engine, tmp_path) for engine in ("CYCLES", "BOKEHGUIDE"))
    assert ours[:, 24:].mean() > 0.4
    assert np.abs(ours - cycles).mean() < 0.02


def composited(scene, node, engine, folder):
    """The matte of the ball, `[H, W]`, as the node makes it of a render."""
    scene.render.engine = engine
    node.layer_name, node.matte_id = f"{bpy.context.view_layer.name}.CryptoObject", "ball"
    scene.cycles.samples = scene.bokehguide.samples = 16
    scene.render.resolution_x, scene.render.resolution_y = 48, 32
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "IMAGE"
    settings.file_format, settings.color_depth = "OPEN_EXR", "32"
    scene.render.filepath = str(folder / f"{engine}.exr")
    bpy.ops.render.render(write_still=True)
    return scenes.read(scene.render.filepath)["R"]
