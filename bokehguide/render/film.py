"""The film: what the samples of each pixel add up to."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.pixels import Pixels, increase, indices_of_each, put, take
from bokehguide.render.vector import luminance

NO_DEPTH = 1e10
"""Depth of a pixel in which no ray met a surface, as Blender writes it."""
KEPT_BAD_SAMPLES = 100


class BadSample(NamedTuple):
    """A NaN or infinite sample that was kept off the film: pixel of the frame, SPP step and seed."""

    x: int
    y: int
    step: int
    seed: int


@dataclass
class FilmSamples:
    """One sample for each pixel of a batch, not yet weighted.

    weight: W/q = 1/(A q) of Eq. 11, 0 for a draw outside the aperture, `[N]`.
    radiance: `[3, N]`. What the first surface is, 0 where there is none: alpha `[N]`,
    normal, albedo, emission `[3, N]`. depth: along the axis, NO_DEPTH without a surface, `[N]`.
    radiance_weight: `[N]`, where the radiance has a weight of its own.
    """

    weight: Tensor
    radiance: Tensor
    alpha: Tensor
    depth: Tensor
    normal: Tensor
    albedo: Tensor
    emission: Tensor
    radiance_weight: Tensor | None = None

    def value(self) -> Tensor:
        """Radiance times its weight, `[3, N]`."""
        return self.radiance * (self.weight if self.radiance_weight is None else self.radiance_weight)

    def features(self) -> Tensor:
        """Alpha, whether a surface was met, depth where one was, normal and albedo, `[9, N]`."""
        hit = (self.depth < NO_DEPTH).to(torch.float32)
        return torch.cat((self.alpha[None], hit[None], (self.depth * hit)[None], self.normal, self.albedo))


class Film:
    """Running sums of a frame; batches of different pixels may be added side by side.

    What the picture is made of is summed in double precision: a float32 sum would drift after some thousand
    samples. Radiance (unless its weight is another one) and emission are means of w x. Alpha, normal, albedo and depth are smooth where
    the weights w are not: their estimate is the mean of w (x - c) + c, unbiased because the weights'
    mean is 1 and c comes from the pixel's earlier samples. Where x is the same throughout, it comes
    out exactly: alpha is 1 where all is opaque.
    c = Σ w² x / Σ w² is a mean of values seen and near the best constant, which is
    (E[w² x] - E[x]) / (E[w²] - 1). Where the first sample's weight may be other than 1,
    `prime` provides its c. Where weights are stratified over a block of steps, c is from before it.

    vignetted: the weights' mean is less than 1 towards the frame's edge. Radiance and emission
    darken with it. Alpha, normal and albedo do not: they are Σ w x / Σ w. weighted: whether weights
    may be other than 1 where nothing is vignetted; where all are 1, c would change nothing.

    corner: column and row of its first pixel in the frame of which it is a part.
    """

    def __init__(
        self,
        width: int,
        height: int,
        seed: int = 0,
        device: torch.device | str = "cpu",
        vignetted: bool = False,
        weighted: bool = True,
        corner: tuple[int, int] = (0, 0),
    ):
        self.width, self.height, self.seed, self.corner = width, height, seed, corner
        pixels = width * height
        self._radiance = torch.zeros(3, pixels, dtype=torch.float64, device=device)
        self._emission = torch.zeros(3, pixels, dtype=torch.float64, device=device)
        self._square = torch.zeros(pixels, dtype=torch.float64, device=device)
        self._count = torch.zeros(pixels, device=device)
        self._features = torch.zeros(9, pixels, dtype=torch.float64, device=device)  # alpha, hit, hit times depth, normal, albedo
        controlled = weighted and not vignetted
        self._control = torch.zeros(10, pixels, device=device) if controlled else None  # w², and w² times each feature
        self._center = torch.zeros(9, pixels, device=device) if controlled else None  # c
        self._passed = torch.zeros(pixels, dtype=torch.float64, device=device) if vignetted else None  # w
        self._nearest = torch.full((pixels,), NO_DEPTH, device=device)
        self._farthest = torch.zeros(pixels, device=device)
        self._bad_count = 0
        self._bad_samples: list[BadSample] = []
        self._suspects: list[tuple[Pixels, Tensor, int]] = []
        """Samples that may not be finite: pixels, whether they are, bool `[N]`, and the step."""
        self._lock = threading.Lock()

    def _sums(self) -> dict[str, Tensor]:
        names = ("radiance", "emission", "square", "count", "features", "control", "center", "passed", "nearest", "farthest")
        sums = {name: getattr(self, f"_{name}") for name in names}
        return {name: tensor for name, tensor in sums.items() if tensor is not None}

    def state_dict(self) -> dict[str, object]:
        """All sums, and the samples that were left out; the tensors are the film's own."""
        return {**self._sums(), "bad_count": self.bad_count, "bad_samples": [tuple(bad) for bad in self.bad_samples]}

    def load_state_dict(self, state: Mapping[str, object]) -> None:
        """Go on from the state of a film of the same size. Raises KeyError or ValueError where it is of another one."""
        for name, tensor in self._sums().items():
            if state[name].shape != tensor.shape:
                raise ValueError(f"{name} has the shape {tuple(state[name].shape)}, not {tuple(tensor.shape)}")
            tensor.copy_(state[name])
        self._bad_count, self._suspects = state["bad_count"], []
        self._bad_samples = [BadSample(*bad) for bad in state["bad_samples"]]

    def add(
        self, pixels: Pixels, samples: FilmSamples, step: int, fresh: bool = True, counted: Tensor | None = None
    ) -> Tensor:
        """Add one sample to each of N different pixels; returns the finite ones, bool `[N]`.

        fresh: whether the weights are independent of the pixels' latest samples, so that c may be.
        counted: which samples are to be in the picture, bool `[N]`, where some are not.
        """
        weight, emission = samples.weight, samples.emission
        value, features = samples.value(), samples.features()
        good = value.sum(0).isfinite()
        if good.device.type != "cpu" or not bool(good.all()):  # from a GPU, one answer for all batches comes sooner
            self._suspects.append((pixels, good, step))
            every = (weight, value, emission, features)
            weight, value, emission, features = (x.nan_to_num(0.0, 0.0, 0.0) for x in every)
        kept = (good if counted is None else good & counted).to(torch.float32)
        self._add_features(pixels, weight, features, kept, fresh)
        weight, value = weight * kept, value * kept
        increase(self._radiance, pixels, value)
        increase(self._emission, pixels, emission * weight)
        increase(self._square, pixels, luminance(value.double()).square())
        increase(self._count, pixels, kept)
        self._add_range(pixels, samples)
        return good

    def prime(self, pixels: Pixels, samples: FilmSamples) -> None:
        """Tell N different pixels of samples of the uniform lens that are not in the picture."""
        if self._control is not None:
            increase(self._control[0], pixels, torch.ones_like(samples.weight))
            increase(self._control[1:], pixels, samples.features().nan_to_num(0.0, 0.0, 0.0))
        self._add_range(pixels, samples)

    def _add_range(self, pixels: Pixels, samples: FilmSamples) -> None:
        depth = samples.depth
        put(self._nearest, pixels, torch.minimum(take(self._nearest, pixels), depth))
        put(self._farthest, pixels, torch.maximum(take(self._farthest, pixels), depth * (depth < NO_DEPTH)))

    def _add_features(self, pixels: Pixels, weight: Tensor, features: Tensor, kept: Tensor, fresh: bool) -> None:
        if self._passed is not None:
            increase(self._features, pixels, features * (weight * kept))
            increase(self._passed, pixels, weight * kept)
            return
        if self._control is None:
            increase(self._features, pixels, features * kept)
            return
        if fresh:
            seen = take(self._control, pixels)
            put(self._center, pixels, seen[1:] / seen[0].clamp(min=1e-30))
        # w (x - c) + c
        increase(self._features, pixels, torch.lerp(take(self._center, pixels), features, weight).mul_(kept))
        square = weight * weight
        increase(self._control[0], pixels, square)
        increase(self._control[1:], pixels, features * square)

    def find_bad(self) -> None:
        """Count samples that were not finite, of all that were added so far."""
        with self._lock:
            suspects, self._suspects = self._suspects, []
            for (pixels, good, step), places in zip(suspects, indices_of_each([~good for _, good, _ in suspects])):
                if len(places) > 0:
                    self._report_bad(torch.arange(self.width * self.height, device=good.device)[pixels][places], step)

    def _report_bad(self, pixels: Tensor, step: int) -> None:
        left, top = self.corner
        found = [BadSample(left + p % self.width, top + p // self.width, step, self.seed) for p in pixels.tolist()]
        self._bad_count += len(found)
        self._bad_samples = earliest(self._bad_samples + found)

    @property
    def bad_count(self) -> int:
        """How many samples were not finite."""
        self.find_bad()
        return self._bad_count

    @property
    def bad_samples(self) -> list[BadSample]:
        """The first samples that were not finite, in the order of steps and pixels."""
        self.find_bad()
        return list(self._bad_samples)

    def radiance(self) -> Tensor:
        """Mean radiance so far, float32 `[H, W, 3]`."""
        mean = self._radiance / self._count.clamp(min=1.0)
        return mean.float().T.reshape(self.height, self.width, 3)

    def light(self, pixels: Pixels = slice(None)) -> tuple[float, float]:
        """Luminance of all samples of some pixels, and their number."""
        *color, count = torch.cat((_summed(take(self._radiance, pixels)), _summed(take(self._count, pixels)[None]))).tolist()
        return float(luminance(torch.tensor(color, dtype=torch.float64)[:, None])), count

    def mean_luminance(self) -> float:
        """Mean luminance of the frame so far."""
        total, count = self.light()
        return total / max(1.0, count)

    def samples(self) -> float:
        """Number of all samples."""
        return float(self._count.double().sum())

    def variance(self) -> Tensor:
        """Estimated variance of the mean luminance, float32 `[H, W]`; 0 before the second sample.

        That of independent samples: a little more than it is, as a pixel's steps are stratified.
        It ends at the largest float32, which radiances above 1e19 reach.
        """
        count = self._count.double().clamp(min=1.0)
        mean = luminance(self._radiance) / count
        spread = (self._square / count - mean * mean).clamp(min=0.0) / (count - 1.0).clamp(min=1.0)
        return spread.clamp(max=torch.finfo(torch.float32).max).float().reshape(self.height, self.width)

    def relative_noise(self) -> float:
        """Estimated standard error of the mean over the mean (plus 0.01), averaged over the frame."""
        mean = luminance(self.radiance().reshape(-1, 3).T).clamp(min=0.0)
        return float((self.variance().reshape(-1).sqrt() / (mean + 0.01)).mean())

    def layers(self) -> dict[str, np.ndarray]:
        """The frame as contiguous float32 arrays `[H, W]` or `[H, W, 3]` by name.

        beauty, normal, albedo and emission are premultiplied: samples that met nothing count
        as 0 in them. depth is the mean over the part of the lens that sees a surface, a quotient
        that is biased by a little at low SPP where a pixel sees several depths.
        """
        shape = (self.height, self.width)
        count = self._count.clamp(min=1.0)
        features = self._features / (count if self._passed is None else self._passed.clamp(min=1e-20))
        depth = features[2] / features[1].clamp(min=1e-3)
        depth = torch.where(self._farthest > 0.0, depth.clamp(self._nearest, self._farthest), NO_DEPTH)
        layers = {
            "beauty": self.radiance(),
            "alpha": features[0].reshape(shape),
            "depth": depth.reshape(shape),
            "normal": features[3:6].T.reshape(*shape, 3),
            "albedo": features[6:9].T.reshape(*shape, 3),
            "emission": (self._emission / count).T.reshape(*shape, 3),
            "variance": self.variance(),
            "sample_count": self._count.reshape(shape),
        }
        return {name: np.ascontiguousarray(layer.cpu().numpy(), np.float32) for name, layer in layers.items()}


def _summed(rows: Tensor) -> Tensor:
    """Sums float64 `[R]` of rows `[R, N]`, in an order that no thread count changes."""
    if rows.device.type == "cpu":
        return torch.from_numpy(rows.numpy().sum(1, dtype=np.float64))
    return rows.sum(1, dtype=torch.float64)


def earliest(samples: list[BadSample]) -> list[BadSample]:
    """The first of them, as many as are kept, in the order of steps and pixels."""
    return sorted(samples, key=lambda bad: (bad.step, bad.y, bad.x))[:KEPT_BAD_SAMPLES]
