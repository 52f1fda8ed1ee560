"""Rewrites the graphs of kernels to operate on rows.

For an operation on a `[3, N]` tensor, Inductor generates a loop over 3 × N elements. This loop computes values that are common to
all rows, such as a length, once for each row. Inductor does not fuse this loop with loops over N. A graph of rows `[N]` becomes
one loop over N, which computes common values once.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

aten = torch.ops.aten

MOST_ROWS = 32
"""Tensors with more rows are not split."""
AS_POINTWISE = {aten.alias.default, aten.clone.default, aten._to_copy.default, aten.view.dtype}
"""Element-wise operations that PyTorch does not tag as pointwise."""


class _Rows(list):
    """The rows, `[N]`, of a tensor `[C, N]`."""


class ByRows(torch.fx.Interpreter):
    """Runs a graph of core ATen operations on the rows of tensors whose last dimension varies.

    Operations without a version for rows run on whole tensors.
    """

    def placeholder(self, target: Any, args: Any, kwargs: Any) -> Any:
        value = super().placeholder(target, args, kwargs)
        varies = isinstance(value, Tensor) and value.ndim == 2 and not isinstance(value.shape[1], int)
        return _Rows(value.unbind(0)) if varies and _few(value.shape[0]) else value

    def call_function(self, target: Any, args: Any, kwargs: Any) -> Any:
        values = pytree.tree_leaves((args, kwargs), is_leaf=_is_rows)
        if any(_is_rows(value) for value in values):
            found = _by_rows(target, args, kwargs)
            if found is not None:
                return found
        elif target is aten.unsqueeze.default and args[0].ndim == 1 and args[1] == 0:
            return _Rows([args[0]])
        elif target is aten.stack.default and len(args) == 1:  # concatenates along the first dimension
            found = _joined(args[0], 1)
            if found is not None:
                return found
        whole = pytree.tree_map(_whole, (args, kwargs), is_leaf=_is_rows)
        return super().call_function(target, *whole)

    def output(self, target: Any, args: Any, kwargs: Any) -> Any:
        return pytree.tree_map(_whole, args[0], is_leaf=_is_rows)


def _is_rows(value: object) -> bool:
    return isinstance(value, _Rows)


def _few(count: object) -> bool:
    return isinstance(count, int) and count <= MOST_ROWS


def _whole(value: Any) -> Any:
    return torch.stack(list(value)) if _is_rows(value) else value


def _by_rows(target, args: tuple, kwargs: dict) -> _Rows | Tensor | None:
    """The result of an operation on `_Rows`; None if there is no version for rows."""
    first, rest = args[0], args[1:]
    if torch.Tag.pointwise in getattr(target, "tags", ()) or target in AS_POINTWISE:
        return _each(target, args, kwargs)
    if target in (aten.cat.default, aten.stack.default) and rest in ((), (0,)):
        return _joined(first, 2 if target is aten.cat.default else 1)
    if not _is_rows(first) or kwargs:
        return None
    if target is aten.select.int and rest[0] == 0 and type(rest[1]) is int:
        return first[rest[1]]
    if target is aten.unbind.int and rest in ((), (0,)):
        return first
    if target is aten.slice.Tensor and rest[:1] == (0,) and all(end is None or type(end) is int for end in rest[1:]):
        start, end, step = (*rest[1:], *(None,) * (4 - len(rest)))
        return _Rows(first[start:end:step])
    if target is aten.index_select.default and rest[0] == 1:
        return _Rows(row.index_select(0, rest[1]) for row in first)
    if len(first) > 1 and rest == ([0],) and first[0].dtype.is_floating_point:
        if target is aten.sum.dim_IntList:
            return functools.reduce(torch.add, first)
        if target is aten.amax.default:
            return functools.reduce(torch.maximum, first)
    return None


def _joined(parts: list, ndim: int) -> _Rows | None:
    """The concatenated rows of tensors with `ndim` dimensions; None if the dimensions or types differ or there are many rows."""
    rows = _Rows()
    for part in parts:
        if (2 if _is_rows(part) else part.ndim) != ndim or not (ndim == 1 or _is_rows(part) or _few(part.shape[0])):
            return None
        rows.extend(part if _is_rows(part) else [part] if ndim == 1 else part.unbind(0))
    return rows if len(rows) <= MOST_ROWS and len({row.dtype for row in rows}) == 1 else None


def _each(target, args: tuple, kwargs: dict) -> _Rows | None:
    """An element-wise operation, row by row; None if a tensor cannot be split."""
    values, structure = pytree.tree_flatten((args, kwargs), is_leaf=_is_rows)
    if any(isinstance(value, Tensor) and (value.ndim > 2 or (value.ndim == 2 and not _few(value.shape[0]))) for value in values):
        return None
    values = [_Rows(value.unbind(0)) if isinstance(value, Tensor) and value.ndim == 2 else value for value in values]
    count = max(len(value) for value in values if _is_rows(value))
    rows = ([value[row % len(value)] if _is_rows(value) else value for value in values] for row in range(count))
    return _Rows(target(*given[0], **given[1]) for given in (pytree.tree_unflatten(row, structure) for row in rows))
