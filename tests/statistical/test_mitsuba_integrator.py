"""The integrator `guided_thinlens`: Mitsuba's pictures with less noise."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mitsuba")
import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb", "scalar_rgb")
if mi.variant() == "scalar_rgb" or dr.detail.llvm_version()[0] < 17:
    pytest.skip("no LLVM that Mitsuba can use", allow_module_level=True)

from experiments.material_scenes import MATERIAL_SCENES
from experiments.mitsuba_scene import MitsubaRenderer, comparable

import bokehguide.mitsuba  # noqa: F401 - registers the integrator
from bokehguide.export import export_mitsuba
from bokehguide.mitsuba.emitters import read_emitters
from bokehguide.mitsuba.frame import read_frame
from bokehguide.mitsuba.wavefront import Wavefront
from bokehguide.scene.types import FilmSettings
from tests.support.mitsuba_scenes import PATH, agree, blocks, guided, lamps, runs

MITSUBA_VARIANT = mi.variant()


@pytest.fixture(scope="module")
def expected():
    """Block means by Mitsuba alone."""
    return runs(mi.load_dict(lamps()), mi.load_dict(PATH), 2048, seed=100)


@pytest.mark.parametrize("mode", ["uniform", "lis-b", "guided"])
def test_the_means_are_mitsubas(mode, expected):
    found = runs(mi.load_dict(lamps()), guided(mode), 24)
    assert agree(found, expected)
    assert not np.allclose(found.mean(axis=0), expected.mean(axis=0), rtol=1e-4), "another estimator"


def test_a_wrong_lens_shows(expected):
    """The test above sees a lens that is wider by a third."""
    found = runs(mi.load_dict(lamps(sensor={"aperture_radius": 0.2})), guided(), 24)
    assert not agree(found, expected)


def test_without_highlights_the_picture_is_mitsubas():
    """The pilot finds nothing that a lens point could aim at."""
    scene = mi.load_dict({name: part for name, part in lamps().items() if name not in ("round", "square", "cube")})
    ours, theirs = (
        np.array(mi.render(scene, integrator=integrator, spp=8, seed=3)) for integrator in (guided(), mi.load_dict(PATH))
    )
    np.testing.assert_allclose(ours, theirs, rtol=1e-5)


def test_pixels_beside_highlights_have_mitsubas_lens_points(expected, monkeypatch):
    """Their means, and the number of their paths: each pixel has as many as the render asks for."""
    traced = []
    original = Wavefront.trace_uniform

    def trace_uniform(self, pixels, count, *others):
        traced.append((pixels, count))
        original(self, pixels, count, *others)

    monkeypatch.setattr(Wavefront, "trace_uniform", trace_uniform)
    scene, spp = mi.load_dict(lamps()), 256
    found = runs(scene, guided(), spp)
    assert all(count == spp - 4 for _, count in traced) and len(traced) == 8
    beside = np.bincount(np.concatenate([pixels for pixels, _ in traced]), minlength=32 * 18).reshape(18, 32) == 8
    inside = blocks(np.repeat(beside[..., None], 3, axis=2)) == 1.0
    assert inside.sum() > 20, "blocks without a guided pixel"
    assert agree(found[:, inside], expected[:, inside])
    assert not agree(1.03 * found[:, inside], expected[:, inside]), "three per cent show"


def test_passes_of_pixels_beside_highlights_share_no_sample(monkeypatch):
    """Passes of bounded memory have seeds of their own, and all samples together."""
    traced = []
    original = Wavefront.trace_uniform

    def trace_uniform(self, pixels, count, seed, *others):
        traced.append((len(pixels) * count, count, seed))
        original(self, pixels, count, seed, *others)

    monkeypatch.setattr(Wavefront, "trace_uniform", trace_uniform)
    monkeypatch.setattr("bokehguide.mitsuba.rendering.PATHS_PER_PASS", 2000)
    np.array(mi.render(mi.load_dict(lamps()), integrator=guided(), spp=24, seed=2))
    sizes, counts, seeds = zip(*traced)
    assert sum(counts) == 20 and max(sizes) <= 2000 and len(set(seeds)) == len(seeds) > 3


def test_one_kernel_serves_all_steps():
    """After the first render, no seed compiles another kernel."""
    scene, integrator = mi.load_dict(lamps()), guided()
    np.array(mi.render(scene, integrator=integrator, spp=16, seed=0))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for seed in range(1, 5):
            np.array(mi.render(scene, integrator=integrator, spp=16, seed=seed))
        kernels = [kernel for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT]
    dr.kernel_history_clear()
    assert len(kernels) > 10 and not any(kernel["cache_disk"] or not kernel["cache_hit"] for kernel in kernels)


def test_noise_of_highlights_falls():
    """At 16 samples per pixel the variance of the pixels is a fifth or less."""
    scene = mi.load_dict(lamps(64, 36))

    def variance(integrator: mi.Integrator) -> float:
        pictures = [np.array(mi.render(scene, integrator=integrator, spp=16, seed=seed)).mean(axis=2) for seed in range(6)]
        return float(np.var(pictures, axis=0, ddof=1).mean())

    assert variance(guided()) < 0.2 * variance(mi.load_dict(PATH))


def test_seeds():
    scene, integrator = mi.load_dict(lamps()), guided()
    one, again, other = (np.array(mi.render(scene, integrator=integrator, spp=4, seed=seed)) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one, again)
    assert not np.allclose(one, other)


def test_aovs_alpha_crop_and_filter():
    """Channels as Mitsuba's, for a film with a crop and a filter that reaches beyond its border."""
    film = {"crop_offset_x": 8, "crop_offset_y": 4, "crop_width": 12, "crop_height": 12, "sample_border": True}
    point = {"type": "point", "position": [0, 3, 2]}
    scene = mi.load_dict(lamps(rfilter={"type": "gaussian"}, pixel_format="rgba", **film) | {"sky": point})
    aov = {"type": "aov", "aovs": "dd:depth"}
    theirs = runs_of(scene, mi.load_dict(aov | {"color": PATH}), 64)
    ours = runs_of(scene, mi.load_dict(aov | {"color": {"type": "guided_thinlens", "nested": PATH}}), 16)
    assert ours.shape[1:] == theirs.shape[1:] == (4, 5)
    assert agree(ours, theirs)
    inside = runs_of(scene, guided(nested=aov | {"color": PATH}), 16)
    assert inside.shape[1:] == (4, 9)
    assert agree(inside[..., 4:], theirs)


def runs_of(scene: mi.Scene, integrator: mi.Integrator, spp: int) -> np.ndarray:
    """Means of all channels over quarters of the picture, `[runs, quarters, channels]`."""
    pictures = [np.array(mi.render(scene, integrator=integrator, spp=spp, seed=40 + number)) for number in range(8)]
    height, width = (side // 2 for side in pictures[0].shape[:2])
    return np.stack(
        [[p[y : y + height, x : x + width].mean(axis=(0, 1)) for y in (0, height) for x in (0, width)] for p in pictures]
    )


def test_a_mirrored_sensor():
    """Old scenes mirror the sensor."""
    transform = mi.ScalarTransform4f().look_at([0.0, 0.6, 3.0], [0.0, 0.3, 0.0], [0.0, 1.0, 0.0]).scale([-1.0, 1.0, 1.0])
    scene = mi.load_dict(lamps(sensor={"to_world": transform}))
    theirs, ours = runs(scene, mi.load_dict(PATH), 256), runs(scene, guided(), 24, seed=20)
    assert agree(ours, theirs)
    assert ours.std(axis=0).sum() < theirs.std(axis=0).sum() * 2.0, "the guide knows where the emitters are"


def test_xml_is_the_same():
    nested = '<integrator type="path"><integer name="max_depth" value="4"/></integrator>'
    own = f'<integrator type="guided_thinlens"><string name="mode" value="lis-b"/>{nested}</integrator>'
    text = f'<scene version="3.0.0">{own}</scene>'
    integrator = mi.load_string(text).integrator()
    assert "mode = lis-b" in str(integrator) and "max_depth = 4" in str(integrator)
    scene = mi.load_dict(lamps())
    np.testing.assert_array_equal(
        np.array(mi.render(scene, integrator=integrator, spp=2)), np.array(mi.render(scene, integrator=guided("lis-b"), spp=2))
    )


def test_emitters_are_where_they_are():
    """In the coordinates of the sensor: x to the left, z forward."""
    scene = mi.load_dict(lamps(sensor={"to_world": mi.ScalarTransform4f().translate([0.0, 0.0, 3.0]).rotate([0, 1, 0], 180)}))
    frame = read_frame(scene.sensors()[0])
    found = read_emitters(scene, frame.camera, frame.width, frame.height, np.linalg.inv(frame.to_world))
    middles = [(mesh.vertices.max(axis=0) + mesh.vertices.min(axis=0)) / 2 for mesh in found.scene.meshes[1:]]
    wanted = [(-1.5, 1.5, 9.0), (-0.2, 1.9, 10.0), (1.2, 1.2, 8.0)]
    np.testing.assert_allclose(sorted(map(tuple, middles)), wanted, atol=1e-5)
    bright = {m.emission[0] for m in found.scene.materials[1:]}
    assert list(bright) == pytest.approx([0.2126 * 400 + 0.7152 * 300 + 0.0722 * 200] * len(bright), rel=1e-3)
    assert found.scene.environment.radiance.max() == pytest.approx(0.2, rel=1e-3)
    assert found.per_triangle.sum() == 2 and (found.first_triangles >= 0).sum() == 3


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"mode": "best"}, "mode: 'best' is none of uniform, lis-b, lis-o, guided"),
        ({"nested": {"type": "ptracer"}}, "give one nested integrator that samples rays"),
    ],
)
def test_mistakes(change, named):
    with pytest.raises(Exception, match=named):
        mi.load_dict({"type": "guided_thinlens", "nested": PATH} | change)


def test_a_pinhole_is_no_thin_lens():
    scene = mi.load_dict(lamps() | {"sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}}})
    with pytest.raises(Exception) as caught:
        mi.render(scene, integrator=guided(), spp=1)
    assert "the sensor is a PerspectiveCamera; give a sensor of the type thinlens" in str(caught.value.__cause__)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["metal", "smooth-glass", "textured-emitter", "environment-emitters"])
def test_exported_scenes_are_those_in_memory(name, tmp_path):
    """The XML file and the dictionary that `test_mitsuba.py` compares with this renderer have the same means."""
    scene = comparable(replace(MATERIAL_SCENES[name](), film=FilmSettings(48, 27, 4)))
    export_mitsuba(scene, tmp_path)
    loaded, renderer = mi.load_file(str(tmp_path / "scene.xml")), MitsubaRenderer(scene)
    ours = np.stack([blocks(mi.render(loaded, spp=128, seed=seed), 3) for seed in range(8)])
    theirs = np.stack([blocks(renderer.picture(128, seed + 20).numpy(), 3) for seed in range(8)])
    assert agree(ours, theirs)
    assert not agree(0.97 * ours, theirs), "three per cent show"
