"""Checkpoints: a render that goes on has the bits of one that never stopped; what is of another render is refused."""

from __future__ import annotations

import math
import resource
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch

import bokehguide as package
from bokehguide.errors import BokehguideError
from bokehguide.guiding.config import GaussianConfig, GuidedConfig
from bokehguide.scene.types import Aperture, Scene
from bokehguide.train import MODES, RenderLoop, RenderSettings, load_checkpoint, save_checkpoint, saved_state
from bokehguide.train.checkpoint import ANOTHER, UNREADABLE, SavedState
from tests.support import restir_cases, scenes
from tests.support.same_bits import assert_same_bits
from tests.support.sharing_cases import spoil

UNFIT = r"does not fit bokehguide [\d.]+: another commit wrote it, or it is damaged; render without --resume"
"""The error for a readable file whose state is not that of the loop."""
GUIDED = [mode for mode in MODES if not mode.startswith("area")]


def scene(mode: str = "lis-o") -> Scene:
    """One in which the mode's guide finds and learns something."""
    return restir_cases.scene(24, 16) if mode.startswith("area") else scenes.emitters(48, 27)


def settings(mode: str = "lis-o", **others) -> RenderSettings:
    return RenderSettings(mode, seed=7, threads=1, reuse_radius=3.0, **others)


def rendered(mode: str, steps: int) -> RenderLoop:
    return onwards(RenderLoop(scene(mode), settings(mode)), steps)


def onwards(loop: RenderLoop, step: int) -> RenderLoop:
    while loop.step_number < step:
        loop.step()
    return loop


def resumed(path, mode: str) -> RenderLoop:
    loop = RenderLoop(scene(mode), settings(mode))
    load_checkpoint(path, loop)
    return loop


def states(value: object, name: str = "") -> dict[str, object]:
    """Every tensor and number in a state dict, by its place; times left out."""
    if isinstance(value, dict | list | tuple):
        pairs = value.items() if isinstance(value, dict) else enumerate(value)
        return {key: part for place, inner in pairs for key, part in states(inner, f"{name}/{place}").items()}
    return {} if name.startswith("/phases") else {name: value}


def assert_same_state(one: RenderLoop, other: RenderLoop) -> None:
    first, second = states(one.state_dict()), states(other.state_dict())
    assert first.keys() == second.keys()
    for name, value in first.items():
        same = torch.equal(value, second[name]) if isinstance(value, torch.Tensor) else value == second[name]
        assert same, name


@pytest.mark.slow
@pytest.mark.parametrize("mode", GUIDED)
def test_the_bits_are_those_of_an_uninterrupted_render(mode, tmp_path):
    """Stopped before the first step, within blocks of steps, at their ends, and before and after offsets begin to learn."""
    stops = [0, 1, 2, 3, 4, GaussianConfig.fits - 1, GaussianConfig.fits, GaussianConfig.fits + 1, 11]
    last = stops[-1] + 7  # past the end of another block
    loop = RenderLoop(scene(mode), settings(mode))
    for stop in stops:
        save_checkpoint(tmp_path / f"{stop}.ckpt", onwards(loop, stop), 0.0)
    onwards(loop, last)
    if mode == "lis-o":
        assert loop.mode.lens.offsets is not None and loop.mode.lens.offsets.coefficients.any()
    for stop in stops:
        again = resumed(tmp_path / f"{stop}.ckpt", mode)
        assert again.step_number == stop
        onwards(again, last)
        assert_same_bits(loop, again)
        assert_same_state(loop, again)
        for name, picture in loop.guide_images().items():
            assert torch.equal(picture, again.guide_images()[name]), name


@pytest.mark.parametrize("mode", ["uniform", "lis-o", "guided"])
def test_where_batches_were_cut_leaves_no_trace(mode, tmp_path, monkeypatch):
    """Cuts move from step to step, and begin elsewhere in a render that goes on."""
    monkeypatch.setattr("bokehguide.train.scheduler.OVERHEAD", 1)
    loop = RenderLoop(scene(mode), replace(settings(mode), threads=3))
    save_checkpoint(tmp_path / "a.ckpt", onwards(loop, 5), 0.0)
    again = RenderLoop(scene(mode), replace(settings(mode), threads=3))
    load_checkpoint(tmp_path / "a.ckpt", again)
    again.batches.spans(48 * 27)
    again.batches.took([1.0, 3.0, 2.0])
    assert loop.batches.spans(48 * 27) != again.batches.spans(48 * 27)
    assert_same_bits(onwards(loop, 18), onwards(again, 18))


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["area-restir", "area-restir+lis"])
def test_so_are_those_of_area_restir(mode, tmp_path):
    loop = rendered(mode, 2)
    save_checkpoint(tmp_path / "a.ckpt", loop, 0.0)
    again = onwards(resumed(tmp_path / "a.ckpt", mode), 4)
    assert_same_bits(onwards(loop, 4), again)
    assert_same_state(loop, again)


@pytest.mark.parametrize("mode", ["lis-o", "guided"])
def test_a_last_step_learns_once_its_state_is_needed(mode):
    """The end of an epoch, at which all parts learn: its state is that of any step, and so are later steps."""
    settled, last, onward = (rendered(mode, 3) for _ in range(3))
    settled.step()
    for loop in (last, onward):
        learned = loop.mode.lens.record_buffer.state_dict()["sums"].clone()
        loop.step(last=True)
        assert torch.equal(loop.mode.lens.record_buffer.state_dict()["sums"], learned)
    assert_same_state(settled, last)
    assert_same_bits(onwards(settled, 6), onwards(onward, 6))
    assert_same_state(settled, onward)


@pytest.mark.slow
def test_stopping_after_every_step_changes_nothing(tmp_path):
    loop = RenderLoop(scene(), settings())
    for step in range(1, 13):
        save_checkpoint(tmp_path / "a.ckpt", onwards(loop, step), 0.0)
        loop = resumed(tmp_path / "a.ckpt", "lis-o")
    assert_same_state(rendered("lis-o", 12), loop)


def test_more_samples_and_threads_may_be_asked_for(tmp_path):
    save_checkpoint(tmp_path / "a.ckpt", rendered("guided", 3), 0.0)
    longer = RenderLoop(scene(), replace(settings("guided"), spp=512, threads=2))
    load_checkpoint(tmp_path / "a.ckpt", longer)
    assert_same_bits(rendered("guided", 6), onwards(longer, 6))


def test_a_state_dict_goes_from_loop_to_loop_and_ties_them_not_together():
    one = rendered("lis-o", GaussianConfig.fits + 2)
    other = rendered("lis-o", 3)
    other.load_state_dict(one.state_dict())
    onwards(other, GaussianConfig.fits + 4)
    assert_same_state(one, rendered("lis-o", GaussianConfig.fits + 2))
    assert_same_state(onwards(one, GaussianConfig.fits + 4), other)


def test_a_loop_goes_back_to_before_its_offsets():
    early, late = rendered("lis-o", 3), rendered("lis-o", GaussianConfig.fits + 2)
    late.load_state_dict(early.state_dict())
    assert late.mode.lens.offsets is None
    assert_same_state(rendered("lis-o", GaussianConfig.fits + 3), onwards(late, GaussianConfig.fits + 3))


@pytest.mark.parametrize("seconds", [math.nan, math.inf, -1.0, "x", None])
def test_seconds_are_a_number(seconds, tmp_path):
    with pytest.raises(BokehguideError, match=r"save_checkpoint: seconds: .* is out of range; give a number of 0 or more"):
        save_checkpoint(tmp_path / "a.ckpt", RenderLoop(scene(), settings()), seconds)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("seed", [-1, 2**32 - 1])
def test_bad_samples_of_any_seed_are_kept(seed, tmp_path):
    loops = [RenderLoop(scene(), replace(settings("uniform"), seed=seed)) for _ in range(2)]
    spoil(loops[0])
    save_checkpoint(tmp_path / "a.ckpt", loops[0], 1.0)
    load_checkpoint(tmp_path / "a.ckpt", loops[1])
    assert loops[1].film.bad_samples == loops[0].film.bad_samples and loops[1].film.bad_samples[0].seed == seed


def test_vignettes_pinholes_and_bad_samples_are_kept(tmp_path):
    cat_eye = replace(scene().camera, aperture=Aperture(cat_eye=1.0))
    for camera in (cat_eye, replace(scene().camera, aperture_radius=0.0)):
        photographed = replace(scene(), camera=camera)
        loops = [RenderLoop(photographed, settings("lis-b")) for _ in range(2)]
        trace = loops[0].tracer.trace

        def spoilt(*args, trace=trace, **keywords):
            samples = trace(*args, **keywords)
            samples.radiance[:, ::9] = math.nan
            return samples

        loops[0].tracer.trace = spoilt
        loops[0].step()
        loops[0].tracer.trace = trace
        save_checkpoint(tmp_path / "a.ckpt", loops[0], 1.5)
        assert load_checkpoint(tmp_path / "a.ckpt", loops[1]) == 1.5
        assert loops[1].film.bad_count == loops[0].film.bad_count > 50
        assert loops[1].film.bad_samples == loops[0].film.bad_samples and loops[1].film.bad_samples[0].seed == 7
        assert loops[1].phases == loops[0].phases
        assert_same_bits(onwards(loops[0], 3), onwards(loops[1], 3))


def test_the_size_of_a_checkpoint_is_bounded(tmp_path):
    for mode, bytes_a_pixel in {"uniform": 226, "lis-o": 271, "guided": 293}.items():
        photographed = scenes.emitters(160, 90)
        loop = onwards(RenderLoop(photographed, settings(mode)), 9)
        save_checkpoint(tmp_path / "a.ckpt", loop, 0.0)
        bytes_of_lights = 32 * sum(
            values.numel() for name, values in loop.mode.lights.state_dict().items() if "probability" in name
        )
        assert (tmp_path / "a.ckpt").stat().st_size < 160 * 90 * bytes_a_pixel + bytes_of_lights + 50_000


def moved(one: Scene) -> Scene:
    mesh = one.meshes[0]
    return replace(one, meshes=(replace(mesh, vertices=mesh.vertices + np.float32(0.001)), *one.meshes[1:]))


REFUSED = {
    "seed was 7 and is 8": (lambda one: one, {"seed": 8}),
    "mode was lis-o and is lis-b": (lambda one: one, {"mode": "lis-b"}),
    "size was 48x27 and is 54x30": (lambda one: replace(one, film=replace(one.film, width=54, height=30)), {}),
    "max_depth was 1 and is 2": (lambda one: replace(one, film=replace(one.film, max_depth=2)), {}),
    "camera.aperture_radius was 0.1 and is 0.2": (lambda one: replace(one, camera=replace(one.camera, aperture_radius=0.2)), {}),
    "other camera.aperture": (lambda one: replace(one, camera=replace(one.camera, aperture=Aperture(blades=5))), {}),
    "other meshes": (moved, {}),
    "other materials": (lambda one: replace(one, materials=(replace(one.materials[0], roughness=0.5),)), {}),
    "other environment": (lambda one: replace(one, environment=scenes.constant_sky(0.2)), {}),
}


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    path = tmp_path_factory.mktemp("checkpoint") / "a.ckpt"
    save_checkpoint(path, rendered("lis-o", 2), 3.0)
    return path


@pytest.mark.parametrize("named", REFUSED)
def test_another_render_is_refused_by_name(named, checkpoint):
    change, others = REFUSED[named]
    loop = RenderLoop(change(scene()), replace(settings(), **others))
    with pytest.raises(BokehguideError) as refusal:
        load_checkpoint(checkpoint, loop)
    size = "give --size 48x27 to continue, or " * named.startswith("size")
    assert str(refusal.value) == f"{checkpoint}: is of another render: {named}; {size}render without --resume to start again"
    assert loop.step_number == 0


def test_the_radius_counts_where_samples_are_reused(tmp_path, checkpoint):
    load_checkpoint(checkpoint, RenderLoop(scene(), replace(settings(), reuse_radius=4.0)))
    save_checkpoint(tmp_path / "a.ckpt", rendered("area-restir", 1), 0.0)
    with pytest.raises(BokehguideError, match=r"reuse_radius was 3.0 and is 4.0"):
        load_checkpoint(tmp_path / "a.ckpt", RenderLoop(scene("area-restir"), replace(settings("area-restir"), reuse_radius=4.0)))


@pytest.mark.parametrize("cryptomatte", [True, False])
def test_names_count_where_mattes_go_by_them(cryptomatte, tmp_path):
    named, one = replace(settings(), cryptomatte=cryptomatte), scene()
    with RenderLoop(one, named) as loop:
        loop.step()
        save_checkpoint(tmp_path / "a.ckpt", loop, 0.0)
    renamed = RenderLoop(replace(one, meshes=(replace(one.meshes[0], name="other"), *one.meshes[1:])), named)
    if cryptomatte:
        with pytest.raises(BokehguideError, match="other names of mattes"):
            load_checkpoint(tmp_path / "a.ckpt", renamed)
    else:
        load_checkpoint(tmp_path / "a.ckpt", renamed)


def test_so_is_another_version(checkpoint, monkeypatch):
    monkeypatch.setattr("bokehguide.train.checkpoint.__version__", "9.9.9")
    told = (
        f"a.ckpt: was written by bokehguide {package.__version__}, and this is bokehguide 9.9.9; resume with that bokehguide, or "
    )
    with pytest.raises(BokehguideError, match=told + "render without --resume to start again$"):
        load_checkpoint(checkpoint, RenderLoop(scene(), replace(settings(), seed=8)))


def test_a_format_of_another_version_or_commit_is_told(checkpoint, tmp_path):
    """Version 0.1.0 called the fingerprint `origin`. A commit of the same version may have fewer inputs, or other parts."""
    early, fewer, other = (torch.load(checkpoint, weights_only=True) for _ in range(3))
    early["origin"] = early.pop("fingerprint") | {"software": "bokehguide 0.1.0"}
    del fewer["fingerprint"]["light groups"], other["loop"]["shadow_roulette"]
    version = f"bokehguide {package.__version__}"
    told = {
        f"was written by bokehguide 0.1.0, and this is {version}; resume with that": early,
        f"was written by another commit of {version}; resume with that": fewer,
        f"does not fit {version}: another commit wrote it, or it is damaged; render without --resume to start": other,
    }
    for words, whole in told.items():
        torch.save(whole, tmp_path / "a.ckpt")
        with pytest.raises(BokehguideError, match=f"a.ckpt: {words}"):
            load_checkpoint(tmp_path / "a.ckpt", RenderLoop(scene(), settings()))
    loop = RenderLoop(scene(), settings())
    assert saved_state(tmp_path / "a.ckpt", loop) == SavedState(2, True)
    strangers = {"bokehguide 0.1.0": early, f"another commit of {version}": fewer}
    for writer, whole in strangers.items():
        torch.save(whole, tmp_path / "a.ckpt")
        assert saved_state(tmp_path / "a.ckpt", loop) == SavedState(stranger=f"was written by {writer}")
    other = SavedState(stranger=ANOTHER, changed="other meshes")
    assert saved_state(checkpoint, RenderLoop(moved(scene()), settings())) == other


def test_a_file_that_is_no_checkpoint_is_told_from_none(checkpoint, tmp_path):
    """An empty file and a folder are nothing that another name would keep."""
    loop, path = RenderLoop(scene(), settings()), tmp_path / "a.ckpt"
    path.touch()
    for absent in (path, tmp_path, tmp_path / "none.ckpt"):
        assert saved_state(absent, loop) == SavedState()
    for name, data in {"text": b"text", "cut": checkpoint.read_bytes()[:5000]}.items():
        path.write_bytes(data)
        assert saved_state(path, loop) == SavedState(stranger=UNREADABLE), name
    for step in ("many", -3, None, 2.5):
        torch.save(changed(checkpoint, "loop", "step", value=step), path)
        assert saved_state(path, loop) == SavedState(stranger=UNREADABLE), step


def test_another_scene_is_named(checkpoint):
    other = moved(replace(scene(), name="moved"))
    with pytest.raises(BokehguideError, match=f"is of another render: scene was {scene().name} and is moved, other meshes; "):
        load_checkpoint(checkpoint, RenderLoop(other, settings()))
    load_checkpoint(checkpoint, RenderLoop(replace(scene(), name="renamed"), settings()))


def test_other_parameters_of_a_mode_take_few_words(checkpoint):
    other = replace(settings(), guided=GuidedConfig(split_count=3), gaussian=GaussianConfig(fits=3))
    with pytest.raises(BokehguideError, match="is of another render: other settings of gaussian, other settings of guided; "):
        load_checkpoint(checkpoint, RenderLoop(scene(), other))


def test_of_many_differences_a_line_names_some(checkpoint):
    other = replace(restir_cases.scene(24, 16), film=replace(scene().film, width=24, height=16))
    named = r"scene was .*, mode was .*, seed was .*, size was .* and \d+ more; render "
    with pytest.raises(BokehguideError, match=named) as refusal:
        load_checkpoint(checkpoint, RenderLoop(other, RenderSettings("lis", threads=1)))
    assert len(str(refusal.value)) < 400


def damaged_files(good: bytes) -> dict[str, bytes]:
    """Cut short, bits turned over in what torch stores and in what it stores it in, and things of another kind."""
    cut = {f"cut at {share}": good[: int(share * len(good))] for share in (0.0, 0.001, 0.3, 0.9, 0.9999)}
    turned = {}
    for place in np.random.default_rng(0).integers(0, len(good), 20):
        turned[f"turned at {place}"] = good[:place] + bytes([good[place] ^ 0x41]) + good[place + 1 :]
    return cut | turned | {"text": b"not a checkpoint\n" * 20}


def test_a_damaged_file_is_one_line(checkpoint, tmp_path):
    loop, sound = RenderLoop(scene(), settings()), 0
    for name, data in damaged_files(checkpoint.read_bytes()).items():
        (tmp_path / "a.ckpt").write_bytes(data)
        try:
            load_checkpoint(tmp_path / "a.ckpt", loop)
            sound += 1  # a bit that no reader looks at, between two records
        except BokehguideError as error:
            assert "is damaged or no checkpoint of a render; render without --resume to start again" in str(error), name
    assert sound <= 3


@pytest.mark.parametrize(
    "content",
    [
        {"weight": torch.zeros(3)},
        [1, 2],
        {"fingerprint": {"seed": "7\nmore"}},
        "without seconds",
        "without a film",
    ],
)
def test_what_torch_reads_but_is_no_render_is_refused(content, checkpoint, tmp_path):
    part = content if isinstance(content, str) else None
    if part is not None:
        whole = torch.load(checkpoint, weights_only=True)
        del (whole if part == "without seconds" else whole["loop"])[part.split()[-1]]
        content = whole
    torch.save(content, tmp_path / "a.ckpt")
    with pytest.raises(BokehguideError, match="is damaged or no checkpoint of a render" if part is None else UNFIT):
        load_checkpoint(tmp_path / "a.ckpt", RenderLoop(scene(), settings()))


def changed(checkpoint, *keys, value) -> dict:
    """What the checkpoint holds, with something else in one place."""
    whole = torch.load(checkpoint, weights_only=True)
    place = whole
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = value
    return whole


WRONG = {
    ("seconds",): "soon",
    ("loop", "step"): 2.5,
    ("loop", "mean_luminance"): math.nan,
    ("loop", "phases"): {"shading": "x"},
    ("loop", "film", "radiance"): torch.full((3, 48 * 27), math.nan, dtype=torch.float64),
    ("loop", "film", "count"): torch.zeros(1).expand(48 * 27),
    ("loop", "film", "square"): torch.zeros(48 * 27),
    ("loop", "film", "bad_count"): -1,
    ("loop", "film", "bad_samples"): [(1, 2, "x", 4)],
    ("loop", "lens"): [],
    ("loop", "lens", "uniform"): torch.zeros(1, dtype=torch.bool).expand(10**12),
    ("loop", "lens", "highlight_cells"): torch.full((2,), 10**6),
    ("loop", "lens", "epoch"): torch.tensor(2**40),
    ("loop", "lens", "field.mean"): torch.zeros(3, 1, dtype=torch.complex64),
    ("loop", "optimizers", "blend", "param_groups", 0, "lr"): math.inf,
}


@pytest.mark.parametrize("keys", WRONG, ids=lambda keys: "/".join(map(str, keys)))
def test_a_state_that_would_go_wrong_later_is_refused(keys, checkpoint, tmp_path):
    torch.save(changed(checkpoint, *keys, value=WRONG[keys]), tmp_path / "a.ckpt")
    with pytest.raises(BokehguideError, match=UNFIT):
        load_checkpoint(tmp_path / "a.ckpt", RenderLoop(scene(), settings()))


@pytest.mark.parametrize("keys", [("lens", "epoch"), ("lights", "sampler.epoch")], ids="/".join)
@pytest.mark.parametrize("epoch", [0, 5])
def test_so_is_an_epoch_that_has_not_begun(keys, epoch, tmp_path):
    save_checkpoint(tmp_path / "a.ckpt", rendered("guided", 3), 0.0)
    wrong = changed(tmp_path / "a.ckpt", "loop", *keys, value=torch.tensor(epoch))
    torch.save(wrong, tmp_path / "a.ckpt")
    with pytest.raises(BokehguideError, match=UNFIT):
        load_checkpoint(tmp_path / "a.ckpt", RenderLoop(scene("guided"), settings("guided")))


def test_so_are_moments_that_do_not_fit_their_parameters(checkpoint, tmp_path):
    """Adam's fused step would read past them."""
    whole = torch.load(checkpoint, weights_only=True)
    state = whole["loop"]["optimizers"]["blend"]["state"][0]
    state["exp_avg"] = state["exp_avg"][:1].clone()
    torch.save(whole, tmp_path / "a.ckpt")
    with pytest.raises(BokehguideError, match=UNFIT):
        load_checkpoint(tmp_path / "a.ckpt", RenderLoop(scene(), settings()))


def test_a_packed_checkpoint_is_not_unpacked(checkpoint, tmp_path):
    """It could unfold to any size; torch writes none."""
    with zipfile.ZipFile(checkpoint) as archive, zipfile.ZipFile(tmp_path / "a.ckpt", "w", zipfile.ZIP_DEFLATED) as packed:
        for name in archive.namelist():
            packed.writestr(name, archive.read(name))
    with pytest.raises(BokehguideError, match="is damaged or no checkpoint of a render"):
        load_checkpoint(tmp_path / "a.ckpt", RenderLoop(scene(), settings()))


def test_what_a_checkpoint_says_of_itself_is_cut(checkpoint, tmp_path):
    torch.save(changed(checkpoint, "fingerprint", "seed", value="x" * 5000), tmp_path / "a.ckpt")
    with pytest.raises(BokehguideError, match=r"seed was x+… and is 7") as refusal:
        load_checkpoint(tmp_path / "a.ckpt", RenderLoop(scene(), settings()))
    assert len(str(refusal.value)) < 300


class Unpickled:
    """Code that a checkpoint must not be able to run."""

    def __reduce__(self):
        return (print, ("run",))


def test_a_checkpoint_runs_no_code(tmp_path, capsys):
    torch.save({"fingerprint": Unpickled()}, tmp_path / "a.ckpt")
    with pytest.raises(BokehguideError, match="is damaged or no checkpoint"):
        load_checkpoint(tmp_path / "a.ckpt", RenderLoop(scene(), settings()))
    assert "run" not in capsys.readouterr().out


def test_a_missing_file_and_a_folder_are_named(tmp_path):
    for path in (tmp_path / "none.ckpt", tmp_path):
        with pytest.raises(BokehguideError, match=f"^{path}: cannot be read"):
            load_checkpoint(path, RenderLoop(scene(), settings()))


def test_the_old_one_stands_where_the_new_one_cannot_be_written(checkpoint, tmp_path):
    (tmp_path / "a.ckpt").write_bytes(checkpoint.read_bytes())
    loop = rendered("lis-o", 1)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))  # as on a disk that is full
    try:
        with pytest.raises(BokehguideError, match=r"a\.ckpt: cannot be written \(File too large\); choose another folder$"):
            save_checkpoint(tmp_path / "a.ckpt", loop, 0.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.name for path in tmp_path.iterdir()] == ["a.ckpt"]
    assert (tmp_path / "a.ckpt").read_bytes() == checkpoint.read_bytes()
