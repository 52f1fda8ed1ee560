"""A guide for another renderer: it asks where on the lens to sample, and reports what it found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from numpy.typing import ArrayLike
from torch import Size, Tensor
from torch.distributions import Distribution, constraints

from bokehguide.errors import BokehguideError
from bokehguide.guiding.config import GaussianConfig
from bokehguide.guiding.gaussian_guide import AnyGaussianMixture, GaussianGuide, Gradients
from bokehguide.guiding.guide import GuideRecord
from bokehguide.guiding.protocols import StepSummary
from bokehguide.models.kl import blend_gradient
from bokehguide.models.uniform import UniformLensDistribution
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.lens import Lens
from bokehguide.render.tracer import MISS_DISTANCE
from bokehguide.render.vector import normalize
from bokehguide.runtime.distributed import Ranks
from bokehguide.scene.types import Camera, FilmSettings

UNIFORMS = 5
"""Uniform numbers for a lens point: for the part of the mixture, for its component, and three for the point."""


class LensPointDistribution(Distribution):
    """The lens points of N pixels, one density for each: batch shape `[N]`, event shape `[2]`.

    Points are in units of the lens radius, x right and y up seen from behind the camera, so that the aperture lies on the unit
    disc. Densities are per unit area of this plane. A draw may miss the aperture; its `weight` is 0.
    """

    arg_constraints: dict[str, constraints.Constraint] = {}  # noqa: RUF012 - the base class declares it so
    support = constraints.independent(constraints.real, 1)  # type: ignore[assignment] - a property of the base class

    def __init__(self, lens: Lens, pixels: Tensor, focus: Tensor, mixture: AnyGaussianMixture | None):
        super().__init__(Size(pixels.shape), Size((2,)), validate_args=False)
        self.lens, self.pixels, self.focus, self.mixture = lens, pixels, focus, mixture
        self._density = mixture or UniformLensDistribution(lens)

    def sample(self, sample_shape: Size | tuple[int, ...] = (), uniforms: Tensor | None = None) -> Tensor:
        """Lens points `[*sample_shape, N, 2]`.

        uniforms: numbers in 0 … 1 to draw from, `[..., N, 5]`, in place of those of `torch.rand`; their first axes are the
        sample shape. Raises BokehguideError for another shape, and for numbers out of this range.
        """
        if uniforms is None:
            uniforms = torch.rand(*sample_shape, *self.batch_shape, UNIFORMS)
        uniforms = _numbers("sample: uniforms", uniforms)
        _check_shape("sample: uniforms", uniforms, (*self.batch_shape, UNIFORMS))
        _check_values("sample: uniforms", uniforms, (uniforms >= 0.0) & (uniforms <= 1.0), "from 0 to 1")
        numbers = uniforms.reshape(-1, *self.batch_shape, UNIFORMS).permute(0, 2, 1)
        used = slice(None) if self.mixture is not None else slice(2, 4)
        points = torch.stack([self._density.sample(each[used].contiguous()).points.T for each in numbers])
        return points.reshape(*uniforms.shape[:-1], 2) / self.lens.radius

    def log_prob(self, value: Tensor) -> Tensor:
        """Logarithm of the density `[..., N]` at points `[..., N, 2]`; -inf where it is 0."""
        return self._of_points(value, lambda points: (self._density.pdf(points) * self.lens.radius**2).log())

    def weight(self, value: Tensor) -> Tensor:
        """The weight W / (A q) `[..., N]` of samples at points `[..., N, 2]`.

        Radiance times weight is an unbiased estimate of the mean over the aperture. In a pixel without candidates, the weight is
        1 in an even aperture. The weight of a point outside the aperture is 0.
        """
        return self._of_points(value, self.weight_at)

    def weight_at(self, points: Tensor) -> Tensor:
        """As `weight`, `[N]` at points `[2, N]` in metres."""
        passed = self.lens.transmission(points) * self.lens.unblocked(points, self.focus)
        return passed / (self.lens.area * self._density.pdf(points)).clamp(min=1e-20)

    def _of_points(self, value: Tensor, function) -> Tensor:
        _check_shape("points", value, (*self.batch_shape, 2))
        return torch.stack([function(points) for points in self.metres(value)]).reshape(value.shape[:-1])

    def metres(self, value: Tensor) -> Tensor:
        """Points `[S, 2, N]` in metres, of points `[..., N, 2]` with S samples a pixel."""
        return (value * self.lens.radius).reshape(-1, *self.batch_shape, 2).transpose(1, 2)


@dataclass(frozen=True)
class _Frame:
    """The context of the guide."""

    camera: ThinLensCamera
    ranks: Ranks


class LensGuide:
    """Learns where on the lens each pixel of another renderer should look, by the paper's method (`GaussianGuide`).

    A step of the renderer reads:

        lens = guide.distribution(raster)
        points = lens.sample()
        … trace rays from the lens points through the focus points …
        picture += lens.weight(points) * radiance
        guide.observe(points, distances, luminance)
        guide.update()

    `distribution` and `observe` may be called several times before `update`, once for each part of the frame. A step draws from
    the state at its start, so that every estimate is unbiased.

    camera: of the renderer, a thin lens. width, height: of the frame, pixels. config: settings of the method.
    Raises BokehguideError for a size out of range, for another type, and for a pinhole, which has one lens point.
    """

    def __init__(self, camera: Camera, width: int, height: int, config: GaussianConfig | None = None):
        config = config or GaussianConfig()
        for name, value, kind in (("camera", camera, Camera), ("config", config, GaussianConfig)):
            if not isinstance(value, kind):
                raise BokehguideError(f"LensGuide: {name}: a {type(value).__name__} is no {kind.__name__}; give one")
        if camera.aperture_radius == 0.0:
            raise BokehguideError("LensGuide: aperture_radius 0 is a pinhole with one lens point; give a lens of some radius")
        film = FilmSettings(width, height)
        self.camera = ThinLensCamera(camera, film.width, film.height)
        self._guide = GaussianGuide(_Frame(self.camera, Ranks()), config, True, False)
        self.step = 0
        self._light = self._count = 0.0
        self._last: LensPointDistribution | None = None
        self._begin()

    def _begin(self) -> None:
        """Forget the observations of the step."""
        self._records: list[GuideRecord] = []
        self._gradient = torch.zeros(self.camera.width * self.camera.height, dtype=torch.float64)

    @property
    def highlights(self) -> int:
        """The number of highlights that are known."""
        return len(self._guide.field)

    @property
    def mean_luminance(self) -> float:
        """The mean luminance of the frame so far; 1 before the first observation."""
        return self._light / self._count if self._count else 1.0

    def distribution(self, raster: ArrayLike | Tensor) -> LensPointDistribution:
        """The distribution of the lens points at raster positions `[N, 2]`: pixels from the left and from the top of the frame.

        Raises BokehguideError for another shape, and for positions outside the frame.
        """
        positions = _numbers("LensGuide.distribution: raster", raster)
        if positions.ndim != 2 or positions.shape[1] != 2:
            raise BokehguideError(f"LensGuide.distribution: raster has shape {tuple(positions.shape)}, not (N, 2)")
        positions = positions.T.contiguous()
        width, height = self.camera.width, self.camera.height
        x, y = positions  # rounding to single precision may move a position to the edge of the frame
        if not bool(((x >= 0.0) & (x <= width) & (y >= 0.0) & (y <= height)).all()):
            outside = f"raster has positions outside the {width} × {height} pixels; leave them out"
            raise BokehguideError(f"LensGuide.distribution: {outside}")
        pixels = y.long().clamp(max=height - 1) * width + x.long().clamp(max=width - 1)
        focus = self.camera.focus_points(positions)
        mixture = None
        if self._guide.candidates is not None:
            start, gaussian = self._guide.candidates.batch(pixels)
            if len(gaussian) > 0:
                mixture = self._guide.mixture(pixels, positions, focus, start, gaussian)
        self._last = LensPointDistribution(self.camera.lens, pixels, focus, mixture)
        return self._last

    @torch.no_grad()
    def observe(self, points: ArrayLike | Tensor, distances: ArrayLike | Tensor, luminance: ArrayLike | Tensor) -> None:
        """Report the rays from lens points of the latest distribution.

        points: of its `sample`, or others, `[..., N, 2]`. distances: along each ray from its lens point to the first surface,
        metres, infinite without one, `[..., N]`. luminance: of the radiance along each ray, without the weight, `[..., N]`.
        A ray whose luminance is NaN or infinite, or whose distance is NaN, counts as black. Raises BokehguideError for other
        shapes, for negative values, for points that are not finite, and before the first distribution.
        """
        lens = self._last
        if lens is None:
            raise BokehguideError("LensGuide.observe: no distribution yet; call distribution(raster) first")
        points, distances, luminance = (
            _numbers(f"LensGuide.observe: {name}", values)
            for name, values in (("points", points), ("distances", distances), ("luminance", luminance))
        )
        _check_shape("points", points, (*lens.batch_shape, 2))
        _check_values("LensGuide.observe: points", points, points.isfinite(), "finite numbers")
        for name, values in (("distances", distances), ("luminance", luminance)):
            _check_values(f"LensGuide.observe: {name}", values, ~(values < 0.0), "0 or more")
            if values.shape != points.shape[:-1]:
                expected = tuple(points.shape[:-1])
                raise BokehguideError(
                    f"LensGuide.observe: {name} has shape {tuple(values.shape)}, not {expected} as the points have"
                )
        rows = zip(lens.metres(points), distances.reshape(-1, *lens.batch_shape), luminance.reshape(-1, *lens.batch_shape))
        unit = self.mean_luminance or torch.inf
        light = count = 0.0
        for at, distance, value in rows:
            good = value.isfinite() & ~distance.isnan()
            value = torch.where(good, value, 0.0)
            weight = lens.weight_at(at) * good
            self._record(lens, at, distance.clamp(max=MISS_DISTANCE), value, weight, unit)
            light, count = light + float((value * weight).double().sum()), count + len(value)
        self._light, self._count = self._light + light, self._count + count

    def _record(
        self, lens: LensPointDistribution, points: Tensor, distance: Tensor, light: Tensor, weight: Tensor, unit: float
    ) -> None:
        """Keep the records of one sample a pixel, and its gradient of β."""
        directions = self.camera.axes @ normalize(lens.focus - torch.cat((points, torch.zeros_like(points[:1]))))
        self._records.append(GuideRecord(records=self._guide.records(points, directions, distance, light, weight)))
        if lens.mixture is not None:
            gradient = blend_gradient(lens.mixture, light * weight / unit, lens.mixture.evaluate(points))
            self._gradient.index_add_(0, lens.pixels, gradient.double())

    def update(self) -> None:
        """End a step: learn from its observations."""
        if not self._records:
            raise BokehguideError("LensGuide.update: nothing was observed in this step; call observe first")
        self.step += 1
        if self._guide.candidates is not None:
            self._records[-1].learned = Gradients(slice(0, len(self._gradient)), self._gradient.float(), None)
        summary = StepSummary(self.step, self.mean_luminance, lambda: torch.zeros(0))  # this guide asks for no picture
        self._guide.accumulate(self._records, summary)
        self._guide.update(summary)
        self._begin()

    def state_dict(self) -> dict[str, Any]:
        """All that later steps depend on, to be taken after `update`; tensors are the guide's own, as in any state dict."""
        return {
            "step": self.step,
            "light": self._light,
            "count": self._count,
            "guide": self._guide.state_dict(),
            "optimizer": self._guide.optimizers["blend"].state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state. Raises BokehguideError for that of another camera's frame."""
        try:
            self._guide.load_state_dict(state["guide"])
            self._guide.optimizers["blend"].load_state_dict(state["optimizer"])
            self.step, self._light, self._count = state["step"], state["light"], state["count"]
            self._guide.check(self.step)
        except (KeyError, RuntimeError, TypeError, ValueError) as error:
            reason = str(error).splitlines()[-1].strip()
            raise BokehguideError(f"LensGuide.load_state_dict: not a state of this guide ({reason})") from None
        self._last = None
        self._begin()


def _check_shape(name: str, values: Tensor, ending: tuple[int, ...]) -> None:
    """Raise BokehguideError unless the last axes of `values` are as long as `ending`."""
    if tuple(values.shape[-len(ending) :]) != ending:
        wanted = ", ".join(map(str, ending))
        raise BokehguideError(f"{name}: has shape {tuple(values.shape)}, not (..., {wanted})")


def _numbers(name: str, values: ArrayLike | Tensor) -> Tensor:
    """A caller's array in single precision. Raises BokehguideError for anything but numbers."""
    try:
        return torch.as_tensor(values, dtype=torch.float32)
    except (RuntimeError, TypeError, ValueError):
        raise BokehguideError(f"{name}: a {type(values).__name__} is no array of numbers; give one") from None


def _check_values(name: str, values: Tensor, good: Tensor, wanted: str) -> None:
    """Raise BokehguideError unless all values are good. The guide is on the host, so that the check waits for no device."""
    if not bool(good.all()):
        first = float(values[~good][0])
        raise BokehguideError(f"{name}: {int((~good).sum())} values are out of range, such as {first:g}; give {wanted}")
