"""Agreement of the native core and PyTorch on mixtures of Gaussians on the lens, their gradients, and the record of hits."""

from __future__ import annotations

from functools import cache

import pytest
import torch
from torch import Tensor

from bokehguide.guiding.config import GaussianConfig
from bokehguide.guiding.gaussian_guide import GaussianGuide
from bokehguide.guiding.lens_queries import UniformQuery
from bokehguide.guiding.record_buffer import RecordBuffer
from bokehguide.models.gaussian_mixture import GaussianMixture
from bokehguide.models.kl import blend_gradient, offset_gradient
from bokehguide.models.native_mixture import NativeGaussianMixture
from bokehguide.render.camera import ThinLensCamera
from bokehguide.runtime import native
from bokehguide.scene import Overrides, load_scene
from bokehguide.scene.types import Aperture, Camera
from bokehguide.train import RenderLoop, RenderSettings
from tests.support.guides import gaussian_guide, mixture_of, mixture_query, pixel_batch
from tests.support.native_cases import core, each_instruction_set

WIDTH, HEIGHT = 64, 36
STEPS = 12
HEPTAGON = Aperture(blades=7, rotation=20.0, ratio=1.4, cat_eye=0.6)
RENDERED = ("fairy-lights", "night-street")
EXTREME = (
    "far focus",
    "near focus",
    "tiny",
    "huge",
    "wide lens",
    "heptagon",
    "cubic",
    "without offsets",
    "one, which few pixels see",
)


def rendered(name: str) -> GaussianGuide:
    """The guide of a loop that has learned in the native core, with offsets in the last steps."""
    scene = load_scene(name, Overrides(width=WIDTH, height=HEIGHT))
    with RenderLoop(scene, RenderSettings("lis-o", threads=1)) as loop:
        for _ in range(STEPS):
            loop.step()
    guide = loop.mode.lens
    assert isinstance(guide, GaussianGuide) and guide.offsets is not None
    return guide


def extreme(name: str) -> GaussianGuide:
    """Gaussians in and around the frame, with random β and offsets."""
    generator = torch.Generator().manual_seed(1)
    distance = {"far focus": 1e5, "wide lens": 1.0}.get(name, 2.0)
    radius, aperture = 1.5 if name == "wide lens" else 0.1, HEPTAGON if name == "heptagon" else None
    camera = Camera(
        (0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=40.0, aperture_radius=radius, focus_distance=distance, aperture=aperture
    )
    degree = 3 if name == "cubic" else 2
    guide = gaussian_guide(ThinLensCamera(camera, WIDTH, HEIGHT), config=GaussianConfig(offset_degree=degree))
    count = 1 if name == "one, which few pixels see" else 60

    def numbers(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    depth = 2.0 * 10.0 ** (3.0 * numbers(count) - 0.5)
    if name == "near focus":
        depth = 2.0 * (1.0 + 1e-3 * (numbers(count) - 0.5))
    slope = (numbers(2, count) - 0.5) * torch.tensor([[1.0], [0.6]])
    scale = {"tiny": 1e-6, "huge": 1.0, "near focus": 0.02}.get(name, 0.01)
    sigma = scale * depth * (0.2 + numbers(count))
    guide.field.assign(torch.cat((slope * depth, depth[None])), 2.0 * sigma, sigma, torch.exp(4.0 * numbers(count)))
    guide.freeze()
    assert guide.offsets is not None
    with torch.no_grad():
        guide.offsets.coefficients.copy_(0.3 * (numbers(*guide.offsets.coefficients.shape) - 0.5))
        guide.blend.logit.copy_(4.0 * numbers(WIDTH * HEIGHT) - 2.0)
    if name == "without offsets":
        guide.offsets = None
    return guide


@cache
def guide_of(name: str) -> GaussianGuide:
    core()
    return rendered(name) if name in RENDERED else extreme(name)


@cache
def both(name: str) -> tuple[NativeGaussianMixture, GaussianMixture]:
    """The mixtures of all pixels in the native core and in PyTorch."""
    guide = guide_of(name)
    batch = pixel_batch(guide)
    found = mixture_of(guide, batch)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(native.SWITCH, "0")
        expected = mixture_of(guide, batch)
    assert isinstance(found, NativeGaussianMixture) and isinstance(expected, GaussianMixture)
    return found, expected


def uniforms(seed: int) -> Tensor:
    """Numbers of a render, with the smallest and the largest among them."""
    bits = torch.randint(0, 1 << 23, (5, WIDTH * HEIGHT), generator=torch.Generator().manual_seed(seed))
    bits[2:, 0], bits[2:, 1] = 0, (1 << 23) - 1
    return (bits + 0.5) / 2.0**23


def differing(found: Tensor, expected: Tensor, tolerance: float) -> float:
    """Share of entries that differ by more than a relative tolerance."""
    return float(((found - expected).abs() > tolerance * expected.abs() + 1e-30).double().mean())


BY_NAME = pytest.mark.parametrize("name", RENDERED + EXTREME)


@BY_NAME
def test_gaussians_and_weights_agree(name):
    found, expected = both(name)
    assert torch.equal(found.owner, expected.owner)
    assert torch.equal(found.guided, expected.guided) and torch.equal(found.beta, expected.beta)
    assert int(found.guided.sum()) > (1 if name.startswith("one") else 200)
    for field in ("mean", "sigma", "weight"):
        assert differing(getattr(found, field), getattr(expected, field), 1e-6) == 0.0, field


@BY_NAME
def test_lens_points_agree(name):
    """PyTorch's `erfinv` has few digits in the tails."""
    found, expected = both(name)
    for seed in range(8):
        one, other = found.sample(uniforms(seed)).points, expected.sample(uniforms(seed)).points
        off = (one - other).abs() > 1e-4 * (found.lens.radius + other.abs())
        assert float(off.any(0).double().mean()) <= 2e-3
        assert torch.equal(one[:, ~found.guided], other[:, ~found.guided])


def test_draws_are_normal_to_the_tails():
    """Against quantiles in double precision."""
    found = both("without offsets")[0]
    numbers = uniforms(1)
    numbers[:2] = 0.0  # the first candidate, which has a weight
    points, first = found.sample(numbers).points, found._start[:-1].clamp(max=len(found.weight) - 1)
    checked = found.guided & (found.weight[first] > 0.0)
    normals = 2.0**0.5 * torch.erfinv(2.0 * numbers[2:].double() - 1.0)
    mean, sigma, focus = found.mean[:, first].double(), found.sigma[first].double(), found.focus.double()
    highlight = mean + sigma * normals
    k = focus[2] / (focus[2] - highlight[2])
    expected = focus[:2] + k * (highlight[:2] - focus[:2])
    near = checked & (k.abs() < 20.0)
    assert int(near.sum()) > 100
    size = found.lens.radius + (k * sigma).abs() + (k * focus[:2]).abs().amax(0)
    assert float(((points - expected).abs() / size)[:, near].max()) < 2e-5


@BY_NAME
def test_densities_agree(name):
    """At lens points of the mixture, and at points anywhere on the lens plane. Tiny Gaussians lose digits in single precision."""
    (found, expected), tolerance = both(name), 0.2 if name == "tiny" else 1e-3
    anywhere = found.lens.radius * 1.2 * (2.0 * uniforms(9)[:2] - 1.0)
    for points in (expected.sample(uniforms(3)).points, expected.sample(uniforms(4)).points, anywhere):
        one, other = found.evaluate(points), expected.evaluate(points)
        for field in ("components", "mixture", "density"):
            assert differing(getattr(one, field), getattr(other, field), tolerance) <= 3e-3, field
        assert torch.equal(found.pdf(points), one.density)


@BY_NAME
def test_gradients_agree(name):
    guide, (found, expected) = guide_of(name), both(name)
    batch = pixel_batch(guide)
    at = expected.evaluate(expected.sample(uniforms(5)).points)
    ratio = torch.rand(WIDTH * HEIGHT, generator=torch.Generator().manual_seed(6))
    ratio *= (uniforms(7)[0] < 0.7) & found.lens.contains(at.points)
    of_blend = blend_gradient(expected, ratio, at)
    torch.testing.assert_close(blend_gradient(found, ratio, at), of_blend, rtol=1e-5, atol=1e-6)
    if guide.offsets is None:
        return
    gaussian = mixture_query(guide, batch).component
    of_offsets = offset_gradient(expected, guide.offsets, gaussian, batch.raster, ratio, at)
    scale = float(of_offsets.abs().max())
    torch.testing.assert_close(found.offset_gradient(ratio, at), of_offsets, rtol=1e-3, atol=1e-5 * scale)
    assert scale > 0.0


@pytest.mark.parametrize("name", ("night-street", "heptagon"))
def test_the_mixture_of_a_pixel_does_not_depend_on_its_batch(name):
    guide, whole = guide_of(name), both(name)[0]
    part = slice(7, WIDTH * HEIGHT - 5)
    alone = mixture_of(guide, pixel_batch(guide, part))
    every = whole.sample(uniforms(5)).points
    points = alone.sample(uniforms(5)[:, part]).points
    assert torch.equal(points, every[:, part])
    assert torch.equal(alone.pdf(points), whole.pdf(every)[part])


@pytest.mark.parametrize("name", ("night-street", "far focus"))
def test_all_instruction_sets_give_the_same_bits(name):
    guide = guide_of(name)

    def results() -> tuple[Tensor, ...]:
        mixture = mixture_of(guide, pixel_batch(guide))
        assert isinstance(mixture, NativeGaussianMixture)
        points = mixture.sample(uniforms(6)).points
        at = mixture.evaluate(points)
        return points, at.components, at.density, mixture.weight, mixture.offset_gradient(uniforms(8)[0], at)

    first, *others = each_instruction_set(results)
    assert all(torch.equal(one, two) for other in others for one, two in zip(first, other))


@pytest.mark.parametrize("name", ("fairy-lights", "night-street", "tiny", "heptagon"))
def test_pixels_without_candidates_get_the_bits_of_the_uniform_lens(name):
    guide = guide_of(name)
    batch = pixel_batch(guide)
    query = mixture_query(guide, batch)
    drawn, alone = query.sample(), ~query.mixture.guided
    uniform = UniformQuery(guide.camera.lens, batch.focus, query.uniforms[2:4]).sample()
    assert int(alone.sum()) > 10
    assert torch.equal(drawn.points[:, alone], uniform.points[:, alone])
    assert torch.equal(drawn.weight[alone], uniform.weight[alone])


def test_a_batch_without_candidates_is_uniform():
    guide = guide_of("without offsets")
    batch, none = pixel_batch(guide), torch.zeros(0, dtype=torch.int64)
    start = torch.zeros(WIDTH * HEIGHT + 1, dtype=torch.int64)
    mixture = guide.mixture(batch.pixels, batch.raster, batch.focus, start, none)
    assert isinstance(mixture, NativeGaussianMixture) and not mixture.guided.any() and not mixture.beta.any()
    points = mixture.sample(uniforms(2)).points
    assert torch.equal(points, mixture.lens.sample(uniforms(2)[2:4]))
    torch.testing.assert_close(mixture.pdf(points), mixture.lens.transmission(points) / mixture.lens.area)


def test_records_agree(monkeypatch):
    """Cells, positions and sums of rays in all directions; some hit nothing, and some have no weight."""
    guide, generator = guide_of("heptagon"), torch.Generator().manual_seed(3)
    points = 0.1 * torch.randn(2, 5001, generator=generator)
    directions = torch.randn(3, 5001, generator=generator) * torch.tensor([[0.4], [0.3], [1.0]]) + torch.tensor(
        [[0.0], [0.0], [0.5]]
    )
    directions = guide.camera.axes @ directions
    light, distance = (torch.exp(scale * torch.randn(5001, generator=generator)) for scale in (3.0, 2.0))
    distance[::7], weight = torch.inf, (torch.rand(5001, generator=generator) < 0.9).float()
    points[0, 3], directions[:, 4] = torch.nan, 0.0
    records, sums = [], []
    for form in ("1", "0"):
        monkeypatch.setenv(native.SWITCH, form)
        records.append(guide.records(points, directions, distance, light, weight))
        record = RecordBuffer(guide.camera)
        record.add([records[-1]])
        sums.append(record.sums)
    found, expected = records
    assert float((found.cells != expected.cells).double().mean()) <= 1e-3
    assert 1000 < int((expected.cells >= 0).sum()) < 4000 and int((expected.cells[::7] >= 0).sum()) > 100
    torch.testing.assert_close(found.points, expected.points, rtol=1e-6, atol=1e-6, equal_nan=True)
    assert differing(sums[0], sums[1], 1e-5) <= 2e-3


def test_pytorch_takes_over_where_the_core_is_switched_off(monkeypatch):
    monkeypatch.setenv(native.SWITCH, "0")
    assert isinstance(mixture_of(guide_of("heptagon")), GaussianMixture)
