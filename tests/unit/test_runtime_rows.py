"""Graphs row by row against the functions they are made of."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from bokehguide.render.vector import cross, dot, luminance, normalize, tangent_frame, to_local
from bokehguide.runtime.compile.compiling import _exported, core_graph
from bokehguide.runtime.compile.rows import MOST_ROWS, ByRows, aten

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning:torch", "ignore::FutureWarning:copyreg")


def frames(one: Tensor, other: Tensor, number: Tensor) -> list[Tensor]:
    normal = normalize(cross(one, other))
    return [to_local(one, *tangent_frame(normal), normal), luminance(other), normal.amax(0)]


def parts(one: Tensor, other: Tensor, number: Tensor) -> list[Tensor]:
    both = torch.cat((one, other[1:], number[None]))
    return [both, both[1:5:2].sum(0), both[-1], torch.stack((number, one[0])), one.clone(), both.unbind(0)[2]]


def mixed(one: Tensor, other: Tensor, number: Tensor) -> list[Tensor]:
    """Of rows, of one row, of scalars; and what is not known row by row."""
    scaled = torch.where(one > number, one * number + 2.0, other.square()) - number[None]
    column = torch.tensor([[1.0], [2.0], [3.0]])
    return [
        scaled * column,
        column.T @ scaled,
        scaled.sort(0).values,
        (one * other).sum(0, keepdim=True),
        scaled.int() & 3,
        dot(one, other),
    ]


def gathered(one: Tensor, other: Tensor, number: Tensor) -> list[Tensor]:
    index = (number * (number.shape[0] - 1)).long()
    return [one.index_select(1, index) + other, other[:, index], number.index_select(0, index)]


def bound(one: Tensor, other: Tensor, number: Tensor) -> list[Tensor]:
    """What would be another thing row by row: three dimensions, whole numbers, other types, what is left out."""
    large = one > number
    both, sheet = torch.stack((one, other)), torch.stack((large[0], large[1]))
    whole = torch.stack((large[0].int(), number))
    joined = torch.cat((large.int(), other))
    return [
        both[1].sum(0),
        both,
        large.sum(0),
        large.int().sum(0),
        sheet.any(0),
        whole[0] * 3,
        joined[0] * 3,
        aten.slice(one, 0, 1),
        one[-1],
    ]


def alone(one: Tensor, other: Tensor, number: Tensor) -> list[Tensor]:
    return [number[None].sum(0), number[None].amax(0), one[0:1].sum(0)]


def tall(one: Tensor, other: Tensor, number: Tensor) -> list[Tensor]:
    whole = torch.cat((one,) * MOST_ROWS)
    return [whole * number, whole.amax(0)]


class Function(torch.nn.Module):
    def __init__(self, function):
        super().__init__()
        self._function = function

    def forward(self, *tensors: Tensor) -> list[Tensor]:
        return self._function(*tensors)


def given(count: int) -> tuple[Tensor, ...]:
    draw = torch.Generator().manual_seed(count)
    return tuple(torch.rand(*shape, count, generator=draw) for shape in ((3,), (3,), ()))


def by_rows(function) -> torch.export.ExportedProgram:
    graph = core_graph(_exported(Function(function), given(50)))
    return _exported(Function(ByRows(graph).run), given(50))


@pytest.mark.slow
@pytest.mark.parametrize("function", [frames, parts, mixed, gathered, bound, alone, tall])
def test_results_are_those_of_the_function(function):
    program = by_rows(function).module()
    for count in (2, 50, 77):
        tensors = given(count)
        found, wanted = program(*tensors), function(*tensors)
        assert len(found) == len(wanted)
        for one, other in zip(found, wanted):
            assert one.dtype == other.dtype
            torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)


def test_results_are_no_views_of_arguments():
    program, tensors = by_rows(alone).module(), given(7)
    for result in program(*tensors):
        result.zero_()
    assert all(torch.equal(one, other) for one, other in zip(tensors, given(7)))


def test_places_that_depend_on_sizes_are_not_fixed():
    def function(one: Tensor, other: Tensor, number: Tensor) -> list[Tensor]:
        return [one.select(0, number.shape[0] % 3) * 2.0]

    program = by_rows(function).module()
    for count in (49, 50, 51):
        torch.testing.assert_close(program(*given(count)), function(*given(count)))


@pytest.mark.slow
@pytest.mark.parametrize("function", [frames, parts])
def test_nothing_but_results_is_made_of_several_rows(function):
    """Or their loops would not be one."""
    made = {
        node.target
        for node in by_rows(function).graph.nodes
        if getattr(node.meta.get("val"), "ndim", 0) == 2 and node.op != "placeholder"
    }
    assert made == {aten.stack.default}
