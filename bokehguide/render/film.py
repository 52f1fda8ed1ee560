"""The film: sums over the weighted samples of each pixel."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.bad_samples import BadSample, BadSamples
from bokehguide.render.coverage import Coverage, Covered
from bokehguide.render.features import ControlVariateFeatures, MeanFeatures
from bokehguide.render.group_sums import GroupSums
from bokehguide.render.vector import luminance
from bokehguide.runtime import native
from bokehguide.runtime.indexing import Pixels, bands, core_pixels, gather_pixels, scatter, scatter_add

NO_DEPTH = 1e10
"""Depth of a pixel without a primary hit: the value that Blender uses."""
LEAST_HIT = 1e-3
"""Least divisor of a pixel's depth. The divisor is the share of hits, which the control variate can make 0 or negative."""


@dataclass
class FilmSamples:
    """One sample for each of N pixels, before the multiplication by its weight.

    weight: W / (A q) of Eq. 11, 0 for a lens point outside the aperture, `[N]`. radiance: `[3, N]`. alpha: `[N]`; normal, albedo,
    emission: `[3, N]`; all of the primary hit, 0 without a hit. depth: along the axis, metres, `[N]`, NO_DEPTH without a hit.
    radiance_weight: weight of the radiance, `[N]`, None for `weight`. triangle: of the primary hit, int32 `[N]`, -1 without a
    hit; needed by films with coverage. groups: radiance of the light groups, `[G, 3, N]`; needed by films with groups.
    """

    weight: Tensor
    radiance: Tensor
    alpha: Tensor
    depth: Tensor
    normal: Tensor
    albedo: Tensor
    emission: Tensor
    radiance_weight: Tensor | None = None
    triangle: Tensor | None = None
    groups: Tensor | None = None

    def value(self) -> Tensor:
        """Radiance times its weight, `[3, N]`."""
        return self.radiance * self._value_weight

    def group_values(self) -> Tensor:
        """As `value`, of the light groups, `[G, 3, N]`."""
        assert self.groups is not None
        return self.groups * self._value_weight

    @property
    def _value_weight(self) -> Tensor:
        return self.weight if self.radiance_weight is None else self.radiance_weight

    def features(self) -> Tensor:
        """Alpha, hit (1 or 0), depth times hit, normal and albedo, `[9, N]`."""
        hit = (self.depth < NO_DEPTH).to(torch.float32)
        return torch.cat((self.alpha[None], hit[None], (self.depth * hit)[None], self.normal, self.albedo))


class Film:
    """Running sums of the weighted samples of a frame. Threads may add batches of different pixels concurrently.

    Radiance and emission are means of weight times value. `features` estimates the other layers. Sums are in double precision,
    because float32 sums would lose accuracy after some thousand samples.

    seed: for reports of bad samples. features: class of the estimator, which depends on the weights of the samples. corner:
    column and row, in the frame, of the first pixel of the film. objects: for each kind of coverage, the number of the object of
    each triangle, as `Coverage` takes it. groups: names of the light groups whose radiance the film has as well.
    """

    def __init__(
        self,
        width: int,
        height: int,
        seed: int = 0,
        device: torch.device | str = "cpu",
        features: type[MeanFeatures] = ControlVariateFeatures,
        corner: tuple[int, int] = (0, 0),
        objects: Mapping[str, Tensor] | None = None,
        groups: Sequence[str] = (),
    ):
        self.width, self.height, self.seed, self.corner = width, height, seed, corner
        pixels = width * height
        self._radiance = torch.zeros(3, pixels, dtype=torch.float64, device=device)
        self._emission = torch.zeros(3, pixels, dtype=torch.float64, device=device)
        self._square = torch.zeros(pixels, dtype=torch.float64, device=device)
        self._count = torch.zeros(pixels, device=device)
        self._features = features(pixels, device)
        self._coverage = {kind: Coverage(of, pixels, features, device) for kind, of in (objects or {}).items()}
        self._groups = GroupSums(groups, pixels, device)
        self._nearest = torch.full((pixels,), NO_DEPTH, device=device)
        self._farthest = torch.zeros(pixels, device=device)
        self._bad = BadSamples(width, height, seed, corner)

    def _sums(self) -> dict[str, Tensor]:
        names = ("radiance", "emission", "square", "count", "nearest", "farthest")
        sums = {name: getattr(self, f"_{name}") for name in names} | self._features.sums()
        for kind, coverage in self._coverage.items():
            sums |= {f"{kind} {name}": value for name, value in coverage.sums().items()}
        return sums | self._groups.sums()

    def state_dict(self) -> dict[str, object]:
        """All sums and the bad samples; the tensors are those of the film, so that later samples change them."""
        return {**self._sums(), **self._bad.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the state of a film of the same size and kind of features. Raises as `check_state`, before any change."""
        self.check_state(state)
        for name, tensor in self._sums().items():
            tensor.copy_(state[name])
        self._bad.load_state_dict(state)

    def check_state(self, state: Mapping[str, Any]) -> None:
        """Raise KeyError or ValueError for a state of a film of another size or kind of features, or of other objects."""
        for name, tensor in self._sums().items():
            if state[name].shape != tensor.shape:
                raise ValueError(f"{name} has the shape {tuple(state[name].shape)}, not {tuple(tensor.shape)}")
        for kind, coverage in self._coverage.items():
            coverage.check(state[f"{kind} objects"])

    def add(
        self, pixels: Pixels, samples: FilmSamples, step: int, recenter: bool = True, counted: Tensor | None = None
    ) -> Tensor:
        """Add one sample to each of N different pixels; returns which samples are finite, bool `[N]`.

        recenter: whether to compute the control variate of the features again before the addition. The weights of the new samples
        must then be independent of earlier samples. counted: whether a sample is in the picture, bool `[N]`, None for all.
        """
        core = native.core_on(self._count.device)
        if core is not None and counted is None:
            good = self._add_natively(core, pixels, samples, step, recenter)
        else:
            good = self._add(pixels, samples, step, recenter, counted)
        kept = good if counted is None else good & counted
        self._add_coverage(pixels, samples, kept, recenter)
        if self._groups.names:
            self._groups.add(pixels, samples.group_values(), kept)
        return good

    def _add(self, pixels: Pixels, samples: FilmSamples, step: int, recenter: bool, counted: Tensor | None) -> Tensor:
        """`add` without the native core."""
        weight, emission = samples.weight, samples.emission
        value, features = samples.value(), samples.features()
        good = value.sum(0).isfinite() & weight.isfinite()
        if good.device.type != "cpu" or not bool(good.all()):  # `find_bad` reads the results of all batches from a GPU at once
            self._bad.suspect(pixels, good, step)
            weight, value, emission, features = (x.nan_to_num(0.0, 0.0, 0.0) for x in (weight, value, emission, features))
        kept = (good if counted is None else good & counted).to(torch.float32)
        if recenter:
            self._features.recenter(pixels)
        self._features.add(pixels, features, weight, kept)
        weight, value = weight * kept, value * kept
        scatter_add(self._radiance, pixels, value)
        scatter_add(self._emission, pixels, emission * weight)
        scatter_add(self._square, pixels, luminance(value.double()).square())
        scatter_add(self._count, pixels, kept)
        self._add_range(pixels, samples)
        return good

    def _add_natively(self, core: ModuleType, pixels: Pixels, samples: FilmSamples, step: int, recenter: bool) -> Tensor:
        """`add` by the native core."""
        good = torch.empty(len(samples.weight), dtype=torch.uint8)
        given = {name: None if x is None else x.contiguous() for name, x in vars(samples).items()}
        first, places = core_pixels(pixels)
        clean = core.expose(self._sums(), given, places, first, recenter, good)
        good = good.view(torch.bool)
        if not clean:
            self._bad.suspect(pixels, good, step)
        return good

    def _add_coverage(self, pixels: Pixels, samples: FilmSamples, kept: Tensor, recenter: bool) -> None:
        for coverage in self._coverage.values():
            assert samples.triangle is not None
            weight = samples.weight.nan_to_num(0.0, 0.0, 0.0)
            coverage.add(pixels, samples.triangle, weight, kept.to(torch.float32), recenter)

    def initialise(self, pixels: Pixels, samples: FilmSamples) -> None:
        """Initialise the features of N different pixels with samples of weight 1 that are not in the picture."""
        self._features.initialise(pixels, samples.features().nan_to_num(0.0, 0.0, 0.0))
        for coverage in self._coverage.values():
            assert samples.triangle is not None
            coverage.initialise(pixels, samples.triangle)
        self._add_range(pixels, samples)

    def _add_range(self, pixels: Pixels, samples: FilmSamples) -> None:
        depth = samples.depth
        scatter(self._nearest, pixels, torch.minimum(gather_pixels(self._nearest, pixels), depth))
        scatter(self._farthest, pixels, torch.maximum(gather_pixels(self._farthest, pixels), depth * (depth < NO_DEPTH)))

    def find_bad(self) -> None:
        """Count the bad samples among all added samples."""
        self._bad.find()

    @property
    def bad_count(self) -> int:
        """Number of bad samples."""
        return self._bad.count

    @property
    def bad_samples(self) -> list[BadSample]:
        """First bad samples, in the order of steps and pixels."""
        return self._bad.samples

    def radiance(self) -> Tensor:
        """Mean radiance, float32 `[H, W, 3]`."""
        return self._picture(self._radiance)

    def emission(self) -> Tensor:
        """Mean emission of the primary hits, float32 `[H, W, 3]`."""
        return self._picture(self._emission)

    def _picture(self, sums: Tensor) -> Tensor:
        """Means, float32 `[H, W, 3]`, of sums `[3, pixels]`."""
        mean = torch.empty(sums.shape, device=sums.device)
        for band in self._bands():
            mean[:, band] = sums[:, band] / self._count[band].clamp(min=1.0)
        return mean.T.reshape(self.height, self.width, 3)

    def _bands(self) -> Iterator[slice]:
        """Slices of all pixels. Results in single precision are computed in double precision, for one slice at a time."""
        return bands(self.width * self.height)

    def group_radiance(self) -> Tensor:
        """Mean radiance of the light groups, `[G, 3, pixels]`."""
        return self._groups.means(self._count.clamp(min=1.0))

    def light_groups(self) -> dict[str, np.ndarray]:
        """Radiance of each light group by name, float32 `[H, W, 3]`. The sum is the radiance, but for rounding."""
        planes = self.group_radiance().movedim(1, 2).reshape(-1, self.height, self.width, 3)
        return dict(zip(self._groups.names, planes.cpu().contiguous().numpy()))

    def light(self, pixels: Pixels = slice(None)) -> tuple[float, float]:
        """Sum of the luminance of all samples of the given pixels, and number of these samples."""
        *color, count = torch.cat(
            (_summed(gather_pixels(self._radiance, pixels)), _summed(gather_pixels(self._count, pixels)[None]))
        ).tolist()
        return float(luminance(torch.tensor(color, dtype=torch.float64)[:, None])), count

    def mean_luminance(self) -> float:
        """Mean luminance of the frame."""
        total, count = self.light()
        return total / max(1.0, count)

    def counts(self) -> Tensor:
        """Number of samples, float32 `[H, W]`; the tensor is that of the film."""
        return self._count.reshape(self.height, self.width)

    def samples(self) -> float:
        """Number of all samples."""
        return float(self._count.double().sum())

    def variance(self) -> Tensor:
        """Estimated variance of the mean luminance, float32 `[H, W]`; 0 before the second sample.

        The estimate assumes independent samples. The samples of a pixel are stratified, so that the estimate is slightly too
        large. The largest value is the largest float32, for radiances above 1e19.
        """
        found = torch.cat([self._variance(band) for band in self._bands()])
        return found.reshape(self.height, self.width)

    def _variance(self, band: slice) -> Tensor:
        """`variance` of some pixels, float32 `[N]`."""
        count = self._count[band].double().clamp(min=1.0)
        mean = luminance(self._radiance[:, band]) / count
        spread = (self._square[band] / count - mean * mean).clamp(min=0.0) / (count - 1.0).clamp(min=1.0)
        return spread.clamp(max=torch.finfo(torch.float32).max).float()

    def relative_noise(self) -> float:
        """Estimated standard error of the mean, relative to the mean plus 0.01, averaged over the frame."""
        errors = torch.empty(self._count.shape, device=self._count.device)
        radiance = self.radiance().reshape(-1, 3).T
        for band in self._bands():
            mean = luminance(radiance[:, band]).clamp(min=0.0)
            errors[band] = self._variance(band).sqrt() / (mean + 0.01)
        return float(errors.mean())

    def covered(self) -> dict[str, Covered]:
        """Objects and their coverage by kind, of all pixels in the order of rows."""
        return {kind: coverage.covered(self._count.clamp(min=1.0)) for kind, coverage in self._coverage.items()}

    def layers(self) -> dict[str, np.ndarray]:
        """Layers of the frame by name, contiguous float32 arrays `[H, W]` or `[H, W, 3]`.

        beauty (radiance), normal, albedo and emission are premultiplied by alpha: samples without a hit count as 0. depth is the
        mean over the part of the lens that sees a surface. This quotient has a small bias at low SPP where a pixel sees several
        depths.
        """
        layers: dict[str, np.ndarray] = {}
        for band in self._bands():
            for name, values in self._layers(band).items():
                if name not in layers:
                    layers[name] = np.empty((len(self._count), *values.shape[:-1]), np.float32)
                layers[name][band] = values.float().movedim(0, -1).cpu().numpy()
        return {name: layer.reshape(self.height, self.width, *layer.shape[1:]) for name, layer in layers.items()}

    def _layers(self, band: slice) -> dict[str, Tensor]:
        """`layers` of some pixels, `[N]` or `[3, N]`, in single or double precision."""
        count = self._count[band].clamp(min=1.0)
        features = self._features.means(count, band)
        nearest, farthest = self._nearest[band], self._farthest[band]
        depth = (features[2] / features[1].clamp(min=LEAST_HIT)).clamp(nearest, farthest)
        return {
            "beauty": self._radiance[:, band] / count,
            "alpha": features[0],
            "depth": torch.where(farthest > 0.0, depth, NO_DEPTH),
            "normal": features[3:6],
            "albedo": features[6:9],
            "emission": self._emission[:, band] / count,
            "variance": self._variance(band),
            "sample_count": self._count[band],
        }


def _summed(rows: Tensor) -> Tensor:
    """Sums float64 `[R]` of rows `[R, N]`, in an order that does not depend on the number of threads."""
    if rows.device.type == "cpu":
        return torch.from_numpy(rows.numpy().sum(1, dtype=np.float64))
    return rows.sum(1, dtype=torch.float64)
