"""Geometry and materials of a render are those of the scene."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
import scenes


def alphas(folder, **options):
    """The alpha by Cycles and by the add-on."""
    return tuple(each[..., 3] for each in scenes.both(folder, **options))


def view():
    """A transparent scene and a camera."""
    scenes.transparent()
    scenes.camera((0, -6, 1.5), lens=60.0)


def test_instances_of_a_collection(scene, tmp_path):
    view()
    item = scenes.mesh("cube", size=0.5)
    parts = bpy.data.collections.new("parts")
    parts.objects.link(item)
    scene.collection.objects.unlink(item)
    for x in (-1.0, 0.8):
        instance = bpy.data.objects.new("instance", None)
        instance.instance_type, instance.instance_collection = "COLLECTION", parts
        instance.location, instance.scale = (x, 0, 0.2), (1.0, 1.0, 2.0 + x)
        scene.collection.objects.link(instance)
    cycles, ours = alphas(tmp_path, samples=16)
    assert cycles.mean() > 0.05
    assert np.abs(ours - cycles).mean() < 0.01


def test_instances_of_geometry_nodes(scene, tmp_path):
    view()
    item = scenes.mesh("plane", size=2.0)
    tree = bpy.data.node_groups.new("instances", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    kinds = ("NodeGroupInput", "GeometryNodeInstanceOnPoints", "GeometryNodeMeshCube", "NodeGroupOutput")
    given, instances, cube, result = (tree.nodes.new(kind) for kind in kinds)
    cube.inputs["Size"].default_value = (0.4, 0.4, 0.6)
    tree.links.new(given.outputs[0], instances.inputs["Points"])
    tree.links.new(cube.outputs["Mesh"], instances.inputs["Instance"])
    tree.links.new(instances.outputs[0], result.inputs[0])
    item.modifiers.new("nodes", "NODES").node_group = tree
    cycles, ours = alphas(tmp_path, samples=16)
    assert cycles.mean() > 0.03
    assert np.abs(ours - cycles).mean() < 0.01


def test_what_the_render_shows(scene, tmp_path):
    """Objects that only the viewport or only the render hides, and levels of subdivision."""
    view()
    scenes.mesh("cube", size=0.6, location=(-1, 0, 0)).hide_render = True
    scenes.mesh("cube", size=0.6, location=(1, 0, 0)).hide_viewport = True
    cube = scenes.mesh("cube", size=1.2)
    modifier = cube.modifiers.new("subdivision", "SUBSURF")
    modifier.levels, modifier.render_levels = 0, 3
    cycles, ours = alphas(tmp_path, samples=16)
    assert cycles.mean() > 0.05
    assert np.abs(ours - cycles).mean() < 0.01
    assert modifier.levels == 0


def test_view_layer_without_a_collection(scene, tmp_path):
    view()
    scenes.mesh("cube", size=0.6, location=(-0.8, 0, 0))
    hidden = bpy.data.collections.new("hidden")
    scene.collection.children.link(hidden)
    item = scenes.mesh("cube", size=0.6, location=(0.8, 0, 0))
    scene.collection.objects.unlink(item)
    hidden.objects.link(item)
    scene.view_layers[0].layer_collection.children["hidden"].exclude = True
    cycles, ours = alphas(tmp_path, samples=16)
    assert np.abs(ours - cycles).mean() < 0.01


def test_frames_of_an_animation(scene, tmp_path):
    view()
    cube = scenes.mesh("cube", size=0.5)
    for frame, x in ((1, -1.5), (5, 1.5)):
        cube.location.x = x
        cube.keyframe_insert("location", frame=frame)
    middles = {}
    for engine in ("CYCLES", "BOKEHGUIDE"):
        scene.frame_start, scene.frame_end, scene.frame_step = 2, 4, 2
        scene.frame_set(1)
        scene.render.engine = engine
        scenes.render(engine, tmp_path, samples=4)
        scene.render.filepath = str(tmp_path / f"{engine}-#")
        bpy.ops.render.render(animation=True)
        for frame in (2, 4):
            pixels = scenes.read(tmp_path / f"{engine}-{frame}.exr")["Combined.A"]
            middles[engine, frame] = (pixels.sum(0) * np.arange(pixels.shape[1])).sum() / pixels.sum()
    assert middles["CYCLES", 4] - middles["CYCLES", 2] > 20.0
    for frame in (2, 4):
        assert middles["BOKEHGUIDE", frame] == pytest.approx(middles["CYCLES", frame], abs=0.2)
