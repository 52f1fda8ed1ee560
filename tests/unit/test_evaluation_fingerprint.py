"""Kept renders of the experiments know what they were made from."""

from dataclasses import replace

import numpy as np
import pytest

from bokehguide.evaluation.fingerprint import fingerprint
from bokehguide.scene import Overrides, Scene, load_scene
from bokehguide.scene.digest import contents
from bokehguide.scene.types import Material
from bokehguide.train import RenderSettings

SETTINGS = RenderSettings("lis-o", 64, 5)


def scene() -> Scene:
    return load_scene("cutout", Overrides(width=32, height=18))


@pytest.mark.slow
def test_the_same_scene_has_the_same_fingerprint_whatever_the_spp():
    assert fingerprint(scene(), SETTINGS) == fingerprint(scene(), replace(SETTINGS, spp=8))


def moved(one: Scene) -> Scene:
    vertices = one.meshes[0].vertices.copy()
    vertices[0, 0] = np.nextafter(vertices[0, 0], np.float32(np.inf))
    return replace(one, meshes=(replace(one.meshes[0], vertices=vertices), *one.meshes[1:]))


@pytest.mark.parametrize(
    "change",
    [
        moved,
        lambda one: replace(one, camera=replace(one.camera, aperture_radius=0.01)),
        lambda one: replace(one, materials=(replace(one.materials[0], clearcoat=0.5), *one.materials[1:])),
        lambda one: replace(one, film=replace(one.film, max_depth=5)),
    ],
)
def test_what_changes_the_picture_changes_the_fingerprint(change):
    assert fingerprint(change(scene()), SETTINGS) != fingerprint(scene(), SETTINGS)


@pytest.mark.slow
@pytest.mark.parametrize("change", [{"mode": "lis"}, {"seed": 6}])
def test_so_do_mode_and_seed(change):
    assert fingerprint(scene(), replace(SETTINGS, **change)) != fingerprint(scene(), SETTINGS)


def test_fields_with_their_defaults_are_left_out():
    """So that a field which a later version adds leaves renders of old scenes valid."""
    found = b" ".join(contents(Material("clay", roughness=0.5)))
    assert b"roughness" in found and b"clearcoat" not in found
