"""Distributions of lens points, and the modules that learn their parameters. This package does not depend on a scene."""

from bokehguide.models.base import LensDensity, LensDistribution, LensMixture, LensSample
from bokehguide.models.blend_weight import BlendWeightMap
from bokehguide.models.candidates import CandidateList, draw_candidates
from bokehguide.models.ellipse_mixture import EllipseMixture, EmitterShapes
from bokehguide.models.gaussian_field import GaussianField
from bokehguide.models.gaussian_mixture import GaussianMixture
from bokehguide.models.polynomial_offset import PolynomialOffset
from bokehguide.models.uniform import UniformLensDistribution

__all__ = [
    "BlendWeightMap",
    "CandidateList",
    "EllipseMixture",
    "EmitterShapes",
    "GaussianField",
    "GaussianMixture",
    "LensDensity",
    "LensDistribution",
    "LensMixture",
    "LensSample",
    "PolynomialOffset",
    "UniformLensDistribution",
    "draw_candidates",
]
