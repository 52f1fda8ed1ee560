"""The script of the ablations at a tiny size."""

import json
import math
import subprocess
import sys
from pathlib import Path

import ablations
import other_fields
import pytest
import torch

from bokehguide.models.lens_distribution import GuidedLensDistribution, _kept
from bokehguide.models.projection import lens_density
from bokehguide.render.lens import Lens
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.pixels import pixel_numbers
from bokehguide.scene import Overrides, load_scene
from bokehguide.train import RenderLoop, RenderSettings, loop, spot_guide
from bokehguide.train.guide import GuidedBatch

SCRIPT = Path(__file__).parent.parent / "scripts/ablations.py"


def run(folder: Path, *options: str) -> subprocess.CompletedProcess:
    small = ["--size", "32x18", "--spp", "4", "--cache", "cache", "--out", "out"]
    command = [sys.executable, str(SCRIPT), "fairy-lights", *small, *options]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)


def test_the_table_and_what_is_kept(tmp_path):
    finished = run(tmp_path, "--only", "fixed-beta,positions", "--seeds", "2")
    assert finished.returncode == 0, finished.stderr
    table = (tmp_path / "out/ablations.md").read_text()
    assert finished.stdout.strip() == table.strip()
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
    assert lines[0] == ["change", "to", "mode", "fairy-lights", "all"]
    assert [line[:3] for line in lines[2:]] == [
        ["none: MAPE", "", "lis"],
        ["none: MAPE", "", "lis-o"],
        *(["fixed β", value, "lis"] for value in ("0.5", "0.65", "0.9")),
        ["record positions", "plain means", "lis-o"],
    ]
    for line in lines[4:]:
        value, error = line[3].split(" ± ")
        assert 0.3 < float(value) < 3.0 and float(error) >= 0.0 and line[4] == value

    path = tmp_path / "out/ablations.json"
    kept = json.loads(path.read_text())
    assert len(kept) == 2 * (2 + 4)
    path.write_text(json.dumps(dict.fromkeys(kept, 0.5)))
    assert run(tmp_path, "--only", "fixed-beta", "--seeds", "1").stdout.count("| 1.000 ± - | 1.000 |") == 3
    assert json.loads(path.read_text()).keys() == kept.keys()


@pytest.mark.parametrize("text", ["{", "[]", '{"a": "b"}', '{"a": NaN}', "\xff"])
def test_damage_is_one_line(text, tmp_path):
    path = tmp_path / "ablations.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(ablations.BokehguideError, match=r"ablations\.json: is damaged or no ablations'; remove it or choose"):
        ablations.read_kept(path)


def test_a_mistake_is_one_line(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/ablations.json").write_text("{")
    for options, told in (((), "ablations.json: is damaged"), (("--only", "alfa"), "'alfa' is unknown; choose of alpha, ")):
        finished = run(tmp_path, *options)
        assert (finished.returncode, finished.stdout, finished.stderr.count("\n")) == (2, "", 1)
        assert "error: " in finished.stderr and told in finished.stderr


@pytest.mark.parametrize("name, modes", [("glitter", ("lis", "lis-b", "lis-o")), ("chrome", ("guided",))])
def test_every_kind_of_change_changes_the_picture_and_is_undone(name, modes):
    """Where there are lamps at many depths, and where their reflections are found."""
    scene = load_scene(name, Overrides(width=64, height=36))
    changes = [changes[-1] for changes in ablations.CHANGES.values() if changes[-1].mode in modes]
    tracer = PathTracer(scene)
    settings = {mode: RenderSettings(mode, spp=10, threads=1) for mode in modes}

    def picture(change: ablations.Change) -> torch.Tensor:
        return ablations.rendered(scene, settings[change.mode], change, tracer)

    defaults = {mode: picture(ablations.Change("default", mode, mode=mode)) for mode in settings}
    for change in changes:
        found = picture(change)
        assert found.isfinite().all()
        assert not torch.equal(found, defaults[change.mode]), f"{change.what} {change.value} changes nothing"
    last = ablations.Change("default", modes[-1], mode=modes[-1])
    assert torch.equal(picture(last), defaults[modes[-1]])


def test_every_part_of_guided_that_is_left_out_changes_the_picture():
    """On a scene that has them all: lamps of a map, panels, and reflections."""
    scene = load_scene("night-street", Overrides(width=64, height=36))
    settings, tracer = RenderSettings("guided", spp=6, threads=1), PathTracer(scene)
    default = ablations.rendered(scene, settings, ablations.Change("default", "guided", mode="guided"), tracer)
    for change in ablations.CHANGES["guided"]:
        found = ablations.rendered(scene, settings, change, tracer)
        assert found.isfinite().all()
        assert not torch.equal(found, default), f"{change.what} changes nothing"


def test_every_part_of_guided_that_is_added_to_nothing_changes_the_picture():
    """To nothing, or to those parts that it works on."""
    scene = load_scene("night-street", Overrides(width=64, height=36))
    settings, tracer = RenderSettings("guided", spp=6, threads=1), PathTracer(scene)
    before = {}
    for part in ablations.PARTS:
        needed = ablations.NEEDED.get(part, ())
        if needed not in before:
            before[needed] = ablations.rendered(scene, settings, ablations.guided_with("some parts", needed), tracer)
        found = ablations.rendered(scene, settings, ablations.alone(part), tracer)
        assert found.isfinite().all()
        assert not torch.equal(found, before[needed]), f"{part} changes nothing"


def test_the_gradient_of_the_field_is_that_of_automatic_differentiation():
    """Of σ and weight of each of four Gaussians, seen by a hundred pixels."""
    generator = torch.Generator().manual_seed(2)
    lens, pixels, count = Lens(0.2, 2.0), 100, 4
    focus = torch.cat((torch.rand(2, pixels, generator=generator) - 0.5, torch.full((1, pixels), 2.0)))
    mean = torch.tensor([[0.1, -0.2, 0.3, 0.0], [0.0, 0.1, -0.3, 0.2], [4.0, 5.0, 1.2, 6.0]])
    start, gaussian = count * torch.arange(pixels + 1), torch.arange(count).repeat(pixels)
    points, ratio = (torch.rand(2, pixels, generator=generator) - 0.5) * 0.28, torch.rand(pixels, generator=generator)
    sigma = torch.tensor([0.1, 0.3, 0.05, 0.4]).log().requires_grad_()
    weight = torch.tensor([1.0, 2.0, 0.5, 1.0]).log().requires_grad_()

    def seen(*of_field: torch.Tensor) -> GuidedLensDistribution:
        each = (values.exp().index_select(0, gaussian) for values in of_field)
        beta = torch.full((pixels,), 0.7)
        return GuidedLensDistribution(lens, focus, beta, start, mean.index_select(1, gaussian), *each)

    with torch.no_grad():
        mixture = seen(sigma, weight)
        found = other_fields.field_gradient(mixture, ratio, mixture.evaluate(points))
    found = torch.zeros(2, count, dtype=found.dtype).index_add_(1, gaussian, found)
    mixture = seen(sigma, weight)
    shares = (weight.exp()[gaussian] * _kept(mixture.mean, mixture.sigma, focus, mixture.owner, torch.tensor(lens.radius))).reshape(pixels, count)
    parts = (shares / shares.sum(1, keepdim=True).clamp(min=1e-30)).reshape(-1) * mixture.component_pdf(points)
    density = 0.7 * parts.reshape(pixels, count).sum(1) + 0.3 * lens.transmission(points) / lens.area
    (-(ratio * density.log())[mixture.guided]).sum().backward()
    torch.testing.assert_close(found, torch.stack((sigma.grad, weight.grad)).to(found.dtype), rtol=1e-3, atol=1e-3)


def test_the_gradient_of_found_highlights_is_that_of_the_loss(monkeypatch):
    """Against automatic differentiation of the mixture with Gaussians in the place of found discs."""
    monkeypatch.setattr(loop, "SpotGuide", other_fields.LearntSpots)
    monkeypatch.setattr(spot_guide, "known_lamps", ablations.no_lamps)
    render = RenderLoop(load_scene("glitter", Overrides(width=64, height=36)), RenderSettings("guided", 32, threads=1))
    for _ in range(17):
        render.step()
    guide, generator = render.guide, torch.Generator().manual_seed(3)
    assert bool((guide.changes != 0.0).any())
    pixels, camera = slice(0, 64 * 36), render.camera
    numbers = pixel_numbers(pixels)
    raster = torch.stack((numbers % 64, numbers // 64)) + 0.5
    focus = camera.focus_points(raster)
    mixture, spot, _ = guide._mixture(pixels, focus)
    ratio = torch.rand(len(numbers), generator=generator)
    at = mixture.evaluate(camera.lens.sample(torch.rand(2, len(numbers), generator=generator)))
    found = guide._gradient(GuidedBatch(pixels, raster, mixture, spot), ratio, at)
    mean, sigma = guide._learnt()
    seen = (at.points[:, mixture.owner], focus[:, mixture.owner], mean[:, spot], sigma[spot])
    density = lens_density(*(values.double() for values in seen))
    weight = mixture.weight * guide.changes[4].exp()[spot].double()
    total, mixed = torch.zeros(2, len(numbers), dtype=torch.float64).index_add(1, mixture.owner, torch.stack((weight, weight * density)))
    whole = mixture.beta * mixed / total.clamp(min=1e-30) + (1.0 - mixture.beta) * camera.lens.transmission(at.points) / camera.lens.area
    guide.changes.grad = None
    (-(ratio * whole.log())[mixture.guided]).sum().backward()
    assert bool((found.abs().amax(1) > 0.1).all())
    torch.testing.assert_close(found, guide.changes.grad.double(), rtol=2e-3, atol=1e-3)


def test_the_standard_error_is_that_of_repeated_quotients():
    generator = torch.Generator().manual_seed(1)
    changed = 0.5 + 0.02 * torch.randn(4000, 3, generator=generator)
    default = 0.4 + 0.03 * torch.randn(4000, 3, generator=generator)
    found = [ablations.ratio(*pair) for pair in zip(changed, default)]
    values, errors = torch.tensor(found).T
    assert float(values.mean()) == pytest.approx(1.25, rel=0.01)
    assert math.sqrt(float(errors.square().mean())) == pytest.approx(float(values.std()), rel=0.05)
    assert ablations.ratio(torch.tensor([0.5]), torch.tensor([0.25])) == (2.0, None)
