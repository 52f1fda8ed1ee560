"""Emitters of an environment map: draws against the density, the density against 1 and against the map itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
import torch

from bokehguide.color import LUMINANCE
from bokehguide.models.emitters.environment import EnvironmentEmitters, ViewedEnvironment
from bokehguide.models.emitters.lens_cone import ANGLE_ERROR, _uses_circle
from bokehguide.models.projection import FAR_OUTSIDE, LENS_MARGIN
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.lights.environment import EnvironmentMap
from bokehguide.render.vector import luminance
from bokehguide.scene.types import Camera, Environment
from tests.support.lens_cases import PolarGrid, histogram_check
from tests.support.statistical import SIGNIFICANCE

DRAWS = 100_000
EMITTER, OTHER = 1, 0
"""Numbers of the emitter that is looked at and of another one of the same map."""


@dataclass(frozen=True)
class MapCase:
    """An emitter of texels (row, column, brightness) on a black map `[height, 2 height]`, seen obliquely through a focus point.

    aside: offset of the camera's target from the emitter. lens: radius of the lens, metres, at a focus distance of 2; a small
    lens clips the emitter. off: offset of x_F from the line between the lens centre and the emitter's middle.
    """

    name: str
    texels: tuple[tuple[int, int, float], ...]
    height: int = 64
    rotation: float = 0.0
    aside: tuple[float, float, float] = (0.2, -0.1, 0.15)
    lens: float = 0.6
    off: tuple[float, float] = (0.02, -0.03)

    def environment(self) -> Environment:
        radiance = np.zeros((self.height, 2 * self.height, 3), np.float32)
        for row, column, bright in self.texels:
            radiance[row, column] = bright * np.array((1.0, 0.4 * column % 1.0, 2.0))
        radiance[self.height // 2, (self.texels[0][1] + 20) % (2 * self.height)] = 5.0
        return Environment(radiance, self.rotation)

    def middle(self) -> np.ndarray:
        """Unit world direction `[3]` of the emitter, about."""
        rows, columns = np.array([texel[:2] for texel in self.texels]).T
        theta = np.pi * (rows + 0.5) / self.height
        phi = np.pi * (columns + 0.5) / self.height - np.pi - np.radians(self.rotation)
        towards = np.stack((np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi))).sum(1)
        return towards / np.linalg.norm(towards)

    def camera(self, way: float = 1.0) -> ThinLensCamera:
        target = tuple(way * self.middle() + self.aside)
        return ThinLensCamera(Camera((0.0, 0.0, 0.0), target, aperture_radius=self.lens, focus_distance=FOCUS_DISTANCE), 64, 36)

    def emitters(self, way: float = 1.0) -> EnvironmentEmitters:
        luminance = self.environment().radiance.astype(np.float64) @ LUMINANCE
        number = np.where(luminance > 0.0, OTHER, -1)
        for row, column, _ in self.texels:
            number[row, column] = EMITTER
        return EnvironmentEmitters(luminance, number, self.rotation, self.camera(way))

    def focus(self) -> torch.Tensor:
        """x_F `[3, 1]` through which the emitter is seen from about the middle of the lens."""
        local = self.camera().axes.double().numpy().T @ self.middle()
        return torch.tensor(local / local[2] * FOCUS_DISTANCE + (*self.off, 0.0)).float()[:, None]

    def seen(
        self, count: int, emitters: EnvironmentEmitters | None = None, number: int = EMITTER, whole: bool = False
    ) -> ViewedEnvironment:
        """The emitter as the one candidate of so many pixels; whole: said to be within the lens."""
        focus = self.focus().expand(3, count)
        return ViewedEnvironment(
            emitters or self.emitters(), torch.full((count,), number), torch.arange(count), focus, torch.full((count,), whole)
        )

    def draw(
        self, count: int, seed: int, emitters: EnvironmentEmitters | None = None, number: int = EMITTER, whole: bool = False
    ) -> torch.Tensor:
        bits = torch.randint(0, 1 << 23, (2, count), generator=torch.Generator().manual_seed(seed))
        return self.seen(count, emitters, number, whole).sample(torch.arange(count), (bits + 0.5) / 2.0**23)

    def pdf(self, points: torch.Tensor, emitters: EnvironmentEmitters | None = None) -> torch.Tensor:
        return self.seen(points.shape[1], emitters).pdf(points.float()).double()

    def directions(self, points: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
        """World directions `[3, N]` that lens points `[2, N]` see, and their solid angle per lens area `[N]`."""
        focus = self.focus().double().numpy()
        ray = np.concatenate((focus[:2] - points.double().numpy(), np.repeat(focus[2:], points.shape[1], 1)))
        distance = np.linalg.norm(ray, axis=0)
        return self.camera().axes.double().numpy() @ ray / distance, focus[2] / distance**3

    def places(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Columns and rows `[N]` of directions `[3, N]` on the map, in texels from its corner."""
        x, y, z = directions
        column = (0.5 + np.arctan2(x, -z) / (2.0 * np.pi) + self.rotation / 360.0) * 2 * self.height
        return column % (2 * self.height), np.arctan2(np.hypot(x, z), y) / np.pi * self.height

    def frame(self) -> np.ndarray:
        """World axes `[3, 3]` of which the last leads from the lens's centre through x_F."""
        forward = self.camera().axes.double().numpy() @ self.focus().double().numpy()[:, 0]
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, (0.3, 0.8, 0.4))
        right /= np.linalg.norm(right)
        return np.stack((right, np.cross(right, forward), forward), 1)

    def is_wide(self) -> bool:
        """Whether all of the circle of the map that holds what the lens sees is taken to be seen."""
        return bool(_uses_circle(self.emitters().cones(self.focus()))[0])

    def widest(self) -> float:
        """Radius on `flat` within which the lens is seen."""
        focus, angle = self.focus().double().numpy(), np.linspace(0.0, 2.0 * np.pi, 10_000)
        rim = LENS_MARGIN * self.lens * np.stack((np.cos(angle), np.sin(angle), np.zeros_like(angle)))
        if not self.is_wide():
            return LENS_MARGIN * self.lens + ANGLE_ERROR * float(focus[2, 0])
        cosine = focus[:, 0] @ (focus - rim) / np.linalg.norm(focus - rim, axis=0) / np.linalg.norm(focus)
        return float(np.tan(np.arccos(cosine.min()) + ANGLE_ERROR))

    def flat(self, points: torch.Tensor) -> torch.Tensor:
        """A plane `[2, N]` on which all that is drawn lies in a circle, for lens points `[2, N]`: that of the lens, or, of what
        is wide, one before x_F, at a distance of 1."""
        if not self.is_wide():
            return points.double()
        local = self.frame().T @ self.directions(points)[0]
        return torch.from_numpy(local[:2] / local[2])

    def on_lens(self, flat: torch.Tensor) -> tuple[torch.Tensor, np.ndarray]:
        """Lens points `[2, N]` for points of this plane, and the area of the lens plane for one on this, `[N]`."""
        if not self.is_wide():
            return flat, np.ones(flat.shape[1])
        ray = np.concatenate((flat.numpy(), np.ones((1, flat.shape[1]))))
        local = self.camera().axes.double().numpy().T @ (self.frame() @ ray)
        focus = self.focus().double().numpy()
        points = torch.from_numpy(focus[:2] - local[:2] * (focus[2] / local[2]))
        return points, np.linalg.norm(ray, axis=0) ** -3 / self.directions(points)[1]

    def cells(self) -> PolarGrid:
        """A grid of `flat` that contains all draws of the emitter; centred on the map's top if the density has its pole there."""
        draws = self.flat(drawn(self.draw(10_000, seed=9))).numpy()
        widest = self.widest()
        if np.hypot(*draws).max() > 0.98 * widest:
            return PolarGrid(widest * np.sqrt(np.linspace(0.0, 1.0, 13)), 16)
        centre = 0.5 * (draws.min(1) + draws.max(1))
        if min(texel[0] for texel in self.texels) == 0:
            local = self.camera().axes.double().numpy()[1]
            focus = self.focus().double().numpy()[:, 0]
            centre = self.flat(torch.from_numpy(focus[:2] - local[:2] * (focus[2] / local[2]))[:, None])[:, 0].numpy()
        reach = 1.1 * np.hypot(*(draws - centre[:, None])).max()
        return PolarGrid(reach * np.sqrt(np.linspace(0.0, 1.0, 13)), 16, tuple(centre))


FOCUS_DISTANCE = 2.0
SQUARE = tuple((row, column, 7.0) for row in (20, 21) for column in (40, 41))
CORNER = ((20, 90, 1.0), (21, 90, 20.0), (22, 90, 3.0), (22, 91, 9.0), (22, 92, 0.5))
FORK = tuple((row, column, 1.0 + column % 3) for row in (40, 41) for column in (60, 61, 65, 66)) + tuple(
    (42, column, 2.0) for column in range(60, 67)
)
TOP = tuple((row, column, 1.0 + column) for row in (1, 2) for column in range(30, 50))
POLE = tuple((0, column, 4.0) for column in range(10, 20))
RING = tuple((row, column, 2.0 + column % 4) for row in (1, 2) for column in range(16))
EDGE = ((35, 127, 5.0), (35, 0, 1.0), (36, 0, 2.0))
WINDOW = tuple((row, column, 3.0 + (row * column) % 4) for row in range(25, 45) for column in range(30, 60))
CAP = tuple((row, column, 1.0 + row) for row in range(3) for column in range(400))
GAP = tuple((row, column, 2.0) for row in (7, 8, 9) for column in range(121))
WHOLE = [
    MapCase("square", SQUARE),
    MapCase("one texel", ((33, 60, 2.0),), rotation=75.0),
    MapCase("uneven corner", CORNER, rotation=-130.0),
    MapCase("across the edge", EDGE, rotation=33.0),
    MapCase("near the top", TOP, rotation=33.0, lens=1.0),
    MapCase("top row", POLE, aside=(0.2, -0.1, -0.3)),
    MapCase("coarse map", ((3, 7, 1.0), (3, 8, 2.0)), height=8, lens=2.0),
]
CUT = [
    MapCase("square, cut", SQUARE, lens=0.12),
    MapCase("square, from aside", SQUARE, lens=0.1, off=(0.12, 0.1)),
    MapCase("one texel, cut", ((33, 60, 2.0),), rotation=75.0, lens=0.05),
    MapCase("corner, cut", CORNER, rotation=-130.0, lens=0.15, off=(-0.08, 0.02)),
    MapCase("fork, cut", FORK, lens=0.35, off=(0.0, 0.05)),
    MapCase("across the edge, cut", EDGE, rotation=33.0, lens=0.1),
    MapCase("near the top, cut", TOP, rotation=33.0, lens=0.1),
    MapCase("about the top", RING, height=8, aside=(0.1, 0.0, 0.2), lens=0.8, off=(0.1, 0.05)),
    MapCase("far larger than the lens", WINDOW, lens=0.1, off=(0.1, 0.2)),
    MapCase("a cap through a small lens", CAP, height=1024, aside=(0.2, -0.1, -0.3), lens=0.008, off=(0.0, 0.01)),
    MapCase("a ring with a gap", GAP, lens=0.24, off=(0.1, 0.6), aside=(0.3, 0.0, 0.1)),
    MapCase("very aslant", WINDOW, lens=0.1, aside=(-1.5, 0.4, 1.2), off=(0.1, 0.2)),
    MapCase("hardly seen", WINDOW, lens=0.1, off=(0.85, 0.0)),
]
CASES = WHOLE + CUT
SUN = MapCase("a small sun at the top", ((0, 100, 4.0),), height=512, aside=(0.2, -0.1, -0.3), lens=0.008, off=(0.004, 0.002))
"""So narrow near the top that cells are too wide for it."""
BY_NAME = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)


def named(name: str) -> MapCase:
    return next(case for case in CASES if case.name == name)


def drawn(points: torch.Tensor) -> torch.Tensor:
    """Those of lens points `[2, N]` that are any: on some rows the lens may see nothing of an emitter."""
    return points[:, points[0] < 0.1 * FAR_OUTSIDE]


def counts(case: MapCase, points: torch.Tensor) -> np.ndarray:
    """Number of lens points `[2, N]` in each of the case's cells, and outside.

    A line that hardly meets the lens circle has ends slightly outside; these count as inside.
    """
    flat = case.flat(points)
    radius = flat.norm(dim=0) / case.widest()
    return case.cells().count(torch.where((radius > 1.0) & (radius < 1.001), (1.0 - 1e-9) / radius, 1.0) * flat)


def probabilities(case: MapCase, emitters: EnvironmentEmitters | None = None) -> np.ndarray:
    flat, area = case.cells().nodes(40)
    points, stretch = case.on_lens(flat)
    return ((case.pdf(points, emitters).numpy() * stretch).reshape(area.shape) * area).sum(2)


@pytest.mark.slow
@BY_NAME
def test_draws_follow_the_density(case):
    observed = counts(case, case.draw(DRAWS, seed=1))
    assert histogram_check(observed, probabilities(case)) > SIGNIFICANCE


@pytest.mark.slow
@BY_NAME
def test_the_density_integrates_to_one(case):
    lost = 1.0 - drawn(case.draw(DRAWS, seed=6)).shape[1] / DRAWS
    bound = 2e-3 + 4.0 * np.sqrt(lost * (1.0 - lost) / DRAWS)
    assert probabilities(case).sum() + lost == pytest.approx(1.0, abs=bound)


@pytest.mark.parametrize("case", [*CASES, SUN], ids=lambda case: case.name)
def test_draws_have_a_density(case):
    """All that the lens sees of them: what is drawn and has none would be counted for nothing."""
    points = case.draw(20_000, seed=6)
    seen = points.norm(dim=0) <= case.lens
    assert seen.double().mean() > 0.1 and (case.pdf(points)[seen] > 0.0).all()


@BY_NAME
def test_draws_see_the_emitter(case):
    """Every direction lies less than a texel, across and down, from the middle of one of the emitter's texels."""
    column, row = case.places(case.directions(drawn(case.draw(2_000, seed=3)))[0])
    across = np.stack([(column - 0.5 - texel[1] + case.height) % (2 * case.height) - case.height for texel in case.texels])
    down = np.stack([row - 0.5 - texel[0] for texel in case.texels])
    assert (np.maximum(np.abs(across), np.abs(down)).min(0) < 1.001).all()


@pytest.mark.parametrize("case", [case for case in CUT if not case.is_wide()], ids=lambda case: case.name)
def test_few_draws_miss_the_lens(case):
    """But for the thousandth by which it is taken to be wider. Where the circle of the map is drawn from whole, more do."""
    assert (case.draw(20_000, seed=7).norm(dim=0) > case.lens).double().mean() < 0.02


@cache
def texel_light(case: MapCase) -> np.ndarray:
    """Light of the emitter's texels, with an empty row above the map and one below it, `[H + 2, 2 H]`."""
    texels = np.zeros((case.height + 2, 2 * case.height))
    rows, columns = np.array([texel[:2] for texel in case.texels]).T
    texels[rows + 1, columns] = (
        case.environment().radiance[rows, columns] @ LUMINANCE * np.sin(np.pi * (rows + 0.5) / case.height)
    )
    return texels


def map_light(case: MapCase, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Light of the emitter at columns and rows `[..]` of the map: its texels', interpolated."""
    texels = texel_light(case)
    left, top = np.floor(x - 0.5).astype(int), np.floor(y + 0.5).astype(int)
    across, down = x - 0.5 - left, y + 0.5 - top
    light = 0.0
    for column, beside in ((left, 1.0 - across), (left + 1, across)):
        for row, above in ((top, 1.0 - down), (top + 1, down)):
            light = light + beside * above * texels[row, column % (2 * case.height)]
    return light


@cache
def drawn_from(case: MapCase) -> tuple[bool, float, np.ndarray, np.ndarray]:
    """Whether the case is wide, how wide, world axes of what is drawn from, and x_F."""
    axes, focus = case.camera().axes.double().numpy(), case.focus().double().numpy()[:, 0]
    return case.is_wide(), case.widest(), case.frame() if case.is_wide() else axes, focus


def seen_by_the_lens(case: MapCase, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Whether places `[..]` of the map are where draws may lie: seen from the lens, or in a circle about that."""
    theta, phi = np.pi / case.height * y, np.pi / case.height * x - np.pi - np.radians(case.rotation)
    towards = np.stack(np.broadcast_arrays(np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)))
    wide, widest, frame, focus = drawn_from(case)
    right, up, ahead = np.tensordot(frame.T, towards, 1)
    if not wide:
        right, up = focus[0] * ahead - right * focus[2], focus[1] * ahead - up * focus[2]
    return (ahead > 0.0) & (np.hypot(right, up) <= widest * ahead)


@pytest.mark.slow
@BY_NAME
def test_the_density_is_that_of_plain_sums(case):
    """Rows in proportion to their flux, among the rows that the lens sees; on each row, the part that the lens sees."""
    points = drawn(case.draw(40, seed=8))
    directions, solid_angle = case.directions(points)
    column, row = case.places(directions)
    x = (np.arange(1 << 16) + 0.5) / (1 << 16) * 2 * case.height
    coarse = x[::64]
    lit = sorted(texel[0] for texel in case.texels)
    low, high = max(lit[0] - 0.5, 0.0), min(lit[-1] + 1.5, case.height)
    row_range = low + (np.arange(1000) + 0.5) / 1000 * (high - low)
    between = map_light(case, coarse[:, None], row_range[None, ::10]).any(1) | case.is_wide()
    rows = np.array(
        [map_light(case, coarse, at).mean() * (seen_by_the_lens(case, coarse, at) & between).any() for at in row_range]
    )
    rows = rows.mean() * (high - low)
    whole = np.array([map_light(case, x, at).mean() for at in row])
    shown = np.array([(map_light(case, x, at) * seen_by_the_lens(case, x, at)).mean() for at in row])
    clear = shown > 100 * 2.0**-16 * whole.max() / case.height  # of a short row_interval the sum has few terms
    density = whole / rows * map_light(case, column, row) / (shown * 2 * case.height)
    expected = density * solid_angle * (case.height / np.pi) ** 2 / np.sin(np.pi / case.height * row)
    assert clear.mean() > 0.8
    np.testing.assert_allclose(case.pdf(points).numpy()[clear], expected[clear], rtol=0.03)


@pytest.mark.parametrize("case", WHOLE, ids=lambda case: case.name)
def test_of_whole_emitters_nothing_is_cut_off(case):
    """Those that are known to be within the lens are drawn, and have densities, as if that had to be found out."""
    points, whole = case.draw(1000, seed=2), case.draw(1000, seed=2, whole=True)
    torch.testing.assert_close(whole, points)
    torch.testing.assert_close(case.seen(1000, whole=True).pdf(points), case.seen(1000).pdf(points), rtol=1e-5, atol=0.0)


EVENNESS = [("square", 0.01), ("one texel", 0.01), ("uneven corner", 0.01), ("across the edge", 0.01), ("near the top", 0.2)]


@pytest.mark.parametrize("name, spread", EVENNESS)
def test_the_density_is_as_the_map_shines(name, spread):
    """All draws of a whole emitter have the same contribution: the flux of the emitter's texels through the lens plane.

    The exception is near the top, where the texels of a row differ in width.
    """
    case = named(name)
    points = case.draw(20_000, seed=4)
    directions, solid_angle = case.directions(points)
    light = luminance(EnvironmentMap(case.environment()).radiance(torch.from_numpy(directions).float())).double().numpy()
    brought = light * solid_angle / case.pdf(points).numpy()
    assert brought.std() < spread * brought.mean()
    rows, columns = np.array([texel[:2] for texel in case.texels]).T
    texels = case.environment().radiance[rows, columns] @ LUMINANCE * np.sin(np.pi * (rows + 0.5) / case.height)
    assert brought.mean() == pytest.approx(texels.sum() * (np.pi / case.height) ** 2, rel=0.02)


def test_densities_at_the_bottom_of_the_map_mirror_those_at_its_top():
    top = named("top row")
    texels = tuple((top.height - 1 - row, column, bright) for row, column, bright in top.texels)
    (x, y, z), (across, up) = top.aside, top.off
    bottom = replace(top, texels=texels, aside=(x, -y, z), off=(across, -up))
    points = top.draw(2000, seed=6)
    torch.testing.assert_close(bottom.pdf(points * torch.tensor([[1.0], [-1.0]])), top.pdf(points), rtol=1e-3, atol=0.0)


def test_nothing_is_seen_outside_an_emitter_or_of_one_behind():
    case = named("uneven corner")
    cells, angle = case.cells(), torch.linspace(0.0, 6.0, 1000, dtype=torch.float64)
    ring = 1.2 * cells.edges[-1] * torch.stack((angle.cos(), angle.sin())) + torch.tensor(cells.centre)[:, None]
    assert not case.pdf(case.on_lens(ring)[0]).any() and not case.pdf(torch.full((2, 4), FAR_OUTSIDE)).any()
    behind = case.emitters(way=-1.0)
    assert not case.pdf(case.draw(1000, seed=5), behind).any()
    assert (case.draw(1000, seed=5, emitters=behind) == FAR_OUTSIDE).all()


def test_what_the_lens_does_not_see_is_not_drawn():
    case = replace(named("hardly seen"), off=(6.0, 0.0))
    assert (case.draw(1000, seed=5) == FAR_OUTSIDE).all()
    assert not case.pdf(torch.rand(2, 1000) * 0.2 - 0.1).any()


def test_each_emitter_has_a_density_of_its_own():
    """What is drawn of the other emitter is seen as the other's, and as nothing of this one."""
    case = replace(named("square"), off=(2.0, 0.0), lens=2.0)
    points = case.draw(1000, seed=6, number=OTHER)
    assert (case.seen(1000, number=OTHER).pdf(points) > 0.0).all() and not case.pdf(points).any()


@pytest.mark.parametrize("defect", ["scale", "texels"])
def test_a_wrong_density_fails(defect):
    case = named("uneven corner")
    emitters = case.emitters()
    if defect == "scale":
        emitters._flux = 1.02 * emitters._flux
    else:
        emitters._flux = torch.where(emitters._emitter == EMITTER, 1.0 / len(case.texels), emitters._flux)
    probability = probabilities(case, emitters)
    observed = counts(case, case.draw(DRAWS, seed=2))
    assert abs(probability.sum() - 1.0) > 2e-3 or histogram_check(observed, probability) < SIGNIFICANCE
