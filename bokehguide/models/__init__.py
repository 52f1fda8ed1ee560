"""What is learnt of the lens: Gaussians in camera space, blend weights, offsets, and the distributions they make."""

from bokehguide.models.blend_weight import BlendWeightMap
from bokehguide.models.candidates import CandidateList, draw_candidates
from bokehguide.models.gaussian_field import GaussianField
from bokehguide.models.lens_distribution import GuidedLensDistribution, LensDensity, UniformLensDistribution
from bokehguide.models.polynomial_offset import PolynomialOffset

__all__ = [
    *("BlendWeightMap", "CandidateList", "GaussianField", "GuidedLensDistribution", "LensDensity"),
    *("PolynomialOffset", "UniformLensDistribution", "draw_candidates"),
]
