"""Settings of the learning lens samplers. `scripts/ablations.py` measures the effect of most fields."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from bokehguide.limits import MAX_INT
from bokehguide.models.blend_weight import MAX_BLEND, MIN_BLEND
from bokehguide.scene.checks import Fields
from bokehguide.scene.tables import NOT_NEGATIVE, POSITIVE, Limits

COUNT = Limits("a whole number from 1 to 64", low=1, high=64)
GROUP = Limits("a power of two from 1 to 64", low=1, high=64)
"""Number of pixels of a group that reuses primary hits. The native core has tables for 64."""
BLEND = Limits("a number from 0.001 to 0.999; the uniform part keeps the estimator unbiased", low=1e-3, high=0.999)
GUIDED_LIMITS = {
    **dict.fromkeys(("blend_pool", "split_count", "max_split_count", "light_candidates"), COUNT),
    **dict.fromkeys(("reuse_group", "denoised_reuse_group"), GROUP),
    **dict.fromkeys(("first_blend", "min_blend", "max_blend"), BLEND),
    **dict.fromkeys(("emitter_scale", "highlight_axes"), POSITIVE),
    **dict.fromkeys(("candidate_slack", "min_spread", "control_shrinkage", "unshared_control_shrinkage"), NOT_NEGATIVE),
    "bsdf_candidates": Limits("a whole number from 0 to 64", low=0, high=64),
}
"""Limits of the numbers of `GuidedConfig`."""


def _checked(config: Any, **limits: Limits) -> Fields:
    """The fields. Raises FieldError for a field of another type than its default, or out of its limits.

    limits: of the numbers. Fields without a default value are instances of `HighlightConfig`.
    """
    checked = Fields(config)
    for each in fields(config):
        if isinstance(each.default, bool):
            checked.check_flags(each.name)
        elif isinstance(each.default, int):
            checked.check_wholes(**{each.name: limits[each.name]})
        elif isinstance(each.default, float):
            checked.check_numbers(**{each.name: limits[each.name]})
        else:
            checked.check_instances(HighlightConfig, each.name, optional=False)
    return checked


@dataclass(frozen=True)
class HighlightConfig:
    """Thresholds that find highlights in the record of primary hits (sections 4.2.2 and 4.2.3).

    radiance_threshold: least luminance of a highlight's cell, over the mean luminance of the frame.
    coc_threshold: least diameter of a highlight's circle of confusion, pixels.
    depth_gap: least gap, in cell widths, at which the sorted depths of connected cells are split into two highlights.

    Raises BokehguideError for a value out of range.
    """

    radiance_threshold: float = 8.0
    coc_threshold: float = 4.0
    depth_gap: float = 8.0

    def __post_init__(self) -> None:
        gap = Limits("cell widths of 0 or more, or inf for no split", low=0.0, infinity=True)
        _checked(self, radiance_threshold=NOT_NEGATIVE, coc_threshold=NOT_NEGATIVE, depth_gap=gap)


@dataclass(frozen=True)
class GaussianConfig:
    """Settings of the paper's modes `lis`, `lis-b` and `lis-o`.

    blend: initial β (section 6.1), from 0.05 to 0.95. In `lis`, β keeps this value.
    blend_rate, offset_rate: learning rates of the logit of β and of the polynomial coefficients (section 6.1).
    offset_degree: degree of the polynomials (Eq. 29).
    fits: number of fits before `lis-o` freezes the Gaussians, rounded up to a power of two. Without a Gaussian, `lis-o` waits
    until the end of a later epoch.
    sigma_scale: α of σ = α R_b (section 4.2.4).
    offset_slack: enlargement, in σ, of the disc of pixels that have a frozen Gaussian as a candidate. Offsets may move its mean.
    highlights: thresholds for highlights.

    Raises BokehguideError for a value out of range.
    """

    blend: float = 0.8
    blend_rate: float = 0.1
    offset_rate: float = 0.01
    offset_degree: int = 2
    fits: int = 8
    sigma_scale: float = 0.5
    offset_slack: float = 2.0
    highlights: HighlightConfig = field(default_factory=HighlightConfig)

    def __post_init__(self) -> None:
        rates = {"blend_rate": NOT_NEGATIVE, "offset_rate": NOT_NEGATIVE, "offset_slack": NOT_NEGATIVE}
        fits = Limits(f"a whole number from 1 to {MAX_INT}", low=1, high=MAX_INT)
        degree = Limits("a whole number from 0 to 4", low=0, high=4)
        blend = Limits("a number from 0.05 to 0.95", low=MIN_BLEND, high=MAX_BLEND)
        _checked(self, blend=blend, offset_degree=degree, fits=fits, sigma_scale=POSITIVE, **rates)


@dataclass(frozen=True)
class GuidedConfig:
    """Settings of the mode `guided`. The estimator is unbiased with any part switched off.

    Proposals from the scene's emitters:
    known_emitters: whether the field initially contains the scene's emitters.
    emitter_scale: size of an emitter's proposal over the size of the emitter. Below 1, the uniform part samples the rim.
    emitter_shapes: whether parallelograms and emitters of the map have exact densities, else ellipses.
    ellipsoids: whether ellipsoids approximate all other emitters, else balls.
    clip_to_lens: whether ellipses are clipped to a strip near the lens.
    candidate_slack: enlargement, in radii of the emitter, of the disc of pixels that have the emitter as a candidate.

    Highlights found during the render:
    find_highlights: whether the record of primary hits is searched for highlights.
    depth_layers: whether the record separates highlights at different depths in one cell.
    virtual_images: whether the record places light from mirrors and glass at its virtual image.
    highlight_axes: half axes of a highlight's ellipsoid over the standard deviations of its light. An even disc would need 2.
    highlights: thresholds for highlights.

    Mixture:
    learn_success_rates: whether the weights of proposals include the success rates of earlier draws.
    first_blend: β in the first epoch. min_blend, max_blend: bounds of β.
    blend_pool: side, in pixels, of the squares over which the moments for β are averaged.
    stratify: whether lens points are stratified over each epoch.

    Paths:
    split_count: number of paths after the primary hit of a sample of weight 1. The number is proportional to the weight.
    max_split_count: largest number of paths of a sample.
    reuse_group: number of pixels of a group that reuses primary hits, a power of two up to 64 (see `PixelGroups`).
    denoised_reuse_group: as `reuse_group`, in a render with a denoiser. A denoiser removes independent noise, and keeps noise
    that pixels share. `scripts/experiments/denoising.py` measures the effect.
    min_spread: least GGX α of a reused surface, over the angle in radians between two lens points of a group.
    control_variate: whether the weights of reused samples are a control variate for the radiance.
    control_shrinkage: factor of a coefficient's squared standard error. A coefficient whose square equals the product is halved.
    unshared_control_shrinkage: as `control_shrinkage`, in groups of one pixel. A small factor increases the error there.

    Light samples at primary hits:
    learn_lights: whether learned second moments determine the probabilities of clusters of lights.
    light_candidates, bsdf_candidates: numbers of light samples and of BSDF samples from which resampling keeps one. Without an
    environment map, and in scenes with emissive triangles, light samples take the place of the BSDF samples.
    learn_visibility: whether the resampling weights include the learned visibility of the cluster.
    learn_mis: whether a factor of the MIS weights of light samples is learned.

    Raises BokehguideError for a value out of range.
    """

    known_emitters: bool = True
    emitter_scale: float = 1.005
    emitter_shapes: bool = True
    ellipsoids: bool = True
    clip_to_lens: bool = True
    candidate_slack: float = 0.1

    find_highlights: bool = True
    depth_layers: bool = True
    virtual_images: bool = True
    highlight_axes: float = 2.4
    highlights: HighlightConfig = field(default_factory=HighlightConfig)

    learn_success_rates: bool = True
    first_blend: float = 0.65
    min_blend: float = 0.05
    max_blend: float = 0.9
    blend_pool: int = 5
    stratify: bool = True

    split_count: int = 2
    max_split_count: int = 16
    reuse_group: int = 16
    denoised_reuse_group: int = 1
    min_spread: float = 0.2
    control_variate: bool = True
    control_shrinkage: float = 1.0
    unshared_control_shrinkage: float = 64.0

    learn_lights: bool = True
    light_candidates: int = 4
    bsdf_candidates: int = 1
    learn_visibility: bool = True
    learn_mis: bool = True

    def __post_init__(self) -> None:
        checked = _checked(self, **GUIDED_LIMITS)
        for name in ("reuse_group", "denoised_reuse_group"):
            if getattr(self, name).bit_count() > 1:
                checked.fail(name, f"is out of range; give {GROUP.remedy}")
        if not self.blend_pool % 2:
            checked.fail("blend_pool", "is even; give the odd side of a square around the pixel")
        if self.min_blend > self.max_blend:
            checked.fail("min_blend", f"is above max_blend, {self.max_blend:g}; give a smaller number")
