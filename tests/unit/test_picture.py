"""`bokehguide.render`: the picture as the command line makes it, and the name in every order of imports."""

from __future__ import annotations

import inspect
import pydoc
import shlex
import signal
import subprocess
import sys
import threading
import warnings
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import bokehguide
from bokehguide import picture
from bokehguide.cli import main
from bokehguide.errors import BokehguideError
from bokehguide.image import read_exr, read_metadata, write_exr
from bokehguide.scene import Aperture, Camera, Environment, Material, Mesh, Scene, load_scene
from bokehguide.train import RenderLoop
from bokehguide.view import notebook
from tests.support import scenes

SMALL = {"spp": 2, "threads": 1, "quiet": True}


def triangle() -> Scene:
    """A scene as a user writes it, with lists and without types."""
    return Scene(
        name="triangle",
        camera=Camera([0, 0, 4], [0, 0, 0], aperture_radius=0.1, focus_distance=4.0, aperture=Aperture(blades=6, rotation=10)),
        meshes=[Mesh([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], [[0, 1, 2]], 0)],
        materials=[Material("red", base_color=[0.8, 0.1, 0.1])],
        environment=Environment([1, 1, 1]),
    )


def test_the_files_are_those_of_the_command_line(lamps_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["render", str(lamps_file), "--spp", "3", "--threads", "1", "--seed", "5", "--out", "cli.exr"]) == 0
    picture = bokehguide.render(lamps_file, spp=3, threads=1, seed=5, quiet=True)
    assert picture.save("api.exr") == picture.save(tmp_path / "api.png").relative_to(tmp_path).with_suffix(".exr")
    expected, found = read_exr("cli.exr"), read_exr("api.exr")
    assert list(expected) == list(found)
    for name, layer in expected.items():
        np.testing.assert_array_equal(found[name], layer, err_msg=name)
    np.testing.assert_array_equal(picture.beauty[..., 1], expected["G"])
    np.testing.assert_array_equal(picture.sample_count, expected["samples.Y"])
    assert (tmp_path / "cli.png").read_bytes() == (tmp_path / "api.png").read_bytes()
    facts = read_metadata("cli.exr")
    assert all(facts[key] == pytest.approx(value) for key, value in picture.metadata.items())


def test_a_transparent_png_is_that_of_the_command_line(lamps_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    picture = bokehguide.render(lamps_file, **SMALL)
    picture.save("a.exr")
    for name, options, keywords in (("c", [], {}), ("d", ["--bits", "16"], {"bits": 16})):
        assert main(["develop", "a.exr", "--alpha", *options, "--out", f"{name}.png"]) == 0
        picture.save("b.png", alpha=True, **keywords)
        assert Path("b.png").read_bytes() == Path(f"{name}.png").read_bytes()
    with pytest.raises(BokehguideError, match=r"Picture\.save: bits: 12 is no depth of a PNG; give 8 or 16"):
        picture.save("b.png", bits=12)


def test_the_picture_after_each_step_is_that_of_a_shorter_render(lamps_file):
    seen = {}
    last = bokehguide.render(lamps_file, on_step=lambda spp, picture: seen.update({spp: picture()}), **SMALL)
    assert list(seen) == [1, 2]
    np.testing.assert_array_equal(seen[2].beauty, last.beauty)
    shorter = bokehguide.render(lamps_file, **(SMALL | {"spp": 1}))
    np.testing.assert_array_equal(seen[1].beauty, shorter.beauty)
    assert seen[1].metadata["spp"] == 1


def test_a_scene_from_memory():
    scene = triangle()
    picture = bokehguide.render(scene, size=(24, 16), **SMALL)
    assert picture.beauty.shape == (16, 24, 3) and picture.alpha.shape == (16, 24) and picture.denoised is None
    assert set(picture.layers) == {"beauty", "alpha", "depth", "normal", "albedo", "emission", "variance", "sample_count"}
    assert all(layer.dtype == np.float32 for layer in picture.layers.values())
    assert (picture.sample_count == 2.0).all() and picture.metadata["spp"] == 2
    assert picture.beauty[8, 12, 0] > picture.beauty[8, 12, 1]
    assert '"blades": 6' in picture.metadata["settings"], "the aperture of a scene stays"
    closer = bokehguide.render(scene, size=(24, 16), focus_distance=2.0, fov=20.0, **SMALL)
    assert not np.array_equal(closer.beauty, picture.beauty)


def test_degenerate_triangles_of_a_scene_are_left_out():
    scene = triangle()
    line = Mesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], 0)
    expected = bokehguide.render(scene, size=(12, 8), **SMALL)
    found = bokehguide.render(replace(scene, meshes=(*scene.meshes, line)), size=(12, 8), **SMALL)
    np.testing.assert_array_equal(found.beauty, expected.beauty)
    with pytest.raises(BokehguideError, match="triangle: holds no triangle with an area"):
        bokehguide.render(replace(scene, meshes=[line]), **SMALL)


def test_the_picture_in_a_notebook_and_on_the_screen(monkeypatch):
    picture = bokehguide.render(scenes.emitters(16, 10), **SMALL)
    shown = np.asarray(Image.open(BytesIO(picture._repr_png_())))
    np.testing.assert_array_equal(shown, picture.image())
    brighter = picture.developed(exposure=picture.display.exposure + 1.0)
    assert (brighter.image().astype(int).sum(2) >= shown.astype(int).sum(2)).all() and (brighter.image() > shown).any()
    assert not np.array_equal(picture.developed(view="srgb").image(), shown)
    seen = []
    monkeypatch.setattr(Image.Image, "show", lambda self: seen.append(np.asarray(self)))
    picture.show()
    np.testing.assert_array_equal(seen[0], shown)
    assert repr(picture) == "Picture('emitters', 16 × 10, mode 'guided', 2 SPP)"


def test_crops_and_targets():
    picture = bokehguide.render(scenes.emitters(16, 10), crop=(4, 2, 8, 5), **SMALL)
    assert picture.beauty.shape == (5, 8, 3) and picture.corner == (4, 2) and picture.frame == (16, 10)
    adaptive = bokehguide.render(scenes.emitters(16, 10), "uniform", 64, target_noise=1.0, threads=1, quiet=True)
    assert adaptive.metadata["spp"] < 64


def interrupted_after(steps: int, number: int, monkeypatch) -> None:
    """A signal arrives during a step."""
    step = RenderLoop.step

    def stepping(self, last=False):
        if self.step_number == steps - 1:
            signal.raise_signal(number)
        return step(self, last)

    monkeypatch.setattr(RenderLoop, "step", stepping)


def test_an_interruption_returns_the_picture_so_far(monkeypatch):
    expected = bokehguide.render(scenes.emitters(16, 10), spp=3, threads=1, quiet=True)
    interrupted_after(3, signal.SIGINT, monkeypatch)
    picture = bokehguide.render(scenes.emitters(16, 10), spp=50, threads=1, quiet=True)
    assert picture.metadata["spp"] == 3
    np.testing.assert_array_equal(picture.beauty, expected.beauty)


def test_no_step_begins_after_the_time_limit():
    assert bokehguide.render(triangle(), spp=10_000, size=(16, 9), time_limit=1e-3, threads=1, quiet=True).metadata["spp"] == 1
    picture = bokehguide.render(triangle(), size=(16, 9), time_limit=600.0, **SMALL)
    assert picture.metadata["spp"] == SMALL["spp"]
    for wrong in (0.0, -1, float("nan"), float("inf"), "1 min", True):
        with pytest.raises(BokehguideError, match=r"render: time_limit: .* is no number above 0; give seconds"):
            bokehguide.render(triangle(), time_limit=wrong, **SMALL)


def test_a_termination_is_not_lost(monkeypatch):
    seen = []
    previous = signal.signal(signal.SIGTERM, lambda number, _: seen.append(number))
    interrupted_after(1, signal.SIGTERM, monkeypatch)
    try:
        bokehguide.render(scenes.emitters(16, 10), **SMALL)
    finally:
        signal.signal(signal.SIGTERM, previous)
    assert seen == [signal.SIGTERM]


def test_renders_in_another_thread():
    pictures = []
    thread = threading.Thread(target=lambda: pictures.append(bokehguide.render(scenes.emitters(16, 10), **SMALL)))
    thread.start()
    thread.join()
    np.testing.assert_array_equal(pictures[0].beauty, bokehguide.render(scenes.emitters(16, 10), **SMALL).beauty)


def test_the_bar_and_the_warnings(capsys):
    scene = replace(scenes.emitters(16, 10), warnings=("lamp.obj: no normals",))
    with pytest.warns(UserWarning, match=r"lamp\.obj: no normals"):
        bokehguide.render(scene, spp=2, threads=1)
    assert "2/2" in capsys.readouterr().err
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bokehguide.render(scene, **SMALL)
    assert capsys.readouterr().err == ""


WITHOUT_STDERR = """
import sys
import bokehguide
from bokehguide.cli import main
from bokehguide.runtime.bars import progress
assert sys.stderr is None
for quiet in (True, False):
    bokehguide.render("scene.toml", spp=2, threads=1, quiet=quiet)
progress("steps", 2).close()
main(["render", "scene.toml", "--spp", "2", "--out", "a.exr"])
print("done")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
def test_a_process_without_stderr_renders(lamps_file, tmp_path):
    """A shell closes stderr with `2>&-`. Decoders of textures use the stream too."""
    Image.new("RGB", (4, 4), (99, 99, 99)).save(tmp_path / "t.png")
    text = lamps_file.read_text()
    material = next(line for line in text.splitlines() if line.startswith("[materials."))
    (tmp_path / "scene.toml").write_text(text.replace(material, f'{material}\nbase_color_texture = "t.png"', 1))
    (tmp_path / "script.py").write_text(WITHOUT_STDERR)
    shell = f"{shlex.quote(sys.executable)} script.py 2>&-"
    ended = subprocess.run(shell, shell=True, cwd=tmp_path, stdout=subprocess.PIPE, text=True, timeout=120)
    assert ended.returncode == 0 and ended.stdout.endswith("done\n")


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"fcous_distance": 1.0}, "render: fcous_distance: no such option; did you mean 'focus_distance'?"),
        ({"width": 320}, "render: width: no such option; did you mean 'size'?"),
        ({"samples": 8}, "render: samples: no such option; did you mean 'spp'?"),
        ({"denoised": True}, "render: denoised: no such option; did you mean 'denoise'?"),
        ({"timelimit": 3.0}, "render: timelimit: no such option; did you mean 'time_limit'?"),
        ({"option": 1}, "render: option: no such option; the nearest of "),
        ({"spp": 2.5}, "spp: 2.5 is out of range"),
        ({"mode": "guide"}, "mode: 'guide' is unknown"),
        ({"size": 640}, "render: size: 640 is no pair of whole numbers"),
        ({"size": (640, 0)}, "0 is out of range"),
        ({"size": np.zeros((2, 2))}, "render: size: array([[0., 0.], [0., 0.]]) is no pair of whole numbers"),
        ({"focus_distance": -1.0}, "focus-distance: -1.0 is out of range"),
        ({"camera": "0"}, "selects a camera of a model, but emitters is none"),
        ({"camera": 0}, "camera or --camera: '0': selects a camera of a model, but emitters is none"),
        ({"fov": 200}, "fov or --fov: 200 is out of range; give degrees"),
        ({"size": (-3, 4)}, "width or --size (width): -3 is out of range"),
        ({"environment": (1, -1, 1)}, "environment or --environment: '1,-1,1'; give R,G,B, each a number of 0 or more"),
        ({"environment": (1, 1)}, "environment or --environment: '1,1'; give R,G,B"),
        ({"environment": np.ones((4, 4, 3))}, "environment or --environment: ndarray is no radiance; give three numbers, or the"),
        ({"environment": 3}, "environment or --environment: int is no radiance; give three numbers, or the path"),
        ({"exposure": 1}, "render: exposure: no such option; give it to the result, as in picture.developed(exposure=1.0"),
        ({"blend_rate": 0.1}, "render: blend_rate: no such option; give gaussian=GaussianConfig(blend_rate=...), from bokeh"),
        ({"highlights": 1}, "give gaussian=GaussianConfig(highlights=...) or guided=GuidedConfig(highlights=...), from bokeh"),
        ({"view": "srgb"}, "render: view: no such option; give it to the result, as in picture.developed("),
        ({"out": "a.exr"}, 'render: out: no such option; save the result, as in picture.save("picture.exr")'),
        ({"alpha": True}, 'render: alpha: no such option; give it to the result, as in picture.save("picture.png", alpha=True'),
        ({"on_step": 3}, "render: on_step: 3 is no function; give one that takes the SPP and a function"),
    ],
)
def test_a_wrong_option_is_named(options, named):
    with pytest.raises(BokehguideError) as caught:
        bokehguide.render(scenes.emitters(16, 10), **{**SMALL, **options})
    assert named in str(caught.value) and len(str(caught.value).splitlines()) == 1


def test_overrides_of_a_scene_are_of_their_class():
    with pytest.raises(BokehguideError, match=r"^overrides: \{'fov': 30.0\} is no Overrides; give Overrides\(…\)$"):
        bokehguide.load_scene(scenes.emitters(16, 10), {"fov": 30.0})


@pytest.mark.parametrize("scene", [None, 3, b"daylight"])
def test_what_is_no_scene_is_named(scene):
    with pytest.raises(BokehguideError, match=r"scene: .* is no scene; give a Scene, the name of a built-in scene, or the path"):
        bokehguide.render(scene, **SMALL)


def test_numbers_of_numpy_and_paths_are_options(tmp_path):
    sky = tmp_path / "sky.exr"
    write_exr(sky, {"beauty": np.ones((2, 4, 3), np.float32)})
    Image.new("L", (4, 4), 255).save(tmp_path / "mask.png")
    lens = {"focus_distance": np.float32(3), "camera_position": np.array([0.0, 0.0, 4.0]), "time_limit": np.float32(60)}
    wanted = {"focus_distance": 3.0, "camera_position": (0.0, 0.0, 4.0), "time_limit": 60.0}
    lens |= {"size": np.array([16, 9]), "environment": sky, "aperture_blades": np.int64(5), "aperture_radius": np.array(0.1)}
    wanted |= {"size": (16, 9), "environment": str(sky), "aperture_blades": 5, "aperture_radius": 0.1}
    found, expected = (bokehguide.render(triangle(), **SMALL, **options) for options in (lens, wanted))
    np.testing.assert_array_equal(found.beauty, expected.beauty)
    assert found.beauty.shape == (9, 16, 3)
    for radiance in ((1, 1, 1), np.ones(3)):
        found = bokehguide.render(triangle(), **SMALL, **(lens | {"environment": radiance}))
        written = bokehguide.render(triangle(), **SMALL, **(lens | {"environment": "1,1,1"}))
        np.testing.assert_array_equal(found.beauty, written.beauty)
    bokehguide.render(triangle(), size=(np.int64(16), 9), aperture_image=tmp_path / "mask.png", **SMALL)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"exposure": "foo"}, "exposure: 'foo' is not a number; give EV from -100 to 100"),
        ({"exposure": 1e9}, "exposure: 1000000000.0 is out of range; give EV"),
        ({"exposure": float("nan")}, "exposure: nan is out of range"),
        ({"view": "sepia"}, "view: 'sepia' is unknown; choose one of photo, aces, srgb"),
    ],
)
def test_a_picture_cannot_be_developed_otherwise(options, named):
    picture = bokehguide.render(triangle(), size=(8, 4), **SMALL)
    with pytest.raises(BokehguideError, match=rf"Picture\.developed: {named}"):
        picture.developed(**options)
    developed = picture.developed(exposure=np.float32(1.5))
    assert developed.metadata["exposure"] == 1.5 and picture.metadata["exposure"] != 1.5
    metered = developed.developed(exposure="auto", view="srgb")
    assert metered.metadata == picture.developed(view="srgb").metadata  # a picture is metered at first
    np.testing.assert_array_equal(metered.image(), picture.developed(view="srgb").image())


def test_a_device_that_is_absent_is_named(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(BokehguideError, match="device: cuda: torch finds no CUDA device here; give cpu"):
        bokehguide.render(scenes.emitters(16, 10), device="cuda", **SMALL)


def test_a_denoiser_that_is_absent_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    with pytest.raises(BokehguideError, match="denoising: needs Open Image Denoise"):
        bokehguide.render(scenes.emitters(16, 10), denoise=True, **SMALL)


def test_a_denoised_picture(tmp_path):
    """Beside the beauty, which denoising does not change; the PNG shows the denoised one."""
    pytest.importorskip("mitsuba_oidn")
    scene = scenes.emitters(32, 20)
    noisy = bokehguide.render(scene, "uniform", 4, threads=1, quiet=True)
    picture = bokehguide.render(scene, "uniform", 4, threads=1, quiet=True, denoise=True)
    np.testing.assert_array_equal(picture.beauty, noisy.beauty)
    assert picture.denoised is not None and not np.array_equal(picture.denoised, noisy.beauty)
    assert picture.estimated_mape is not None and noisy.estimated_mape is not None
    assert picture.save(tmp_path / "denoised.exr") and {"R", "denoised.R"} <= set(read_exr(tmp_path / "denoised.exr"))
    assert not np.array_equal(picture.image(), replace(picture, denoised=None).image())


def test_a_wrong_suffix_is_named(tmp_path):
    picture = bokehguide.render(scenes.emitters(16, 10), **SMALL)
    with pytest.raises(BokehguideError, match=r"Picture\.save: .*picture\.jpg.* has another suffix; give \.exr or \.png"):
        picture.save(tmp_path / "picture.jpg")
    for path in (3, None, b"picture.png"):
        with pytest.raises(BokehguideError, match=rf"Picture\.save: path: {path} is no path; give one that ends in \.exr"):
            picture.save(path)


def test_exported_names():
    assert all(hasattr(bokehguide, name) for name in bokehguide.__all__)
    assert set(bokehguide.__all__) <= set(dir(bokehguide))
    assert bokehguide.load_scene is load_scene and bokehguide.Scene is Scene
    with pytest.raises(AttributeError, match="no attribute 'rendr'"):
        bokehguide.rendr  # noqa: B018


@pytest.mark.parametrize(
    ("package", "function"), [(bokehguide.render, picture.render), (bokehguide.view, notebook.view)], ids=["render", "view"]
)
def test_a_callable_package_shows_its_function(package, function):
    assert inspect.signature(package) == inspect.signature(function)
    shown = pydoc.plain(pydoc.render_doc(package))
    assert "The package is callable" in shown
    summary, *_ = inspect.getdoc(function).splitlines()
    assert f"{function.__name__}{inspect.signature(function)}" in shown and summary in shown


ORDERS = """
from bokehguide.render import Film; import bokehguide; found = bokehguide.render
from bokehguide import render as found
import bokehguide; found = bokehguide.render
import bokehguide.render as found; found.Film, found.ThinLensCamera
import bokehguide.render.film, bokehguide.scene; found = bokehguide.render; found.film.Film
import bokehguide.train, bokehguide; found = bokehguide.render; bokehguide.train.RenderLoop
import bokehguide.picture; found = bokehguide.render
from bokehguide.picture import render as found
from bokehguide import *; found = render
import bokehguide; bokehguide.render; from bokehguide.render import Film; found = bokehguide.render
"""
CHECK = """
import sys

def fresh(order):
    for name in [name for name in sys.modules if name.split(".")[0] == "bokehguide"]:
        del sys.modules[name]
    names = {}
    exec(order, names)
    from bokehguide.errors import BokehguideError
    try:
        names["found"]("daylight", nonsense=1)
    except BokehguideError as error:
        assert "nonsense: no such option" in str(error), order
    else:
        raise AssertionError(order)
    import bokehguide.render
    assert bokehguide.render is sys.modules["bokehguide.render"] and bokehguide.render.Film.__name__ == "Film", order

for order in sys.argv[1].strip().splitlines():
    fresh(order)
print("all", len(sys.argv[1].strip().splitlines()))
"""


@pytest.mark.parametrize("orders", [slice(0, 1), pytest.param(slice(1, None), marks=pytest.mark.slow)])
def test_the_name_works_in_every_order_of_imports(orders):
    """Each order starts without a module of the package; PyTorch stays loaded, which saves time."""
    lines = ORDERS.strip().splitlines()[orders]
    finished = subprocess.run([sys.executable, "-c", CHECK, "\n".join(lines)], capture_output=True, text=True, timeout=300)
    assert finished.stdout == f"all {len(lines)}\n", finished.stderr


def test_the_package_is_imported_without_its_parts():
    code = "import bokehguide, sys; assert not {'torch', 'numpy', 'bokehguide.scene'} & set(sys.modules); dir(bokehguide)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_a_crop_in_fractions_is_the_part_of_the_frame():
    whole = bokehguide.render(triangle(), "uniform", size=(16, 8), **SMALL)
    part = bokehguide.render(triangle(), "uniform", size=(16, 8), crop=(0.25, 0.5, 0.5, 0.5), **SMALL)
    assert part.corner == (4, 4) and part.frame == (16, 8)
    np.testing.assert_array_equal(part.beauty, whole.beauty[4:8, 4:12])
