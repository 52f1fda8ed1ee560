"""Mattes of a picture by name, against the coverage that the ranks hold."""

import numpy as np
import pytest
import trimesh

import bokehguide
from bokehguide import BokehguideError
from bokehguide.image.cryptomatte import floats

pytest.importorskip("mmh3")


@pytest.fixture(scope="module")
def picture():
    return bokehguide.render("fairy-lights", "uniform", 2, size=(24, 16), threads=1, cryptomatte=True)


def test_the_matte_of_a_name_is_the_sum_of_its_ranks(picture):
    scene = bokehguide.load_scene("fairy-lights")
    names = {scene.materials[mesh.material].name for mesh in scene.meshes}
    mattes = {name: picture.matte(name, "material") for name in names}
    wanted = {name: np.zeros((16, 24)) for name in names}
    for number in range(3):
        plane = picture.mattes[f"material{number:02}"]
        for name in names:
            for start in (0, 2):
                wanted[name] += np.where(plane[..., start] == floats([name])[0], plane[..., start + 1], 0.0)
    for name in names:
        np.testing.assert_allclose(mattes[name], wanted[name], atol=1e-6)
    assert max(matte.max() for matte in mattes.values()) > 0.9


def test_unknown_names_and_kinds_are_refused(picture):
    scene = bokehguide.load_scene("fairy-lights")
    name = scene.materials[scene.meshes[0].material].name
    with pytest.raises(BokehguideError, match=f"no material is named .*did you mean '{name}'"):
        picture.matte(f"{name}x", "material")
    with pytest.raises(BokehguideError, match='kind \'pixel\' is unknown; give "object" or "material"'):
        picture.matte(name, "pixel")
    with pytest.raises(BokehguideError, match="name 3: give a string"):
        picture.matte(3, "material")


def test_a_picture_without_mattes_says_how_to_get_them():
    plain = bokehguide.render("fairy-lights", "uniform", 1, size=(16, 9), threads=1)
    with pytest.raises(BokehguideError, match="render with cryptomatte=True"):
        plain.matte("floor")


def test_named_copies_of_a_model_have_mattes_of_their_own(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.ply")
    copies = (
        f'[[object]]\nfile = "box.ply"\nname = "{name}"\ntranslate = [{x}, 0, 0]\n'
        for name, x in {"left": -1, "right": 1}.items()
    )
    (tmp_path / "copies.toml").write_text(
        "camera = { position = [0, 0, 4], target = [0, 0, 0], aperture_radius = 0.05 }\n"
        "environment = { color = [1, 1, 1] }\n" + "".join(copies)
    )
    picture = bokehguide.render(str(tmp_path / "copies.toml"), "uniform", 4, size=(24, 16), threads=1, cryptomatte=True)
    left, right = picture.matte("left"), picture.matte("right")
    assert left[:, :12].max() > 0.9 and right[:, 12:].max() > 0.9
    assert not left[:, 12:].any() and not right[:, :12].any()
    with pytest.raises(BokehguideError, match=r"no object is named 'box\.ply'"):
        picture.matte("box.ply")
