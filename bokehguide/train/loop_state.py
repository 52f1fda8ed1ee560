"""Checks of the state of a loop before anything is loaded, and the way back where a part does not fit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor

from bokehguide.errors import BokehguideError, printable
from bokehguide.limits import LARGEST, MAX_INT

REMEDY = "give the state_dict() of a loop with the same scene and settings"
UNFIT = (AttributeError, IndexError, KeyError, RecursionError, RuntimeError, TypeError, ValueError)
"""Exceptions of PyTorch and of the parts of a loop for a state that is not theirs."""


def require_parts(place: str, state: object, own: Mapping[str, Any], apart: str = "") -> None:
    """Raise BokehguideError unless `state` has the parts of `own`, the state of the loop that loads it, each of the same kind.

    place: the function and the part, for errors. apart: name of a part that the caller checks.
    """
    if not isinstance(state, Mapping):
        raise BokehguideError(f"{place}: {type(state).__name__} is no state; {REMEDY}")
    for name in (*own, *state):
        if name not in state or name not in own:
            problem = "is missing" if name in own else "is no part of this loop"
            raise BokehguideError(f"{place}: {printable(str(name))} {problem}; {REMEDY}")
        if name != apart:
            try:
                require_kind(state[name], own[name])
            except UNFIT as error:
                raise BokehguideError(f"{place}: {name}: {printable(str(error), 200)}; {REMEDY}") from error


def require_loop_state(place: str, state: Any, own: Mapping[str, Any], check_film: Callable[[Mapping], None]) -> None:
    """Raise BokehguideError unless `state` can be that of a `RenderLoop` with the state `own`.

    check_film: raises ValueError for a state of another film.
    """
    require_parts(place, state, own, apart="film")
    if state["size"] != own["size"]:
        sizes = ["x".join(map(str, each["size"])) for each in (state, own)]
        raise BokehguideError(f"{place}: the film has {printable(sizes[0])} pixels, not {sizes[1]}; {REMEDY}")
    require_parts(f"{place}: film", state["film"], own["film"] | {"bad_samples": []})
    try:
        check_film(state["film"])
        for seconds in state["phases"].values():
            require_kind(seconds, 0.0)
        for x, y, step, seed in state["film"]["bad_samples"]:
            require_kind([x, y, step], [0, 0, 0])
            if type(seed) is not int:  # a seed may be negative or large
                raise ValueError(f"{seed!r} is no seed")
    except UNFIT as error:
        raise BokehguideError(f"{place}: {printable(str(error), 200)}; {REMEDY}") from error


def require_one_moment(place: str, state: Mapping[str, Any], open_pixels: Tensor | None = None) -> None:
    """Raise BokehguideError unless the film of a state has the samples of the state's steps.

    open_pixels: pixels that have a sample of each step, bool `[pixels]`; None for all. A bad sample is not on the film.
    """
    film, step = state["film"], state["step"]
    counts = film["count"]
    every = counts if open_pixels is None else counts[open_pixels.to(counts.device)]
    absent = step * every.numel() - float(every.double().sum())
    if absent > film["bad_count"] or float(counts.max()) > step:
        raise BokehguideError(
            f"{place}: the state is of step {step}, and its film has the samples of {float(counts.max()):g} steps. "
            "A loop shares the tensors of its state; keep copy.deepcopy(loop.state_dict())"
        )


@contextmanager
def all_or_nothing(place: str, *loading: tuple[Callable[[Mapping[str, Any]], None], Mapping[str, Any]]) -> Iterator[None]:
    """A context that loads the former states again where a state does not fit, and then raises BokehguideError.

    loading: for each loop, the function that loads its learned state, and the present state.
    """
    kept = [(load, deepcopy({name: part for name, part in own.items() if name != "film"})) for load, own in loading]
    try:
        yield
    except UNFIT as error:
        for load, own in kept:
            load(own)
        problem = printable(str(error).strip().splitlines()[-1], 200)
        raise BokehguideError(f"{place}: the learned state does not fit ({problem}); {REMEDY}") from error


def require_kind(saved: object, own: Any, seen: set[tuple[int, int]] | None = None) -> None:
    """Raise ValueError unless `saved` can be a later state of `own`, the same part of a new loop's state.

    The check fails for numbers of another type, and for tensors of another type. It fails for tensors that are not finite or that
    exceed their storage, and for negative or very large whole numbers in tensors. The film and the strategies check the shapes of
    their states. seen: pairs of parts that the check has passed; a small file can refer to one part very often.
    """
    seen = set() if seen is None else seen
    if (id(saved), id(own)) in seen:
        return
    seen.add((id(saved), id(own)))
    if isinstance(saved, Tensor):
        _require_tensor(saved, own)
    elif isinstance(own, int | float) and not isinstance(own, bool):
        if type(saved) is not type(own) or not 0 <= saved <= LARGEST:
            raise ValueError(f"{saved!r} is no number of the type of {own!r}")
    elif own is not None and not isinstance(saved, dict if isinstance(own, dict) else type(own)):
        raise ValueError(f"{type(saved).__name__} in the place of {type(own).__name__}")
    elif isinstance(saved, dict):
        for name, part in saved.items():
            require_kind(part, own.get(name) if isinstance(own, dict) else None, seen)
    elif isinstance(saved, list | tuple):
        for number, part in enumerate(saved):
            require_kind(part, own[number] if isinstance(own, list | tuple) and number < len(own) else None, seen)


def _require_tensor(saved: Tensor, own: object) -> None:
    """The part of `require_kind` for a tensor."""
    stored = saved.numel() * saved.element_size() <= saved.untyped_storage().nbytes()
    finite = stored and (not saved.is_floating_point() or bool(saved.isfinite().all()))
    if finite and not saved.is_floating_point() and saved.dtype != torch.bool:  # indices and counts
        finite = saved.numel() == 0 or bool((saved >= 0).all() and (saved <= MAX_INT).all())
    matches = own is None or (isinstance(own, Tensor) and (saved.dtype, saved.ndim) == (own.dtype, own.ndim))
    if not finite or not matches:
        raise ValueError(f"a tensor of {saved.dtype} {tuple(saved.shape)} that is not finite, not stored or of another type")
