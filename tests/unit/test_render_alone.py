"""The path tracer alone: no other part of the package is needed to render a picture."""

import ast
import subprocess
import sys
from itertools import chain, pairwise
from pathlib import Path

import numpy as np
import torch

import bokehguide.render
from bokehguide.render import Film, FilmSamples, PathTracer, PixelRandom, ThinLensCamera, dimensions
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene.types import Scene
from tests.support import scenes

FOLDER = Path(bokehguide.render.__file__).parent
ABOVE = ("guiding", "models", "train", "baselines", "cli", "evaluation")


def imported(path: Path) -> set[str]:
    """Names of the modules that a file imports, at its top or within functions."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    plain = (alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names)
    named = (f"{node.module}.{alias.name}" for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names)
    return {*plain, *named}


def test_it_imports_nothing_that_is_built_on_it():
    found = {path.name: imported(path) for path in FOLDER.rglob("*.py")}
    assert len(found) > 20
    for name, modules in found.items():
        assert not any(module.startswith(f"bokehguide.{room}") for module in modules for room in ABOVE), name


def test_importing_it_loads_nothing_that_is_built_on_it():
    program = "import sys, bokehguide.render; print(*sys.modules)"
    modules = subprocess.run((sys.executable, "-c", program), capture_output=True, text=True, check=True).stdout.split()
    assert "bokehguide.render.path_tracer" in modules
    assert not any(module.startswith(f"bokehguide.{room}") for module in modules for room in ABOVE)


def rendered(scene: Scene, spp: int) -> np.ndarray:
    """Radiance `[H, W, 3]` of a scene, with uniform lens points."""
    width, height, timer = scene.film.width, scene.film.height, PhaseTimer()
    camera, tracer, film = ThinLensCamera(scene.camera, width, height), PathTracer(scene), Film(width, height)
    pixels = torch.arange(width * height)
    corner = torch.stack((pixels % width, pixels // width))
    for step in range(1, spp + 1):
        random = PixelRandom(0, step, pixels)
        focus = camera.focus_points(corner + random.stratified(dimensions.FILM, 2))
        points = camera.lens.sample(random.uniform(dimensions.LENS, 2))
        weight = camera.lens.unblocked(points, focus)
        origins, directions = camera.rays(focus, points)
        found = tracer.trace(origins, directions, random, timer, alive=weight)
        depth = camera.depth(found.distance, directions)
        aovs = (found.alpha, depth, found.normal, found.albedo, found.emission)
        film.add(slice(None), FilmSamples(weight, found.radiance, *aovs), step)
    return film.radiance().numpy()


def test_it_renders_a_picture():
    """Out-of-focus emitters before a sky of radiance 0.1."""
    picture = rendered(scenes.emitters(32, 18), 16)
    assert picture.shape == (18, 32, 3) and np.isfinite(picture).all()
    assert (picture >= 0.099).mean() > 0.9 and picture.max() > 1.0


def ranges(depth: int) -> list[range]:
    """Random dimensions of a path of some depth, with five candidates and 64 neighbours."""
    single = {dimensions.FILM: 2, dimensions.LENS: dimensions.LENS_COUNT, dimensions.INITIAL_LENS: 2, dimensions.NEIGHBOURS: 1}
    single[dimensions.NEIGHBOUR_CHOICE] = 65
    offsets = {dimensions.PART: 1, dimensions.SCATTER: dimensions.SCATTER_COUNT, dimensions.LIGHT: dimensions.LIGHT_COUNT}
    vertices = ((dimensions.vertex(d) + first, count) for d in range(1, depth + 1) for first, count in offsets.items())
    candidates = ((dimensions.choice(number), 1) for number in range(1, 5))
    crossings = ((dimensions.crossing(d), dimensions.MAX_CROSSINGS) for d in range(1, depth + 1))
    return [range(first, first + count) for first, count in chain(single.items(), vertices, candidates, crossings)]


def test_all_random_dimensions_are_distinct():
    """Up to the largest depth."""
    found = sorted(ranges(4000), key=lambda each: each.start)
    assert all(one.stop <= other.start for one, other in pairwise(found))
    assert found[0].start == 0 and found[-1].stop < 2**31
