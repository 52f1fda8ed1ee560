"""What Mitsuba 3 renders, where it is installed: the material scenes, two built-in scenes, and mistakes that must show.

Mitsuba's random numbers differ between its variants, so these checks hold for other seeds too.
"""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import norm

from tests.support.paths import REPOSITORY
from tests.support.statistical import SIGNIFICANCE, sidak

mi = pytest.importorskip("mitsuba")

from compare_mitsuba import Comparison, compare, mitsuba_reference, our_runs
from experiments.material_scenes import MATERIAL_SCENES
from experiments.mean_tests import PIXELS_WITHIN, Runs, judge
from experiments.mitsuba_scene import METAL_ROUGHNESS, MitsubaRenderer, comparable, left_out, load_environment
from experiments.retest_pixels import PixelRetest

from bokehguide.errors import BokehguideError
from bokehguide.evaluation import LongRender
from bokehguide.render.lights.environment import EnvironmentLight
from bokehguide.scene import Overrides, load_scene
from bokehguide.scene.types import Cone, Environment, Material, Scene, Sun, Texture

MITSUBA_VARIANT = mi.variant()
pytestmark = pytest.mark.slow
SIZE = (96, 54)
SPP, RUNS, MITSUBA_SPP = 48, 8, 512
STANDARD_ERROR = 0.005
"""Of the ratio of means: what so few samples allow."""


def small(scene: Scene) -> Scene:
    width, height = SIZE
    return comparable(replace(scene, film=replace(scene.film, width=width, height=height)))


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """Mitsuba's render of a small scene, made once."""
    folder = tmp_path_factory.mktemp("mitsuba")
    return lambda scene: mitsuba_reference(scene, MITSUBA_SPP, folder)


def comparison(scene: Scene, mode: str, reference, folder, spp: int = SPP) -> Comparison:
    return compare(scene, mode, our_runs(scene, mode, RUNS, spp), reference, spp * RUNS, folder)


def agrees(found: Comparison) -> bool:
    """Whether pixels, blocks, insets and the frame pass."""
    pixels, *regions = found.outcomes
    return pixels.within >= PIXELS_WITHIN and sidak(np.array([outcome.p for outcome in regions])) > SIGNIFICANCE


@pytest.mark.parametrize("mode", ["uniform", "lis-o"])
@pytest.mark.parametrize("name", MATERIAL_SCENES)
def test_studies_are_mitsubas(name, mode, reference, tmp_path):
    scene = small(MATERIAL_SCENES[name]())
    found = comparison(scene, mode, reference(scene), tmp_path)
    assert agrees(found), found
    assert found.standard_error < STANDARD_ERROR


@pytest.mark.parametrize("name", ["daylight", "chrome"])
def test_built_in_scenes_are_mitsubas(name, reference, tmp_path):
    """Through a pinhole, where few samples tell much of the materials and lights."""
    scene = small(load_scene(name, Overrides(aperture_radius=0.0)))
    found = comparison(scene, "uniform", reference(scene), tmp_path)
    assert agrees(found), found


def with_material(scene: Scene, name: str, **terms) -> Scene:
    materials = (replace(m, **terms) if m.name == name else m for m in scene.materials)
    return replace(scene, materials=tuple(materials))


def with_sky(scene: Scene, **terms) -> Scene:
    return replace(scene, environment=replace(scene.environment, **terms))


def with_lens(scene: Scene, **terms) -> Scene:
    return replace(scene, camera=replace(scene.camera, **terms))


def flipped(scene: Scene, name: str, slot: str, axis: int) -> Scene:
    """A material's picture upside down, or mirrored."""
    texture = next(getattr(m, slot) for m in scene.materials if m.name == name)
    return with_material(scene, name, **{slot: replace(texture, image=np.flip(texture.image, axis).copy())})


MISTAKES = {
    "environment mirrored": ("environment-emitters", lambda s: with_sky(s, radiance=s.environment.radiance[:, ::-1])),
    "environment turned the wrong way": ("environment-emitters", lambda s: with_sky(s, rotation=-37.0)),
    "v upwards": ("textured-emitter", lambda s: flipped(s, "board", "emission_texture", 0)),
    "u leftwards": ("diffuse", lambda s: flipped(s, "ground", "base_color_texture", 1)),
    "the back of an emitter is dark": ("textured-emitter", lambda s: with_material(s, "board", double_sided=False)),
    "a diameter for a radius": ("textured-emitter", lambda s: with_lens(s, aperture_radius=0.16)),
    "focus behind the picture": ("textured-emitter", lambda s: with_lens(s, focus_distance=9.0)),
    "glass of another index": ("smooth-glass", lambda s: with_material(s, "tinted", ior=1.6)),
    "gold too dark by a fiftieth": ("metal", lambda s: with_material(s, "gold", base_color=(0.98, 0.755, 0.333))),
    "five segments fewer": ("smooth-glass", lambda s: replace(s, film=replace(s.film, max_depth=s.film.max_depth - 5))),
    "leaves are opaque": ("alpha-mask", lambda s: with_material(s, "veil", alpha_mode="opaque")),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_show(mistake, reference, tmp_path):
    name, mutate = MISTAKES[mistake]
    scene = small(MATERIAL_SCENES[name]())
    found = comparison(mutate(scene), "uniform", reference(scene), tmp_path, SPP // 2)
    assert not agrees(found), found


@pytest.mark.parametrize(
    "ratio, error, verdict",
    [
        (1.004, 0.001, "passes"),
        (1.006, 0.001, "FAILS"),
        (0.994, 0.0015, "FAILS"),
        (1.012, 0.004, "too few samples"),
        (0.98, 0.004, "FAILS"),
        (1.0, 0.002, "too few samples"),
    ],
)
def test_an_imprecise_mean_is_no_failure_and_no_agreement(ratio, error, verdict):
    found = Comparison("scene", "uniform", ratio, error, 1, 1, [])
    assert found.verdict == verdict and found.means_agree == (verdict == "passes")


def test_retest_separates_disagreement_from_rare_light():
    """Retested pixels agree, unless the scenes of the renderers differ by a fiftieth."""
    scene = small(MATERIAL_SCENES["metal"]())
    scene = replace(scene, film=replace(scene.film, width=24, height=14))
    chosen = torch.zeros(14, 24, dtype=torch.bool)
    chosen[4:10:2, 5:20:3] = True
    retest = PixelRetest(scene, "lis-o", runs=2, spp=1024, mitsuba_spp=2048)
    mean, variance, expected, other = retest(chosen)
    assert mean.shape == expected.shape == (int(chosen.sum()),)
    z = (mean - expected) / (variance + other).sqrt()
    assert sidak(2.0 * norm.sf(z.abs().numpy())) > SIGNIFICANCE
    first = MitsubaRenderer(scene).render(retest.mitsuba_spp, seed=3).variance()[chosen]
    assert 10.0 < float((first / other).median()) < 25.0  # that of 16 times the samples
    darker, *_ = replace(retest, scene=with_material(scene, "gold", base_color=(0.98, 0.755, 0.333)))(chosen)
    assert float(((darker - mean) / (variance + other).sqrt()).min()) < -5.0


def test_only_what_fails_again_fails(tmp_path):
    """Of three failing pixels one passes the retest; many failing pixels are not retested."""
    scene = small(MATERIAL_SCENES["diffuse"]())
    expected, variance = torch.ones(27, 48, dtype=torch.float64), torch.full((27, 48), 1e-4, dtype=torch.float64)
    reference = LongRender(expected[..., None].expand(-1, -1, 3), variance)
    runs = Runs(expected.repeat(2, 1, 1), 2.0 * variance.repeat(2, 1, 1))
    runs.mean[:, 5, 7:10] += 0.2
    asked = []

    def retest(failing):
        asked.append(failing.nonzero().tolist())
        found = torch.tensor([[1.2, 1.0, 1.2], [1e-6] * 3, [1.0] * 3, [1e-6] * 3], dtype=torch.float64)
        return tuple(found)

    pixels = judge(scene, "uniform", runs, reference, tmp_path, retest=retest)[0]
    assert asked == [[[5, 7], [5, 8], [5, 9]]]
    assert pixels.at_first == pytest.approx(1.0 - 3 / 1296) and pixels.within == pytest.approx(1.0 - 2 / 1296)
    runs.mean[:, 9, :20] += 0.2
    pixels = judge(scene, "uniform", runs, reference, tmp_path, retest=retest)[0]
    assert len(asked) == 1 and pixels.within == pixels.at_first == pytest.approx(1.0 - 23 / 1296)


@pytest.mark.parametrize("rotation", [0.0, 37.0, -120.0])
def test_environment_by_direction(rotation):
    """Bilinear, turned, and up to the poles."""
    random = np.random.default_rng(0)
    environment = Environment(random.uniform(0.0, 5.0, (5, 8, 3)).astype(np.float32), rotation)
    directions = random.normal(size=(3, 200))
    directions[:, :2] = [[1e-3, -1e-3], [1.0, -1.0], [1e-3, 1e-3]]
    directions /= np.linalg.norm(directions, axis=0)
    emitter = load_environment(environment)
    theirs = []
    for direction in directions.T:
        interaction = mi.SurfaceInteraction3f()
        interaction.wi = mi.Vector3f(*(-direction).tolist())
        theirs.append(np.array(emitter.eval(interaction)).ravel())
    ours = EnvironmentLight(environment).radiance(torch.from_numpy(directions).float())
    np.testing.assert_allclose(ours.T.numpy(), np.array(theirs), rtol=1e-3, atol=1e-3)


def test_comparable_materials():
    """Each comes out as one of three kinds, with what both renderers have."""
    picture = Texture(np.ones((2, 2, 3), np.float32))
    materials = (
        Material("coat", (0.1, 0.2, 0.3), clearcoat=1.0, base_color_texture=picture, normal_texture=picture),
        Material("metal", metallic=0.7, roughness=0.9, metallic_roughness_texture=picture),
        Material("glass", transmission=0.9, roughness=0.05, metallic=0.1, attenuation_distance=1.0),
    )
    coat, metal, glass = comparable(replace(MATERIAL_SCENES["diffuse"](), materials=materials, meshes=())).materials
    assert coat == Material("coat", (0.1, 0.2, 0.3), specular=0.0, base_color_texture=picture)
    assert metal == Material("metal", metallic=1.0, single_scattering=True, roughness=METAL_ROUGHNESS[1])
    assert glass == Material("glass", transmission=1.0, roughness=0.0)


def test_what_is_left_out_is_told():
    """By term, with the materials that are in use; what makes no difference is not."""
    cone = Cone((0.0, -1.0, 0.0), 10.0, 20.0)
    materials = (
        Material("coat", roughness=0.3, clearcoat=1.0, normal_texture=Texture(np.ones((2, 2, 3), np.float32))),
        Material("gold", metallic=1.0, roughness=0.9),
        Material("spot", specular=0.0, emission=(1.0, 1.0, 1.0), emission_cone=cone),
        Material("plain", specular=0.0),
        Material("unused", clearcoat=1.0),
    )
    mesh = MATERIAL_SCENES["diffuse"]().meshes[0]
    colors = np.ones((len(mesh.vertices), 4), np.float32)
    meshes = tuple(replace(mesh, material=number, colors=colors if number == 3 else None) for number in range(4))
    scene = replace(MATERIAL_SCENES["diffuse"](), materials=materials, meshes=meshes)
    assert left_out(scene, comparable(scene)) == [
        *("specular of coat", "clearcoat of coat", "normal texture of coat", "roughness of gold"),
        *("single scattering of gold", "emission cone of spot", "vertex colors of plain"),
    ]
    assert left_out(comparable(scene), comparable(comparable(scene))) == []


def test_suns_are_refused():
    scene = replace(MATERIAL_SCENES["diffuse"](), suns=(Sun((0.0, 1.0, 0.0), 0.5, (1.0, 1.0, 1.0)),))
    with pytest.raises(BokehguideError, match="diffuse: suns have no counterpart"):
        comparable(scene)


def test_script_tells_and_keeps(lamps_file, tmp_path):
    script = REPOSITORY / "scripts/compare_mitsuba.py"
    options = "--size 16x10 --spp 32 --runs 2 --mitsuba-spp 64 --modes uniform --cache kept --json found.json"
    command = [sys.executable, str(script), str(lamps_file), *options.split()]
    finished = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert finished.returncode == 1, finished.stderr  # far too few samples for the means
    assert "| emitters | uniform |" in finished.stdout and "too few samples" in finished.stdout
    (found,) = json.loads((tmp_path / "found.json").read_text())
    assert (found["scene"], found["mode"], found["spp"], found["mitsuba_spp"]) == ("emitters", "uniform", 64, 64)
    assert 0.5 < found["ratio"] < 2.0 and 0.0 < found["standard_error"] < 1.0
    assert found["left_out"][0] == "specular of wall, emitter"
    assert "left out, as Mitsuba has no counterpart: specular of wall, emitter" in finished.stderr
    assert "Left out of emitters, as Mitsuba has no counterpart: specular of wall, emitter;" in finished.stdout
    kept = sorted(path.name for path in (tmp_path / "kept").iterdir())
    assert kept == ["emitters-16x10-3-mitsuba.exr", "emitters-uniform-z.png"]
