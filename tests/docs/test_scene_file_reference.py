"""The reference of the scene file lists every key that the loaders accept."""

from __future__ import annotations

import re

import pytest

from bokehguide.scene import apertures, cameras, mtl_materials
from bokehguide.scene.toml import lights, materials, scene_file
from tests.support.paths import REPOSITORY

PAGE = (REPOSITORY / "docs/reference/scene-file.md").read_text(encoding="utf-8")
SECTIONS = {
    "Camera": cameras.CAMERA_KEYS,
    "Aperture": apertures.KEYS,
    "Film": ("width", "height", "max_depth", "exposure"),
    "Environment": ("color", "map", "intensity", "rotation", "visible", "group"),
    "Suns": ("direction", "irradiance", "angle", "group"),
    "Lights": lights.LIGHT_KEYS,
    "Lights of models": ("radius", "sun_angle"),
    "Materials": materials.KEYS,
    "Objects": scene_file.OBJECT_KEYS,
}


@pytest.mark.parametrize("section", SECTIONS)
def test_every_key_has_a_row(section):
    text = re.search(rf"^## {section}$(.*?)(?=^## |\Z)", PAGE, re.M | re.S)[1]
    rows = re.findall(r"^\| (`[^|]*) \|", text, re.M)
    listed = {key for row in rows for key in re.findall(r"`(\w+)`", row)}
    assert listed == set(SECTIONS[section])


def test_every_statement_of_a_material_of_obj_files_has_a_row():
    text = re.search(r"^### Materials of OBJ files$(.*?)(?=^#|\Z)", PAGE, re.M | re.S)[1]
    rows = re.findall(r"^\| (`[^|]*) \|", text, re.M)
    assert {key.lower() for row in rows for key in re.findall(r"`(\w+)`", row)} == mtl_materials.TERMS


def test_every_table_is_named():
    assert all(re.search(rf"\[+{table}[\].]", PAGE) for table in scene_file.SCENE_KEYS)
