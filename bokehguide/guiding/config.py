"""Settings of the lens samplers that learn. Every default is a measured one: `scripts/ablations.py` sets these fields."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class HighlightConfig:
    """Which cells of a record are highlights, and which of them belong together (sections 4.2.2 and 4.2.3).

    radiance_threshold: least luminance of a highlight's cell, in units of the frame's mean.
    coc_threshold: least diameter of a highlight's circle of confusion, pixels.
    depth_gap: connected cells belong to two highlights where their sorted depths differ by more than this many cell widths.
    """

    radiance_threshold: float = 8.0
    coc_threshold: float = 4.0
    depth_gap: float = 8.0


@dataclass(frozen=True)
class GaussianConfig:
    """Settings of the paper's modes `lis`, `lis-b` and `lis-o`.

    blend: β at the start, in `lis` at all times (section 6.1).
    blend_rate, offset_rate: learning rates of the logit of β and of the polynomial coefficients (section 6.1).
    offset_degree: degree of the polynomials (Eq. 28).
    fits: number of fits before `lis-o` freezes its Gaussians, or the first later epoch that has any.
    sigma_scale: α of σ = α R_b (section 4.2.4).
    offset_slack: pixels this many σ beyond a frozen Gaussian's disc keep it as a candidate, as its mean may move.
    highlights: which cells are highlights.
    """

    blend: float = 0.8
    blend_rate: float = 0.1
    offset_rate: float = 0.01
    offset_degree: int = 2
    fits: int = 8
    sigma_scale: float = 0.5
    offset_slack: float = 2.0
    highlights: HighlightConfig = field(default_factory=HighlightConfig)


@dataclass(frozen=True)
class GuidedConfig:
    """Settings of the mode `guided`. A part that is switched off is left out of the estimator, which stays unbiased.

    Proposals from the scene's emitters:
    known_emitters: whether the field begins with the scene's emitters.
    emitter_scale: size of an emitter's proposal by that of the emitter. A smaller proposal leaves light to the uniform part.
    emitter_shapes: whether parallelograms and emitters of the map are drawn in their own shape, else as ellipses.
    ellipsoids: whether other emitters are ellipsoids, else balls.
    clip_to_lens: whether ellipses are drawn only near the lens.
    candidate_slack: pixels this many radii beyond an emitter's disc on the raster have the emitter as a candidate.

    Highlights found on the way:
    find_highlights: whether the record is searched for highlights.
    depth_layers: whether the record keeps highlights at different depths apart.
    virtual_images: whether light from mirrors and glass is recorded at its virtual image.
    highlight_axes: half axes of a found ellipsoid by the standard deviations of its light. An even disc has 2.
    highlights: which cells are highlights.

    Mixture:
    learn_success_rates: whether proposals are weighted by the success rates of earlier draws.
    first_blend: β in the first epoch. min_blend, max_blend: bounds of β.
    blend_pool: pixels across the squares that share the moments from which β is learned.
    stratify: whether lens points are stratified over each epoch.

    Paths:
    split_count: paths after the primary hit of a sample of weight 1; others split in proportion to their weight.
    max_split_count: most paths of any sample.
    reuse_group: pixels along the longer and the shorter side of a group that reuses primary hits, powers of two.
    min_spread: least GGX α of a reused surface by the angle in radians between the views of a group.
    control_variate: whether the weights of reused samples are a control variate for the radiance.
    control_shrinkage: squared standard errors of a coefficient that halve it where they equal its square.

    Light samples at primary hits:
    learn_lights: whether clusters of lights are chosen by learned second moments.
    light_candidates: candidates of which one light sample is resampled.
    learn_visibility: whether candidates are weighted by the learned visibility of their cluster.
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
    reuse_group: tuple[int, int] = (4, 2)
    min_spread: float = 0.5
    control_variate: bool = True
    control_shrinkage: float = 64.0

    learn_lights: bool = True
    light_candidates: int = 2
    learn_visibility: bool = True
