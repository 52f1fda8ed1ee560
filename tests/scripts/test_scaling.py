"""The script that measures how costs grow, at tiny sizes."""

import numpy as np
import pytest
from experiments import scaling
from PIL import Image

from bokehguide.scene.emitters import find_emitters

SMALL = {"pixels": 2000, "triangles": 200, "emitters": 5, "spp": 2}


def test_the_scene_has_what_is_asked_for():
    scene = scaling.hills(100_000, 5_000, 300)
    assert abs(scene.film.width * scene.film.height - 100_000) < 1000
    ground, emitters = scene.meshes
    assert abs(len(ground.triangles) - 5_000) < 150 and len(emitters.triangles) == 8 * 300
    normals = np.cross(*(ground.vertices[ground.triangles[:, i]] - ground.vertices[ground.triangles[:, 0]] for i in (1, 2)))
    assert (normals[:, 1] > 0.0).all(), "the hills face up"
    assert len(find_emitters(scene).centres) == 300


@pytest.mark.parametrize("mode", ["uniform", "guided", "lis-o"])
def test_costs_are_those_of_the_render(mode):
    costs = scaling.costs(mode, SMALL, 1)
    assert costs["step"] > 0.0 and costs["first"] > 0.0 and costs["memory_mb"] > 50.0
    film = scaling.hills(2000, 200, 5).film
    border = 2 * -(-film.width // 10)
    cells, of_cell, most_beside = (
        (film.width + border) * (film.height + border),
        *{"uniform": (0, 0), "guided": (8, 12), "lis-o": (20, 0)}[mode],
    )
    assert cells * of_cell <= costs["record_mb"] * 2**20 <= cells * (of_cell + most_beside)
    assert (costs["guide_mb"] > costs["record_mb"]) == (mode != "uniform")


@pytest.mark.slow
def test_table_and_plot(tmp_path):
    times = {"pixels": {1000: 1.0, 4000: 4.0}, "emitters": {10: 1.0, 1000: 10.0}}
    base = {"first": 1.0, "memory_mb": 100.0, "guide_mb": 1.0, "record_mb": 0.5}
    rows = [
        {"mode": "guided", "growing": growing, **SMALL, growing: value, "step": step, **base}
        for growing, line in times.items()
        for value, step in line.items()
    ]
    exponents = [line.split("|")[-2].strip() for line in scaling.table(rows).splitlines()[2:]]
    assert exponents == ["", "1.00", "", "0.50"]
    scaling.draw(rows, tmp_path / "scaling.png")
    with Image.open(tmp_path / "scaling.png") as picture:
        assert min(picture.size) > 500
