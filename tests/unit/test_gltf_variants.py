"""KHR_materials_variants, and KHR_materials_pbrSpecularGlossiness in the terms of the renderer."""

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bokehguide.errors import BokehguideError
from bokehguide.scene import Overrides, load_scene
from bokehguide.scene.model import ModelState
from bokehguide.scene.model_files import load_model
from tests.support.gltf_builder import UVS, Builder

VARIANTS, GLOSSINESS = "KHR_materials_variants", "KHR_materials_pbrSpecularGlossiness"


def shoe(folder: Path, **mapping: object) -> Path:
    """A square of material 0, which is material 1 in the variant "night" and in the second, unnamed one."""
    builder = Builder()
    for name in ("day", "night"):
        builder.material({"baseColorFactor": [1, 1, 1, 1] if name == "day" else [0.1, 0.1, 0.2, 1]}, name=name)
    builder.node(mesh=builder.mesh(material=0))
    mappings = [{"material": 0, "variants": [2]}, {"material": 1, "variants": [0, 1]} | mapping]
    builder.gltf.meshes[0].primitives[0].extensions = {VARIANTS: {"mappings": mappings}}
    builder.gltf.extensions[VARIANTS] = {"variants": [{"name": "night"}, {}, {"name": "noon"}, {"name": "none"}]}
    builder.gltf.extensionsUsed.append(VARIANTS)
    return Path(builder.save(folder / "shoe.glb"))


@pytest.mark.parametrize(
    ("variant", "material"), [(None, "day"), ("night", "night"), ("1", "night"), ("noon", "day"), ("none", "day")]
)
def test_a_variant_by_name(tmp_path, variant, material):
    model = load_model(shoe(tmp_path), state=ModelState(variant))
    assert model.materials[model.meshes[0].material].name == material
    assert model.warnings == ()
    assert f"variants: night, 1, noon, none; drawn: {variant or 'the materials without a variant'}" in model.supported[0]


def test_an_unknown_variant(tmp_path):
    with pytest.raises(BokehguideError, match=r"shoe\.glb: 'dusk' is no variant of this model; it has night, 1, noon, none"):
        load_scene(str(shoe(tmp_path)), Overrides(variant="dusk"))
    builder = Builder()
    builder.node(mesh=builder.mesh())
    with pytest.raises(BokehguideError, match="'dusk' is no variant of this model; it has none"):
        load_scene(builder.save(tmp_path / "plain.glb"), Overrides(variant="dusk"))


@pytest.mark.parametrize(
    ("mapping", "named"),
    [
        ({"material": 9}, "material: 9 is no index into materials"),
        ({"material": None}, "material: missing"),
        ({"variants": 3}, "variants: 3 is not a list"),
    ],
)
def test_damaged_mappings(tmp_path, mapping, named):
    with pytest.raises(BokehguideError, match=named):
        load_model(shoe(tmp_path, **mapping), state=ModelState("night"))


def test_variants_and_times_in_a_scene_file(tmp_path):
    """Two objects of one file in two variants; the file's lines are told once."""
    shoe(tmp_path)
    camera = "[camera]\nposition = [0, 0, 4]\ntarget = [0, 0, 0]\n"
    objects = '[[object]]\nfile = "shoe.glb"\nvariant = "night"\n[[object]]\nfile = "shoe.glb"\ntime = 2.0\n'
    (tmp_path / "s.toml").write_text(camera + objects)
    scene = load_scene(str(tmp_path / "s.toml"))
    assert [scene.materials[mesh.material].name for mesh in scene.meshes] == ["night", "day"]
    box = '[materials.a]\n[[object]]\nshape = "box"\nmaterial = "a"\ntime = 1\n'
    (tmp_path / "s.toml").write_text(camera + objects + box)
    with pytest.raises(BokehguideError, match=r"s\.toml: object\[2\]\.time: 1 has no effect without a file"):
        load_scene(str(tmp_path / "s.toml"))


def glossy(folder: Path, image: bytes | None = None, **values: object):
    """The one material of a file with specular-glossiness, beside metallic-roughness values that it replaces."""
    builder = Builder()
    if image is not None:
        values["specularGlossinessTexture"] = values["diffuseTexture"] = {"index": builder.texture(image)}
    extensions = {GLOSSINESS: values}
    builder.material({"baseColorFactor": [0, 0, 0, 0.5], "roughnessFactor": 0.1}, extensions=extensions)
    builder.gltf.extensionsRequired.append(GLOSSINESS)
    builder.node(mesh=builder.mesh(material=0, TEXCOORD_0=UVS))
    return load_model(Path(builder.save(folder / "gloss.glb"))).materials[0]


def test_specular_glossiness_factors(tmp_path):
    material = glossy(tmp_path, diffuseFactor=[0.5, 0.25, 0, 0.75], specularFactor=[0.2, 0.04, 1], glossinessFactor=0.9)
    assert (material.base_color, material.opacity, material.metallic, material.ior) == ((0.5, 0.25, 0.0), 0.75, 0.0, 1.5)
    assert material.roughness == pytest.approx(0.1)
    assert material.specular_color == pytest.approx((5.0, 1.0, 25.0)) and material.specular == 1.0
    defaults = glossy(tmp_path)
    assert (defaults.base_color, defaults.roughness, defaults.specular_color) == (
        (1.0, 1.0, 1.0),
        0.0,
        pytest.approx((25.0,) * 3),
    )


def test_specular_glossiness_textures(tmp_path):
    file = BytesIO()
    Image.new("RGBA", (2, 2), (188, 255, 0, 102)).save(file, "PNG")
    material = glossy(tmp_path, file.getvalue(), specularFactor=[0.5, 0.5, 0.5], glossinessFactor=0.5)
    color = [0.5029, 1.0, 0.0]
    np.testing.assert_allclose(material.specular_color_texture.image, np.broadcast_to(color, (2, 2, 3)), atol=1e-4)
    np.testing.assert_allclose(material.base_color_texture.image, np.broadcast_to(color, (2, 2, 3)), atol=1e-4)
    assert material.roughness == 1.0
    np.testing.assert_allclose(material.metallic_roughness_texture.image[..., 1], 1.0 - 0.5 * 0.4, atol=1e-6)
    assert material.specular_color == pytest.approx((12.5, 12.5, 12.5)) and material.metallic == 0.0


def test_specular_glossiness_without_alpha_is_glossy(tmp_path):
    file = BytesIO()
    Image.new("RGB", (1, 1), (255, 255, 255)).save(file, "PNG")
    material = glossy(tmp_path, file.getvalue(), glossinessFactor=0.75)
    np.testing.assert_allclose(material.metallic_roughness_texture.image[..., 1], 0.25)


def test_values_that_are_white_up_to_rounding(tmp_path):
    """Exporters round in single precision: 1.00000012 is 1, and 1.1 is a mistake."""
    assert glossy(tmp_path, diffuseFactor=[1.00000012, 1, 1, 1]).base_color == (1.0, 1.0, 1.0)
    with pytest.raises(BokehguideError, match=r"diffuseFactor: .* is out of range"):
        glossy(tmp_path, diffuseFactor=[1.1, 1, 1, 1])
