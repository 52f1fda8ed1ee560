"""Mixtures on the lens in the native core: the same distributions as `EllipseMixture` and `GaussianMixture`.

`native/lens_mixture.h` computes weights, choices of candidates and densities of either mixture. The formulas of the components
are in `ellipses.h`, `parallelograms.h`, `environment_shapes.h` and `gaussians.h`.
"""

from __future__ import annotations

from functools import cached_property
from types import ModuleType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bokehguide.models.base import LensDensity, LensMixture, LensSample, owners
from bokehguide.models.ellipse_mixture import EmitterShapes
from bokehguide.models.gaussian_field import GaussianField
from bokehguide.models.polynomial_offset import PolynomialOffset
from bokehguide.render.lens import Lens


class CoreField(NamedTuple):
    """The G components of a field in the native core.

    tables: by the names of `EllipseRows` in `native/tables.h`. shapes: emitters of the map and parallelograms, None for none.
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


class CoreGaussians(NamedTuple):
    """The G Gaussians of a field in the native core, and polynomial offsets of their means.

    tables: the arrays of which `native/mixture.cpp` makes the rows of Gaussians. degree: of the polynomials, -1 without offsets.
    """

    extension: ModuleType
    tables: dict[str, Tensor]
    degree: int

    @staticmethod
    def of(extension: ModuleType, field: GaussianField, weight: Tensor, offsets: PolynomialOffset | None) -> CoreGaussians:
        """Gaussians with the unnormalised mixture weights `[G]`."""
        tables = {"mean": field.mean, "sigma": field.sigma, "strength": weight}
        if offsets is not None:
            tables |= {"center": offsets.center, "inverse_radius": offsets.inverse_radius, "unit": offsets.unit}
            tables["coefficients"] = offsets.coefficients.detach()
        degree = -1 if offsets is None else offsets.degree
        return CoreGaussians(extension, {name: table.contiguous() for name, table in tables.items()}, degree)


class NativeMixture(LensMixture):
    """Base class of the mixtures of the components `component` int64 `[M]` of a field in the native core.

    A subclass makes its `core`, a `Mixture` of the extension, from `_tables` and `_numbers`. For other arguments, see
    `LensMixture`.
    """

    def __init__(self, lens: Lens, focus: Tensor, start: Tensor, component: Tensor, extension: ModuleType):
        self.lens, self.focus, self._start, self._component = lens, focus, start, component
        pixels = focus.shape[1]
        self._columns = -(-len(component) // extension.MOST_LANES) * extension.MOST_LANES
        self.weight, self._contribution = torch.empty(len(component)), torch.empty(self._columns)
        self.beta, self.guided = torch.empty(pixels), torch.empty(pixels, dtype=torch.bool)

    def _tables(self, beta: Tensor, field: dict[str, Tensor], **given: Tensor) -> dict[str, Tensor]:
        """The arrays of `MixtureRows` in `native/tables.h`, and those of a subclass."""
        given |= {"start": self._start, "component": self._component, "focus": self.focus, "beta": beta}
        results = {
            "contribution": self._contribution,
            "weight": self.weight,
            "own_beta": self.beta,
            "guided": self.guided.view(torch.uint8),
        }
        return field | {name: values.contiguous() for name, values in given.items()} | results

    def _numbers(self) -> dict[str, float]:
        return {"radius": self.lens.radius, "squared_radius": self.lens.radius**2, "area": self.lens.area}

    @cached_property
    def owner(self) -> Tensor:  # type: ignore[override]
        return owners(self._start, len(self.weight))

    def evaluate(self, points: Tensor) -> LensDensity:
        """See `LensMixture`."""
        components, mixture, density = (torch.empty(size) for size in (len(self.weight), points.shape[1], points.shape[1]))
        points = points.contiguous()
        transmission = None if self.lens.is_disc else self.lens.transmission(points).contiguous()
        self.core.evaluate(points, transmission, components, mixture, density)
        return LensDensity(points, components, mixture, density)

    def weights(self, at: LensDensity) -> Tensor:
        """See `LensMixture`."""
        if not self.lens.is_disc:
            return super().weights(at)
        weights = torch.empty(at.points.shape[1])
        self.core.weights(at.points, at.density, weights)
        return weights


class NativeEllipseMixture(NativeMixture):
    """`EllipseMixture` of the components `component` int64 `[M]` of a field. For the other arguments, see `EllipseMixture`."""

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
        super().__init__(lens, focus, start, component, field.extension)
        tables = self._tables(beta, field.tables, scale=learned_scale)
        self.core: Any = field.extension.EllipseMixture(tables, self._numbers() | {"clips": float(clip_to_lens)}, *field.shapes)

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


class NativeGaussianMixture(NativeMixture):
    """`GaussianMixture` of the Gaussians `component` int64 `[M]` of a field. For the other arguments, see `GaussianMixture`.

    raster: raster positions, `[2, N]`, at which the means have their offsets.
    """

    def __init__(
        self, lens: Lens, focus: Tensor, beta: Tensor, start: Tensor, field: CoreGaussians, component: Tensor, raster: Tensor
    ):
        super().__init__(lens, focus, start, component, field.extension)
        self._gaussians, self._field = torch.empty(self._columns, 4), field
        tables = self._tables(beta, field.tables, raster=raster) | {"gaussians": self._gaussians}
        self.core: Any = field.extension.GaussianMixture(tables, self._numbers() | {"degree": float(field.degree)})

    @property
    def mean(self) -> Tensor:
        """See `GaussianMixture`."""
        return self._gaussians[: len(self.weight), :3].T

    @property
    def sigma(self) -> Tensor:
        """See `GaussianMixture`."""
        return self._gaussians[: len(self.weight), 3]

    def sample(self, uniforms: Tensor) -> LensSample:
        """See `GaussianMixture`."""
        uniforms = uniforms.float().contiguous()
        points = self.lens.sample(uniforms[2:4]).contiguous()
        self.core.sample(uniforms, points, None)
        return LensSample(points)

    def offset_gradient(self, ratio: Tensor, at: LensDensity) -> Tensor:
        """See `offset_gradient` of `models/kl.py`."""
        axes, monomials, count = self._field.tables["coefficients"].shape
        sums = torch.zeros(count, monomials, axes + 1, dtype=torch.float64)  # rows of four numbers, the last one 0
        self.core.add_offset_gradient(at.points, at.components, ratio.contiguous(), at.density, sums)
        return sums[..., :axes].permute(2, 1, 0)
