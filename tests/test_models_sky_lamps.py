"""Lamps of an environment map: draws against the density, the density against 1 and against the map itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from lens_cases import LENS, PolarGrid, histogram_check
from statistical import SIGNIFICANCE

from bokehguide.models.sky_lamps import FAR_OUTSIDE, SkyLamps
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.environment import EnvironmentMap
from bokehguide.render.vector import luminance
from bokehguide.scene.lamps import LUMINANCE
from bokehguide.scene.types import Camera, Environment

DRAWS = 100_000
LAMP, OTHER = 1, 0
"""Numbers of the lamp that is looked at and of another one of the same map."""


@dataclass(frozen=True)
class SkyCase:
    """A lamp of texels (row, column, brightness) on a black map `[height, 2 height]`, seen through a focus point aslant.

    aside: by how much the camera looks beside the lamp. lost: share of the lamp's draws that lie beyond the map's top.
    """

    name: str
    texels: tuple[tuple[int, int, float], ...]
    height: int = 64
    rotation: float = 0.0
    aside: tuple[float, float, float] = (0.2, -0.1, 0.15)
    lost: float = 0.0

    def environment(self) -> Environment:
        radiance = np.zeros((self.height, 2 * self.height, 3), np.float32)
        for row, column, bright in self.texels:
            radiance[row, column] = bright * np.array((1.0, 0.4 * column % 1.0, 2.0))
        radiance[self.height // 2, (self.texels[0][1] + 20) % (2 * self.height)] = 5.0
        return Environment(radiance, self.rotation)

    def middle(self) -> np.ndarray:
        """Unit world direction `[3]` of the lamp, about."""
        rows, columns = np.array([texel[:2] for texel in self.texels]).T
        theta = np.pi * (rows + 0.5) / self.height
        phi = np.pi * (columns + 0.5) / self.height - np.pi - np.radians(self.rotation)
        towards = np.stack((np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi))).sum(1)
        return towards / np.linalg.norm(towards)

    def camera(self, way: float = 1.0) -> ThinLensCamera:
        target = tuple(way * self.middle() + self.aside)
        return ThinLensCamera(Camera((0.0, 0.0, 0.0), target, aperture_radius=0.1, focus_distance=2.0), 64, 36)

    def lamps(self, way: float = 1.0) -> SkyLamps:
        bright = self.environment().radiance[:, :, 0] > 0.0
        number = np.where(bright, OTHER, -1)
        for row, column, _ in self.texels:
            number[row, column] = LAMP
        return SkyLamps(self.environment(), number, self.camera(way))

    def focus(self) -> torch.Tensor:
        """x_F `[3, 1]` through which the lamp is seen from about the middle of the lens."""
        local = self.camera().axes.double().numpy().T @ self.middle()
        return torch.tensor(local / local[2] * LENS.focus_distance + (0.02, -0.03, 0.0)).float()[:, None]

    def cells(self) -> PolarGrid:
        """A grid that holds all that is drawn of the lamp; about the map's top where the density has its pole there."""
        draws = self.draw(10_000, seed=9).double().numpy()
        draws = draws[:, draws[0] < 0.1 * FAR_OUTSIDE]
        centre = 0.5 * (draws.min(1) + draws.max(1))
        if self.lost > 0.0:
            top, focus = self.camera().axes.double().numpy()[1], self.focus().double().numpy()[:, 0]
            centre = focus[:2] - top[:2] * focus[2] / top[2]
        reach = 1.1 * np.hypot(*(draws - centre[:, None])).max()
        return PolarGrid(reach * np.sqrt(np.linspace(0.0, 1.0, 13)), 16, tuple(centre))

    def draw(self, count: int, seed: int) -> torch.Tensor:
        bits = torch.randint(0, 1 << 23, (2, count), generator=torch.Generator().manual_seed(seed))
        which = torch.full((count,), LAMP)
        return self.lamps().sample(which, (bits + 0.5) / 2.0**23, self.focus().expand(3, count))

    def pdf(self, points: torch.Tensor, lamps: SkyLamps | None = None) -> torch.Tensor:
        focus = self.focus().expand(3, points.shape[1])
        lamp, density = (lamps or self.lamps()).evaluate(points.float(), focus)
        return (density * (lamp == LAMP)).double()

    def directions(self, points: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
        """World directions `[3, N]` that lens points `[2, N]` see, and their solid angle per lens area `[N]`."""
        focus = self.focus().double().numpy()
        ray = np.concatenate((focus[:2] - points.double().numpy(), np.repeat(focus[2:], points.shape[1], 1)))
        distance = np.linalg.norm(ray, axis=0)
        return self.camera().axes.double().numpy() @ ray / distance, focus[2] / distance**3


SQUARE = tuple((row, column, 7.0) for row in (20, 21) for column in (40, 41))
CORNER = ((20, 90, 1.0), (21, 90, 20.0), (22, 90, 3.0), (22, 91, 9.0), (22, 92, 0.5))
TOP = tuple((row, column, 1.0 + column) for row in (1, 2) for column in range(30, 50))
POLE = tuple((0, column, 4.0) for column in range(10, 20))
CASES = [
    SkyCase("square", SQUARE),
    SkyCase("one texel", ((33, 60, 2.0),), rotation=75.0),
    SkyCase("uneven corner", CORNER, rotation=-130.0),
    SkyCase("across the edge", ((35, 127, 5.0), (35, 0, 1.0), (36, 0, 2.0)), rotation=33.0),
    SkyCase("near the top", TOP, rotation=33.0),
    SkyCase("top row", POLE, aside=(0.2, -0.1, -0.3), lost=0.125),
    SkyCase("coarse map", ((3, 7, 1.0), (3, 8, 2.0)), height=8),
]
BY_NAME = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)


def named(name: str) -> SkyCase:
    return next(case for case in CASES if case.name == name)


def probabilities(case: SkyCase, lamps: SkyLamps | None = None) -> np.ndarray:
    points, area = case.cells().nodes(40)
    return (case.pdf(points, lamps).numpy().reshape(area.shape) * area).sum(2)


@BY_NAME
def test_draws_follow_the_density(case):
    """Over the lens plane; what would lie beyond the map's top sees nothing."""
    observed = case.cells().count(case.draw(DRAWS, seed=1))
    assert observed[-1] / DRAWS == pytest.approx(case.lost, abs=5e-3)
    assert histogram_check(observed, probabilities(case)) > SIGNIFICANCE


@BY_NAME
def test_the_density_integrates_to_one(case):
    assert probabilities(case).sum() + case.lost == pytest.approx(1.0, abs=2e-3)


@BY_NAME
def test_draws_see_the_lamp(case):
    """Every direction lies less than a texel, across and down, from the middle of one of the lamp's texels."""
    points = case.draw(2_000, seed=3)
    (x, y, z), _ = case.directions(points[:, points[0] < 0.1 * FAR_OUTSIDE])
    column = (0.5 + np.arctan2(x, -z) / (2.0 * np.pi) + case.rotation / 360.0) * 2 * case.height - 0.5
    row = np.arctan2(np.hypot(x, z), y) / np.pi * case.height - 0.5
    across = np.stack([(column - texel[1] + case.height) % (2 * case.height) - case.height for texel in case.texels])
    down = np.stack([row - texel[0] for texel in case.texels])
    assert (np.maximum(np.abs(across), np.abs(down)).min(0) < 1.001).all()


EVENNESS = [("square", 0.01), ("one texel", 0.01), ("uneven corner", 0.01), ("across the edge", 0.01), ("near the top", 0.2)]


@pytest.mark.parametrize("name, spread", EVENNESS)
def test_the_density_is_as_the_map_shines(name, spread):
    """What a draw brings is the same for all draws, and all that the lamp's texels send through the lens plane.

    But near the top, where the texels of a row are not of one width.
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


def test_nothing_is_seen_outside_a_lamp_or_of_one_behind():
    case = named("uneven corner")
    cells, angle = case.cells(), torch.linspace(0.0, 6.0, 1000)
    ring = 1.2 * cells.edges[-1] * torch.stack((angle.cos(), angle.sin())) + torch.tensor(cells.centre).float()[:, None]
    assert not case.pdf(ring).any() and not case.pdf(torch.full((2, 4), FAR_OUTSIDE)).any()
    behind = case.lamps(way=-1.0)
    assert not case.pdf(case.draw(1000, seed=5), behind).any()
    drawn = behind.sample(torch.full((1000,), LAMP), torch.rand(2, 1000), case.focus().expand(3, 1000))
    assert (drawn == FAR_OUTSIDE).all()


def test_each_lamp_has_a_density_of_its_own():
    """What is drawn of the other lamp is seen as the other's, and as nothing of this one."""
    case = named("square")
    lamps, focus = case.lamps(), case.focus().expand(3, 1000)
    points = lamps.sample(torch.full((1000,), OTHER), torch.rand(2, 1000, generator=torch.Generator().manual_seed(6)), focus)
    lamp, density = lamps.evaluate(points, focus)
    assert (lamp == OTHER).all() and (density > 0.0).all() and not case.pdf(points).any()


@pytest.mark.parametrize("defect", ["scale", "texels"])
def test_a_wrong_density_fails(defect):
    case = named("uneven corner")
    lamps = case.lamps()
    if defect == "scale":
        lamps._light = 1.02 * lamps._light
    else:
        lamps._light = torch.where(lamps._lamp == LAMP, 1.0 / len(case.texels), lamps._light)
    probability = probabilities(case, lamps)
    observed = case.cells().count(case.draw(DRAWS, seed=2))
    assert abs(probability.sum() - 1.0) > 2e-3 or histogram_check(observed, probability) < SIGNIFICANCE
