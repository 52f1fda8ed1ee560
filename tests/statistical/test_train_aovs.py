"""AOVs and alpha through the lens are the same in all modes, and in files."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.ndimage import maximum_filter

from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.control_variate import CELL
from bokehguide.guiding.pixel_groups import PixelGroups
from bokehguide.image import read_exr, write_exr
from bokehguide.scene.shapes import spheres, transform, transformed, unit_rectangle
from bokehguide.scene.types import Environment, FilmSettings, Material, Scene
from bokehguide.train import LENS_MODES, RenderLoop, RenderSettings
from tests.support import scenes
from tests.support.statistical import SIGNIFICANCE, block_means, z_test

BLOCK, RENDERS, SPP = 8, 12, 24
REACH = (PixelGroups.of(1, GuidedConfig.reuse_group, key=1, scattered=True).across - 1) + (CELL - 1)
"""Greatest distance in pixels from which samples, or coefficients of the control variate, reach a pixel in `guided`."""
NAMES = ("A", "depth.Z", *(f"normal.{c}" for c in "XYZ"), *(f"{n}.{c}" for n in ("albedo", "emission") for c in "RGB"))


def cut_out(environment: Environment | None = None) -> Scene:
    """Emitters and a ball out of focus before no environment, partly behind a translucent sheet."""
    lit = scenes.emitters(64, 40)
    materials = (
        replace(scenes.LAMP, base_color=(0.3, 0.2, 0.1)),
        Material("ball", (0.7, 0.5, 0.2)),
        Material("sheet", (0.1, 0.4, 0.8), opacity=0.5, alpha_mode="blend"),
    )
    sheet = replace(transformed(unit_rectangle(), transform((-0.2, 0.1, -0.8), (0.0, 20.0, 0.0), 0.15)), material=2)
    ball = spheres(np.array([[0.6, -0.3, -4.0]]), 0.5, material=1)
    camera = replace(lit.camera, aperture_radius=0.15)
    return replace(
        lit,
        camera=camera,
        meshes=(*lit.meshes, ball, sheet),
        materials=materials,
        environment=environment,
        film=FilmSettings(64, 40, max_depth=2),
    )


def rendered(scene: Scene, mode: str, seed: int, spp: int = SPP) -> RenderLoop:
    with RenderLoop(scene, RenderSettings(mode, seed=seed, threads=1)) as loop:
        for _ in range(spp):
            loop.step()
    return loop


def channels(scene: Scene, mode: str, seed: int, folder) -> dict[str, np.ndarray]:
    """Channels of a render's EXR file, float64."""
    path = folder / f"{mode}-{seed}.exr"
    write_exr(path, rendered(scene, mode, seed).film.layers())
    return {name: plane.astype(float) for name, plane in read_exr(path).items()}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Independent renders of the cut-out in two modes."""
    folder = tmp_path_factory.mktemp("aovs")
    seeds = {mode: range(first, first + RENDERS) for mode, first in (("uniform", 100), ("lis-o", 200), ("guided", 300))}
    return {mode: [channels(cut_out(), mode, seed, folder) for seed in some] for mode, some in seeds.items()}


def statistics(renders, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Block means over the renders and their variances."""
    blocks = np.stack([block_means(render[name], BLOCK) for render in renders])
    return blocks.mean(0), blocks.var(0, ddof=1) / len(blocks)


def t_test(difference: np.ndarray, error: np.ndarray) -> float:
    """As `z_test`, with errors that are estimated from RENDERS renders on each side."""
    z = stats.norm.isf(stats.t.sf(np.abs(difference) / np.maximum(error, 1e-7), 2 * RENDERS - 2))
    return z_test(z, np.ones_like(z))


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["lis-o", "guided"])
@pytest.mark.parametrize("name", [name for name in NAMES if name != "depth.Z"])
def test_guided_aovs_are_those_of_the_uniform_lens(files, name, mode):
    (plain, plain_variance), (guided, variance) = (statistics(files[one], name) for one in ("uniform", mode))
    assert plain.std() > 0.01
    assert t_test(plain - guided, np.sqrt(plain_variance + variance)) > SIGNIFICANCE


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["lis-o", "guided"])
def test_guided_depth_is_that_of_the_uniform_lens(files, mode):
    """Within two percent where half of the samples meet surfaces: elsewhere the quotient of means is biased."""
    covered = np.mean([render["A"] for render in files["uniform"]], axis=0) > 0.5
    for render in (render for some in files.values() for render in some):
        render["depth"] = np.where(covered, render["depth.Z"], 0.0)
    (plain, plain_variance), (guided, variance) = (statistics(files[one], "depth") for one in ("uniform", mode))
    assert covered.mean() > 0.1 and np.ptp(plain[plain > 0.0]) > 1.0
    assert t_test(plain - guided, np.sqrt(plain_variance + variance) + 0.02 * plain) > SIGNIFICANCE


@pytest.mark.slow
def test_guided_alpha_is_nearly_as_smooth_as_that_of_the_uniform_lens(files):
    noise = {mode: np.std([render["A"] for render in renders], axis=0).mean() for mode, renders in files.items()}
    assert noise["uniform"] > 0.01 and max(noise["lis-o"], noise["guided"]) < 1.5 * noise["uniform"]
    guided = np.stack([render["A"] for render in files["lis-o"]])
    assert ((guided < -0.05) | (guided > 1.05)).mean() < 2e-3


def sky(radiance: float, visible: bool) -> Environment:
    return Environment(np.full((1, 1, 3), radiance, np.float32), visible=visible)


@pytest.mark.parametrize("mode", LENS_MODES)
def test_alpha_is_exactly_one_before_an_environment_in_view(mode):
    loop = rendered(cut_out(sky(0.1, True)), mode, 1, 12)
    np.testing.assert_array_equal(loop.film.layers()["alpha"], 1.0)
    assert (loop.mode.lens.component_count > 0) == (mode != "uniform")


@pytest.mark.parametrize("mode", LENS_MODES)
def test_alpha_is_exact_where_it_is_the_same_for_the_whole_lens(mode):
    """A wall over half of the picture; beyond its blurred edge a hidden environment."""
    wall = replace(transformed(unit_rectangle(), transform((-5.0, 0.0, -2.0), scale=5.0)), material=1)
    scene = cut_out(sky(0.1, False))
    loop = rendered(replace(scene, meshes=(*scene.meshes[:1], wall)), mode, 1, 12)
    layers = loop.film.layers()
    np.testing.assert_array_equal(layers["alpha"][:, :31], 1.0)
    empty = layers["depth"] >= 1e10
    assert empty.mean() > 0.2
    for name in ("alpha", "normal", "albedo", "emission"):
        np.testing.assert_array_equal(layers[name][empty], 0.0)
    if mode == "guided":  # neighbours may reuse hits of emitters that no ray of the pixel met
        empty = ~maximum_filter(~empty, 2 * REACH + 1)
        assert empty.mean() > 0.2
    np.testing.assert_array_equal(layers["beauty"][empty], 0.0)


def test_emission_is_the_beauty_of_paths_of_one_segment():
    """Where no environment is in view; surfaces reflect the rest of the beauty."""
    whole = rendered(cut_out(), "uniform", 1, 8).film.layers()
    seen = rendered(replace(cut_out(), film=FilmSettings(64, 40, max_depth=1)), "uniform", 1, 8).film.layers()
    np.testing.assert_array_equal(whole["emission"], seen["beauty"])
    assert whole["emission"].max() > 1.0 and (whole["beauty"] > whole["emission"]).any()
