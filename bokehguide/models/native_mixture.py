"""The mixture of shapes on the lens in the native core: the same distribution as `EllipseMixture`.

`native/lens_mixture.h`, `parallelograms.h` and `environment_shapes.h` hold the formulas.
"""

from __future__ import annotations

from functools import cached_property
from types import ModuleType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bokehguide.models.base import LensDensity, LensMixture, LensSample, owners
from bokehguide.models.ellipse_mixture import EmitterShapes
from bokehguide.render.lens import Lens


class CoreField(NamedTuple):
    """The G components of a field in the native core.

    tables: by the names of `MixtureRows` in `native/tables.h`. shapes: emitters of the map and parallelograms, None for none.
    """

    extension: ModuleType
    tables: dict[str, Tensor]
    shapes: tuple[object | None, object | None]

    @staticmethod
    def of(extension: ModuleType, mean: Tensor, outline: Tensor, weight: Tensor, shapes: EmitterShapes) -> CoreField:
        """A field of ellipsoids with the arguments of an `EllipseMixture` whose candidates are all components, `[.., G]`."""
        tables = {
            "mean": mean,
            "outline": outline,
            "strength": weight,
            "environment_index": shapes.environment_index,
            "parallelogram_index": shapes.parallelogram_index,
        }
        return CoreField(extension, {name: table.contiguous() for name, table in tables.items()}, shapes.in_core(extension))


class NativeEllipseMixture(LensMixture):
    """`EllipseMixture` of the components `component` int64 `[M]` of a field. For the other arguments, see `EllipseMixture`.

    core: the `EllipseMixture` of the extension.
    """

    def __init__(
        self,
        lens: Lens,
        focus: Tensor,
        beta: Tensor,
        start: Tensor,
        field: CoreField,
        component: Tensor,
        learned_scale: Tensor,
        clip_to_lens: bool = True,
    ):
        self.lens, self.focus, self._start = lens, focus, start
        count, pixels = len(component), focus.shape[1]
        lanes = field.extension.MOST_LANES
        self.weight, self._contribution = torch.empty(count), torch.empty(-(-count // lanes) * lanes)
        self.beta, self.guided = torch.empty(pixels), torch.empty(pixels, dtype=torch.bool)
        given = {"start": start, "component": component, "focus": focus, "beta": beta, "scale": learned_scale}
        results = {
            "contribution": self._contribution,
            "weight": self.weight,
            "own_beta": self.beta,
            "guided": self.guided.view(torch.uint8),
        }
        tables = field.tables | {name: values.contiguous() for name, values in given.items()} | results
        numbers = {"radius": lens.radius, "squared_radius": lens.radius**2, "area": lens.area, "clips": float(clip_to_lens)}
        self.core: Any = field.extension.EllipseMixture(tables, numbers, *field.shapes)

    @cached_property
    def owner(self) -> Tensor:  # type: ignore[override]
        return owners(self._start, len(self.weight))

    @property
    def expected_contribution(self) -> Tensor:
        """See `EllipseMixture`."""
        return self._contribution[: len(self.weight)]

    def sample(self, uniforms: Tensor) -> LensSample:
        """See `EllipseMixture`."""
        points = self.lens.sample(uniforms[1:3]).contiguous()
        candidate = torch.empty(points.shape[1], dtype=torch.int64)
        self.core.sample(uniforms[:3].contiguous(), points, candidate)
        return LensSample(points, candidate)

    def evaluate(self, points: Tensor) -> LensDensity:
        """See `LensMixture`."""
        components, mixture, density = (torch.empty(size) for size in (len(self.weight), points.shape[1], points.shape[1]))
        points = points.contiguous()
        transmission = None if self.lens.is_disc else self.lens.transmission(points).contiguous()
        self.core.evaluate(points, transmission, components, mixture, density)
        return LensDensity(points, components, mixture, density)
