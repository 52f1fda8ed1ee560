"""Embree behind its interface, against every ray meeting every triangle."""

import numpy as np
import pytest
import torch

from bokehguide.render import tracer as tracer_module
from bokehguide.render.tracer import MISS_DISTANCE, Tracer
from bokehguide.runtime import native
from tests.support.brute_force import every_hit


def nearest_hits(vertices, triangles, origins, directions):
    """Nearest hits in float64: triangle (-1 for a miss), distance, u, v, all `[N]`."""
    t, u, v = every_hit(vertices[triangles], origins, directions)
    nearest, rays = t.argmin(axis=1), np.arange(len(t))
    hit = np.isfinite(t[rays, nearest])
    return np.where(hit, nearest, -1), t[rays, nearest], u[rays, nearest], v[rays, nearest]


@pytest.fixture(scope="module")
def soup():
    """100 random triangles in a cube, and 5,000 rays from around it: vertices, triangles, origins, directions."""
    generator = np.random.default_rng(7)
    centres = generator.uniform(-1, 1, (100, 1, 3))
    vertices = (centres + generator.normal(0, 0.3, (100, 3, 3))).reshape(-1, 3).astype(np.float32)
    triangles = generator.permutation(300).reshape(100, 3).astype(np.int32)
    origins = generator.uniform(-2, 2, (3, 5000)).astype(np.float32)
    directions = generator.normal(size=(3, 5000))
    directions = (directions / np.linalg.norm(directions, axis=0)).astype(np.float32)
    return vertices, triangles, origins, directions


def test_nearest_hits_are_those_of_brute_force(soup):
    vertices, triangles, origins, directions = soup
    triangle, distance, u, v = nearest_hits(vertices, triangles, origins, directions)
    found = Tracer(vertices, triangles).intersect(torch.from_numpy(origins), torch.from_numpy(directions))
    same = found.triangle.numpy() == triangle
    assert (triangle >= 0).sum() > 1000
    assert same.mean() > 0.999  # an edge may fall to either side
    hit = same & (triangle >= 0)
    np.testing.assert_allclose(found.distance.numpy()[hit], distance[hit], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found.u.numpy()[hit], u[hit], atol=2e-3)
    np.testing.assert_allclose(found.v.numpy()[hit], v[hit], atol=2e-3)


def test_u_and_v_weigh_the_second_and_third_vertex(soup):
    vertices, triangles, origins, directions = soup
    found = Tracer(vertices, triangles).intersect(torch.from_numpy(origins), torch.from_numpy(directions))
    hit = found.triangle.numpy() >= 0
    a, b, c = (vertices[triangles[found.triangle.numpy()[hit], i]].T for i in range(3))
    u, v = found.u.numpy()[hit], found.v.numpy()[hit]
    reached = origins[:, hit] + found.distance.numpy()[hit] * directions[:, hit]
    np.testing.assert_allclose((1 - u - v) * a + u * b + v * c, reached, atol=1e-4)


def test_a_miss_is_triangle_minus_one_at_the_miss_distance():
    tracer = Tracer(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))
    found = tracer.intersect(torch.full((3, 1), 2.0), torch.tensor([[0.0], [0.0], [1.0]]))
    assert found.triangle.item() == -1
    assert found.distance.item() == np.float32(MISS_DISTANCE)


def test_nothing_is_hit_beyond_a_limit(soup):
    vertices, triangles, origins, directions = soup
    tracer = Tracer(vertices, triangles)
    rays = torch.from_numpy(origins), torch.from_numpy(directions)
    free = tracer.intersect(*rays)
    limits = torch.full((origins.shape[1],), 1.5)
    found = tracer.intersect(*rays, limits)
    near = free.distance < 1.5
    assert near.any() and (free.distance[~near] < MISS_DISTANCE).any()
    assert torch.equal(found.triangle, torch.where(near, free.triangle, -1))
    assert torch.equal(found.distance[near], free.distance[near])
    assert (limits == 1.5).all()


def test_visible_until_the_nearest_hit_and_not_beyond(soup):
    vertices, triangles, origins, directions = soup
    tracer = Tracer(vertices, triangles)
    rays = torch.from_numpy(origins), torch.from_numpy(directions)
    found = tracer.intersect(*rays)
    hit = found.triangle >= 0
    before = tracer.visible(*rays, found.distance * 0.999)
    beyond = tracer.visible(*rays, found.distance * 1.001)
    assert before.dtype == torch.float32
    assert (before == 1.0).all()
    assert torch.equal(beyond, 1.0 - hit.float())


def test_visible_leaves_the_distances_as_they_were(soup):
    vertices, triangles, origins, directions = soup
    distances = torch.full((origins.shape[1],), 3.0)
    Tracer(vertices, triangles).visible(torch.from_numpy(origins), torch.from_numpy(directions), distances)
    assert (distances == 3.0).all()


def test_any_memory_layout_gives_the_same_hits(soup):
    vertices, triangles, origins, directions = soup
    tracer = Tracer(vertices, triangles)
    straight = tracer.intersect(torch.from_numpy(origins), torch.from_numpy(directions))
    rows = [torch.from_numpy(np.ascontiguousarray(array.T)).T for array in (origins, directions)]
    assert torch.equal(tracer.intersect(*rows).triangle, straight.triangle)
    every_other = tracer.intersect(torch.from_numpy(origins)[:, ::2], torch.from_numpy(directions)[:, ::2])
    assert torch.equal(every_other.triangle, straight.triangle[::2])


@pytest.mark.parametrize("core", ["0", "1"])
@pytest.mark.parametrize("threads", [2, 3, 16])
def test_threads_give_the_bits_of_one_thread(soup, threads, core, monkeypatch):
    monkeypatch.setenv(native.SWITCH, core)
    monkeypatch.setattr(tracer_module, "PART", 700)
    vertices, triangles, *rays = soup
    rays = [torch.from_numpy(rows) for rows in rays]
    one, several = Tracer(vertices, triangles), Tracer(vertices, triangles, threads)
    limits = torch.linspace(0.1, 3.0, rays[0].shape[1])
    for given in (rays, [*rays, limits], [rows[:, ::2] for rows in rays], [rows[:, :699] for rows in rays]):
        assert all(torch.equal(*fields) for fields in zip(one.intersect(*given), several.intersect(*given)))
    assert torch.equal(one.visible(*rays, limits), several.visible(*rays, limits))


def test_no_rays_at_all(soup):
    tracer = Tracer(*soup[:2])
    nothing = torch.zeros(3, 0)
    assert tracer.intersect(nothing, nothing).triangle.shape == (0,)
    assert tracer.visible(nothing, nothing, torch.zeros(0)).shape == (0,)


@pytest.mark.parametrize("triangles", [[[0, 1, 3]], [[-1, 1, 2]], np.zeros((0, 3))])
def test_indices_that_embree_would_read_past_the_vertices_are_refused(triangles):
    with pytest.raises(ValueError, match=r"\[0, 3\)"):
        Tracer(np.eye(3, dtype=np.float32), np.array(triangles, np.int32))


@pytest.mark.parametrize(
    ("vertices", "triangles", "named"),
    [
        (np.full((3, 3), np.nan, np.float32), [[0, 1, 2]], "finite"),
        (np.full((3, 3), np.inf, np.float32), [[0, 1, 2]], "finite"),
        (np.ones((3, 2), np.float32), [[0, 1, 2]], r"vertices must be float32 \[N, 3\], not float32 \[3, 2\]"),
        (np.ones(9, np.float32), [[0, 1, 2]], r"vertices .* not float32 \[9\]"),
        (np.ones((3, 3)), [[0, 1, 2]], "vertices .* not float64"),
        (np.ones((3, 3), np.float32), [[0, 1]], r"triangles must be int32 \[N, 3\], not int32 \[1, 2\]"),
        (np.ones((3, 3), np.float32), [0, 1, 2], r"triangles .* not int32 \[3\]"),
    ],
)
def test_geometry_that_embree_would_misread_is_refused(vertices, triangles, named):
    with pytest.raises(ValueError, match=named):
        Tracer(vertices, np.array(triangles, np.int32))


def test_triangles_of_another_type_are_refused():
    with pytest.raises(ValueError, match=r"triangles .* not int64"):
        Tracer(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]))


@pytest.mark.parametrize(
    ("origins", "directions", "limits", "named"),
    [
        ((3, 5), (3, 4), (5,), "directions"),
        ((3, 5), (2, 5), (5,), "directions"),
        ((2, 5), (3, 5), (5,), "origins"),
        ((3,), (3,), (3,), "origins"),
        ((), (), (), "origins"),
        ((3, 5), (3, 5), (4,), "limits"),
        ((3, 5), (3, 5), (5, 1), "limits"),
        ((3, 5), (3, 5), (), "limits"),
    ],
)
def test_rays_that_embree_would_read_past_are_refused(soup, origins, directions, limits, named):
    tracer = Tracer(*soup[:2])
    rays = torch.ones(origins), torch.ones(directions), torch.ones(limits)
    for query in (tracer.intersect, tracer.visible):
        with pytest.raises(ValueError, match=f"{named} must be float32"):
            query(*rays)


@pytest.mark.parametrize("which", range(3))
def test_rays_of_another_type_are_refused(soup, which):
    tracer = Tracer(*soup[:2])
    rays = [torch.ones(3, 5), torch.ones(3, 5), torch.ones(5)]
    rays[which] = rays[which].double()
    for query in (tracer.intersect, tracer.visible):
        with pytest.raises(ValueError, match=r"torch.float64"):
            query(*rays)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("of", ["origins", "directions"])
def test_rays_that_are_not_finite_hit_nothing_and_do_no_harm(soup, of, bad):
    """Among sound ones, whose hits stay."""
    vertices, triangles, *rays = soup
    tracer = Tracer(vertices, triangles)
    straight = tracer.intersect(*map(torch.from_numpy, rays))
    bad_rays = [array.copy() for array in rays]
    bad_rays[0 if of == "origins" else 1][:, ::3] = bad
    found = tracer.intersect(*map(torch.from_numpy, bad_rays))
    expected = straight.triangle.clone()
    expected[::3] = -1
    assert torch.equal(found.triangle, expected)
    limits = torch.full((rays[0].shape[1],), 1e30)
    assert (tracer.visible(*map(torch.from_numpy, bad_rays), limits)[::3] == 1.0).all()


def test_limits_that_are_not_numbers_hide_nothing(soup):
    vertices, triangles, origins, directions = soup
    limits = torch.full((origins.shape[1],), torch.nan)
    rays = torch.from_numpy(origins), torch.from_numpy(directions)
    assert (Tracer(vertices, triangles).intersect(*rays, limits).triangle == -1).all()
    assert (Tracer(vertices, triangles).visible(*rays, limits) == 1.0).all()
