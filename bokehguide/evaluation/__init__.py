"""Errors of modes against references: long renders, runs, comparisons, tables.

Figures are in `curves_figure` and `crops_figure`, which take a second to import.
"""

from bokehguide.evaluation.comparison import Comparison, compare, summary
from bokehguide.evaluation.fingerprint import fingerprint
from bokehguide.evaluation.long_renders import LongRender, accumulate, render, warn_of_bad_samples, whole_step
from bokehguide.evaluation.references import Reference, given_reference, made_reference
from bokehguide.evaluation.regions import between_halves, errors, regions
from bokehguide.evaluation.tables import markdown, report
from bokehguide.runtime.bars import progress

__all__ = [
    "Comparison",
    "LongRender",
    "Reference",
    "accumulate",
    "between_halves",
    "compare",
    "errors",
    "fingerprint",
    "given_reference",
    "made_reference",
    "markdown",
    "progress",
    "regions",
    "render",
    "report",
    "summary",
    "warn_of_bad_samples",
    "whole_step",
]
