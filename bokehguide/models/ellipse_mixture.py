"""The lens distribution of mode `guided`: constant densities on the ellipses and other shapes that emitters cover on the lens.

Through a focus point x_F, a ball of constant radiance lights a disc of the lens evenly. The second moment of sample weights over
their squared mean is 1 for a constant density on the disc. For the best Gaussian, with σ = R / 1.78, the ratio is 1.54.
docs/explanation/lens-densities.md derives the formulas.
"""

from __future__ import annotations

import math
from types import ModuleType
from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.models.base import LensMixture, LensSample
from bokehguide.models.emitters.environment import EnvironmentEmitters, ViewedEnvironment
from bokehguide.models.emitters.parallelogram import ParallelogramEmitters, ViewedParallelograms
from bokehguide.models.projection import LENS_MARGIN, project_to_lens
from bokehguide.render.lens import Lens
from bokehguide.runtime.device import to_device
from bokehguide.runtime.indexing import ActiveEntries

MIN_SQUARED_ASPECT = 1e-4
"""Least squared height of an ellipse over its squared vertical extent. An edge-on emitter then has an ellipse, not a line."""
MAX_SQUARED_DEPTH = 0.9
"""Largest squared half axis along z over the squared distance to x_F along z. The outline is an ellipse only below 1."""
MIN_CLIP_END = -0.9
"""Least `StripClip.high`. Single precision does not resolve the area of a narrower strip."""
MIN_STRIP_SHARE = 1e-7
"""Least `StripClip.share`. For the largest ellipses, the share of the strip would round to 0."""
INSIDE = 1.0 - 1e-6
"""Factor of sampled radii, so that rounding moves no sample outside its ellipse."""
TINY = 1e-30
"""Least divisor for lengths that may be 0."""


class EmitterShapes(NamedTuple):
    """Candidates with exact densities: emitters of the environment map, and parallelograms.

    environment_index, parallelogram_index: index of each candidate in `environment` and in `parallelograms`, int64 `[M]`, -1 for
    other candidates. luminance: of each parallelogram, `[P]`.
    """

    environment: EnvironmentEmitters | None
    environment_index: Tensor
    parallelograms: ParallelogramEmitters | None
    parallelogram_index: Tensor
    luminance: Tensor

    def in_core(self, extension: ModuleType) -> tuple[object | None, object | None]:
        """The emitters of the map and the parallelograms in the native core, None for none."""
        environment = None if self.environment is None else self.environment.in_core(extension)
        return environment, None if self.parallelograms is None else self.parallelograms.in_core(extension, self.luminance)


class StripClip(NamedTuple):
    """The strips of M ellipses from which samples are drawn: the parts between two tangents of the lens circle.

    The tangents are perpendicular to the line from the lens centre to the ellipse's centre. In the coordinates of the fields, the
    ellipse is the unit disc.

    axis: unit vector across the strip, `[2, M]`. low, high: ends of the strip along the axis, `[M]`; without clipping, they are
    below -1 and above 1. below, share: fractions of the disc before the strip and inside the strip, `[M]`.
    """

    axis: Tensor
    low: Tensor
    high: Tensor
    below: Tensor
    share: Tensor


class Ellipses(NamedTuple):
    """M ellipses on the lens plane: images of the unit disc under x -> center + (width x₀, tilt x₀ + height x₁).

    center: `[2, M]`; width, tilt, height: `[M]`, metres; clip: the sampled strips.
    """

    center: Tensor
    width: Tensor
    tilt: Tensor
    height: Tensor
    clip: StripClip


class EllipseMixture(LensMixture):
    """A mixture of constant densities on ellipses: the outlines of ellipsoids seen from x_F, clipped to the lens by `StripClip`.

    Candidates in `shapes` have exact densities instead (`models/emitters/`).
    The weight of an ellipse is luminance · area · √(share inside the lens · share of the strip), which minimises the variance of
    the estimate. The weight of another shape is the flux through the lens.

    mean: centres of the ellipsoids, `[3, M]`, metres, camera frame. No ellipsoid may be in focus. outline: squared half axes of
    the ellipsoids, `[6, M]`, as returned by `packed`. weight: luminance · area on the lens / π of the whole ellipse, `[M]`.
    learned_scale: learned factor of each weight, `[M]`. clip_to_lens: whether ellipses are clipped.
    For the other arguments, see `GaussianMixture`.
    """

    def __init__(
        self,
        lens: Lens,
        focus: Tensor,
        beta: Tensor,
        start: Tensor,
        mean: Tensor,
        outline: Tensor,
        weight: Tensor,
        learned_scale: Tensor,
        shapes: EmitterShapes | None = None,
        clip_to_lens: bool = True,
    ):
        super().__init__(lens, focus, start, len(weight))
        radius = to_device(lens.radius, focus.device, torch.float32)
        self.ellipses, contribution = _ellipses(mean, outline, focus.index_select(1, self.owner), weight, radius, clip_to_lens)
        self._shaped: list[ViewedEnvironment | ViewedParallelograms] = []
        """Groups of candidates with exact densities. Each group samples and evaluates its candidates."""
        if shapes is not None and shapes.environment is not None:
            self._add_environment(shapes.environment, shapes.environment_index, weight, contribution, radius)
        if shapes is not None and shapes.parallelograms is not None:
            self._add_parallelograms(shapes.parallelograms, shapes.parallelogram_index, shapes.luminance, contribution, radius)
        self.expected_contribution = contribution
        """Root mean square of the contribution of an unoccluded draw, `[M]`: the weight before `learned_scale`."""
        self._set_weights(beta, contribution * learned_scale)

    def _add_environment(
        self, emitters: EnvironmentEmitters, number: Tensor, weight: Tensor, contribution: Tensor, radius: Tensor
    ) -> None:
        """Give emitters of the map exact densities, and set their contributions `[M]` to the flux through the lens."""
        inside, whole = _inside_lens(self.ellipses, radius)
        viewed = ViewedEnvironment(emitters, number, self.owner, self.focus, whole > 0.0)
        share = torch.minimum(viewed.entries.select(inside), viewed.share)
        viewed.entries.scatter(contribution, viewed.entries.select(weight) * share)
        self._shaped.append(viewed)

    def _add_parallelograms(
        self, emitters: ParallelogramEmitters, number: Tensor, luminance: Tensor, contribution: Tensor, radius: Tensor
    ) -> None:
        """Give parallelograms exact densities, and set their contributions `[M]` from the area that they cover on the lens."""
        viewed = ViewedParallelograms(emitters, number, self.owner, self.focus, radius)
        luminance = luminance.index_select(0, viewed.entries.select(number).clamp(min=0))
        viewed.entries.scatter(contribution, luminance * viewed.area / math.pi)
        self._shaped.append(viewed)

    def sample(self, uniforms: Tensor) -> LensSample:
        """One lens point for each pixel, from uniform numbers `[3, N]`; reports candidates.

        The first number chooses the candidate, and the other numbers choose the point. Stratified numbers give stratified points
        on every candidate and on the aperture.
        """
        points, guided = self.lens.sample(uniforms[1:3]), uniforms[0] < self.beta
        candidate = self.choose(uniforms[0] / self.beta)
        entries = ActiveEntries(guided)
        entries.scatter(points, self._sample_candidates(entries.select(candidate), entries.select(uniforms[1:3])))
        return LensSample(points, torch.where(guided, candidate, -1))

    def _sample_candidates(self, candidate: Tensor, uniforms: Tensor) -> Tensor:
        """Lens points `[2, K]` of candidates int64 `[K]`, from uniform numbers `[2, K]`."""
        points = _sample_ellipses(self.ellipses, candidate, uniforms)
        for viewed in self._shaped:
            place_of = torch.full_like(self.owner, -1)  # place of each of the M candidates in this group
            viewed.entries.scatter(place_of, torch.arange(len(viewed.entries), device=place_of.device))
            place = place_of.index_select(0, candidate)
            own = ActiveEntries(place >= 0)
            own.scatter(points, viewed.sample(own.select(place).clamp(min=0), own.select(uniforms)))
        return points

    def component_pdf(self, points: Tensor) -> Tensor:
        density = _ellipse_pdf(points, self.owner, self.ellipses)
        for viewed in self._shaped:
            viewed.entries.scatter(density, viewed.pdf(points))
        return density


def _ellipses(
    mean: Tensor, outline: Tensor, focus: Tensor, weight: Tensor, lens_radius: Tensor, clip_to_lens: bool
) -> tuple[Ellipses, Tensor]:
    """Outlines of ellipsoids on the lens, seen from x_F; and the weights times √(share inside the lens · share of the strip).

    S is the matrix of squared half axes, and e = mean - x_F. A plane through x_F with the normal n touches the ellipsoid if
    nᵀ (e eᵀ - S) n = 0. The matrix e eᵀ - S is the dual conic of the outline. Let (x, y) = -e_xy / e_z, and divide S by e_z².
    The outline is an ellipse with the centre x_F + d_F (x + S_xz, y + S_yz) / (1 - S_zz). The matrix of its squared half axes is
    d_F² / (1 - S_zz)² times the matrix M in the code.
    """
    gap = focus[2] - mean[2]
    x, y = (mean[0:2] - focus[0:2]) / gap
    xx, xy, xz, yy, yz, zz = outline / (gap * gap)
    shortened = (MAX_SQUARED_DEPTH / zz.clamp(min=TINY)).sqrt().clamp(max=1.0)
    xz, yz, zz = shortened * xz, shortened * yz, shortened * shortened * zz
    scale = focus[2] / (1.0 - zz)
    center = project_to_lens(mean, focus) + scale * torch.stack((xz + x * zz, yz + y * zz))
    m_xx = xx + x * (2.0 * xz + x * zz) - (xx * zz - xz * xz)
    m_xy = xy + y * xz + x * yz + x * y * zz - (xy * zz - xz * yz)
    m_yy = yy + y * (2.0 * yz + y * zz) - (yy * zz - yz * yz)
    # The Cholesky factor of M: columns (width, tilt) and (0, height).
    width = m_xx.clamp(min=1e-37).sqrt()
    tilt = m_xy / width
    height = (m_yy - tilt * tilt).clamp(min=MIN_SQUARED_ASPECT * m_yy).sqrt()
    width, tilt, height = scale * width, scale * tilt, scale * height
    clip = _strip_clip(center, width, tilt, height, lens_radius) if clip_to_lens else _no_clip(width)
    seen = (overlap(center, width, tilt, height, lens_radius) * clip.share).sqrt()
    return Ellipses(center, width, tilt, height, clip), weight * seen


def _strip_clip(center: Tensor, width: Tensor, tilt: Tensor, height: Tensor, lens_radius: Tensor) -> StripClip:
    """Strips of ellipses between tangents of the lens circle, widened by LENS_MARGIN and MIN_CLIP_END."""
    distance, across, up = _towards_center(center, width, tilt, height, lens_radius)
    reach = (across * across + up * up).sqrt().clamp(min=TINY)
    low, high = (-LENS_MARGIN * lens_radius - distance) / reach, (LENS_MARGIN * lens_radius - distance) / reach
    high = high.clamp(min=MIN_CLIP_END)
    below = _disc_cdf(low)
    share = (_disc_cdf(high) - below).clamp(min=MIN_STRIP_SHARE)
    return StripClip(torch.stack((across, up)) / reach, low, high, below, share)


def _no_clip(like: Tensor) -> StripClip:
    """Strips that contain the whole ellipse, with the shape and device of `like`, `[M]`."""
    none, one = torch.zeros_like(like), torch.ones_like(like)
    return StripClip(torch.stack((one, none)), -2.0 * one, 2.0 * one, none, one)


def _towards_center(
    center: Tensor, width: Tensor, tilt: Tensor, height: Tensor, lens_radius: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Distances `[M]` of ellipse centres from the lens centre, and the two components `[M]` of Lᵀu.

    u is the unit vector from the lens centre towards the ellipse's centre. L maps the unit disc to the ellipse. Lᵀu is the axis
    of the strip in coordinates of the disc, and |Lᵀu| is the half extent of the ellipse along u.
    """
    distance = center.square().sum(0).sqrt()
    centred = distance < 1e-6 * lens_radius  # u is arbitrary: (1, 0)
    x, y = center / torch.where(centred, 1.0, distance)
    x = torch.where(centred, 1.0, x)
    return distance, width * x + tilt * y, height * y


def overlap(center: Tensor, width: Tensor, tilt: Tensor, height: Tensor, lens_radius: Tensor) -> Tensor:
    """Approximate share `[M]` of ellipses (see `Ellipses`) inside the lens circle; 0 where nothing is inside.

    The approximation is the share along the line through both centres. If the ellipse is larger than the lens, a ratio of areas
    is a further factor.
    """
    distance, across, up = _towards_center(center, width, tilt, height, lens_radius)
    reach = (across * across + up * up).sqrt().clamp(min=TINY)
    inside = ((lens_radius + reach - distance) / (2.0 * torch.minimum(reach, lens_radius))).clamp(0.0, 1.0)
    return inside * (lens_radius * lens_radius / (width * height)).clamp(max=1.0)


def _disc_cdf(x: Tensor) -> Tensor:
    """Share of the unit disc with a first coordinate below x, `[M]`: (acos(-x) + x √(1 - x²)) / π."""
    x = x.clamp(-1.0, 1.0)
    return (torch.acos(-x) + x * (1.0 - x * x).sqrt()) / math.pi


def _disc_quantile(share: Tensor) -> Tensor:
    """The inverse of `_disc_cdf`: x = ∓cos θ with θ - sin θ cos θ = π · share, by Newton's method.

    The initial value is the series θ = t + t³ / 15 with t = ∛(3π/2 · share), where share is the smaller one of both sides.
    """
    half = torch.minimum(share, 1.0 - share).clamp(min=0.0)
    angle = ((1.5 * math.pi * half).clamp(min=TINY).log() / 3.0).exp()  # the last bits of `pow` depend on the place in an array
    angle = angle + angle * angle * angle / 15.0
    for _ in range(3):
        sine = angle.sin()
        angle = angle - 0.5 * (angle - sine * angle.cos() - math.pi * half) / (sine * sine).clamp(min=1e-12)
    return torch.where(share < 0.5, -angle.cos(), angle.cos())


def _inside_lens(ellipses: Ellipses, lens_radius: Tensor) -> tuple[Tensor, Tensor]:
    """`overlap` of the ellipses; and 1 if the whole ellipse is inside the lens circle, else 0; `[M]` each."""
    center, width, tilt, height, _ = ellipses
    m_xx, m_xy, m_yy = width * width, width * tilt, tilt * tilt + height * height
    long_axis = (0.5 * (m_xx + m_yy) + (0.25 * (m_xx - m_yy).square() + m_xy * m_xy).sqrt()).sqrt()
    whole = (center.square().sum(0).sqrt() + long_axis < lens_radius) + torch.zeros_like(width)
    return overlap(center, width, tilt, height, lens_radius), whole


def _sample_ellipses(ellipses: Ellipses, candidate: Tensor, uniforms: Tensor) -> Tensor:
    """Points `[2, K]` of constant density in the strips of the ellipses `candidate` `[K]`, from uniform numbers `[2, K]`."""
    center, width, tilt, height = (part.index_select(-1, candidate) for part in ellipses[:-1])
    clip = StripClip(*(part.index_select(-1, candidate) for part in ellipses.clip))
    # A whole disc in polar coordinates; a strip by its coordinate along the axis, then uniformly on the chord.
    radius, angle = INSIDE * uniforms[0].sqrt(), 2.0 * math.pi * uniforms[1]
    along = _disc_quantile(clip.below + uniforms[0] * clip.share)
    across = INSIDE * (1.0 - along * along).clamp(min=0.0).sqrt() * (2.0 * uniforms[1] - 1.0)
    whole = (clip.low <= -1.0) & (clip.high >= 1.0)
    x = torch.where(whole, radius * angle.cos(), clip.axis[0] * along - clip.axis[1] * across)
    y = torch.where(whole, radius * angle.sin(), clip.axis[1] * along + clip.axis[0] * across)
    return center + torch.stack((width * x, tilt * x + height * y))


def _ellipse_pdf(points: Tensor, owner: Tensor, ellipses: Ellipses) -> Tensor:
    """Densities of the ellipses at their owners' lens points `[2, N]`, `[M]`."""
    center, width, tilt, height, clip = ellipses
    x, y = points.index_select(1, owner) - center
    x = x / width
    y = (y - tilt * x) / height
    along = clip.axis[0] * x + clip.axis[1] * y
    inside = (x * x + y * y <= 1.0) & (along >= clip.low) & (along <= clip.high)
    return inside / (math.pi * width * height * clip.share)


def packed(outline: Tensor) -> Tensor:
    """The six entries xx, xy, xz, yy, yz, zz of symmetric matrices `[M, 3, 3]`, `[6, M]`."""
    rows, columns = torch.triu_indices(3, 3, device=outline.device)
    return outline[:, rows, columns].T.contiguous()


def balls(radius: Tensor) -> Tensor:
    """Packed squared half axes `[6, M]` of balls of radius `[M]`."""
    squared, none = radius * radius, torch.zeros_like(radius)
    return torch.stack((squared, none, none, squared, none, squared))


def outline_areas(outline: Tensor, mean: Tensor) -> Tensor:
    """Areas over π `[M]` of the outlines of ellipsoids, seen from the lens centre, on planes parallel to the lens through `mean`.

    outline: packed squared half axes, `[6, M]`. mean: centres in front of the lens, `[3, M]`. Lines of sight count as parallel.
    The fourth powers of lengths need double precision.
    """
    x, y = (mean[:2] / mean[2]).double()
    xx, xy, xz, yy, yz, zz = outline.double()
    along_x, along_y = xx - 2.0 * x * xz + x * x * zz, yy - 2.0 * y * yz + y * y * zz
    across = xy - x * yz - y * xz + x * y * zz
    return (along_x * along_y - across * across).clamp(min=0.0).sqrt().to(outline.dtype)
