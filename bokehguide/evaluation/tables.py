"""Comparisons in Markdown."""

from __future__ import annotations

import math
from collections.abc import Sequence

from bokehguide.evaluation.comparison import Comparison, summary
from bokehguide.evaluation.references import Reference

WRONG = 4.0
"""Standard errors between a reference and uniform sampling that chance does not explain."""
OWN_ERROR_SHARE = 1 / 3
"""Largest share of the reference's own error in the error of a mode; it then adds about 5 % to the mode's error."""


def report(comparison: Comparison) -> str:
    """The comparison: quality of the reference, errors at the end, cost, and errors at equal cost."""
    film, facts = comparison.scene.film, summary(comparison)
    modes = facts["modes"]
    rays, seconds = (min(modes, key=lambda mode: modes[mode][cost]) for cost in ("rays", "seconds"))
    parts = [
        f"# {comparison.scene.name}, {film.width}x{film.height}, {comparison.settings.spp} SPP",
        " ".join((describe_reference(comparison.reference), *checks(comparison), *complaints(comparison))),
        errors_table(comparison),
        (
            f"In brackets: the ratio to {next(iter(modes))}. Equal rays: {facts['equal_rays'] / 1e6:.4g} million, the rays of "
            f"{rays}. Equal time: {facts['equal_seconds']:.4g} s, the time of {seconds}. Errors between two steps are "
            "interpolated in log-log; - means that the first step costs more. Seconds are those of the steps alone, without "
            "building the scene, measuring and writing."
        ),
        cost_table(comparison),
    ]
    return "\n\n".join(parts)


def describe_reference(reference: Reference) -> str:
    """File, mode, SPP and own error of a reference, in two sentences."""
    made = ", ".join(text for text in (reference.mode, reference.spp and f"{reference.spp} SPP") if text)
    start = f"Reference: {reference.path}" + (f" ({made})." if made else ".")
    known = [region for region in ("frame", "insets") if region in reference.halves]
    if not known:
        return f"{start} Its own error is unknown."
    apart = " and ".join(f"{reference.halves[region]['mape']:.4f} over the {region}" for region in known)
    own = " and ".join(f"{error:.4f}" for region in known if (error := reference.own_error(region)) is not None)
    return f"{start} MAPE between its two halves: {apart}. Its own error, about half of that, {own}, is part of all errors."


def checks(comparison: Comparison) -> list[str]:
    """A sentence on the ratio of the means of reference and uniform sampling, if uniform is among the modes."""
    pairs = [(name, comparison.over_uniform[name]) for name in ("frame", "insets") if name in comparison.over_uniform]
    if not pairs:
        return []
    ratios = " and ".join(f"{ratio.ratio:.4f} ± {ratio.standard_error:.4f} over the {name}" for name, ratio in pairs)
    wrong = any(abs(ratio.z) > WRONG for _, ratio in pairs)
    warning = f" This is more than {WRONG:g} standard errors from 1: one of the two is wrong." if wrong else ""
    return [f"Its mean luminance over that of uniform sampling: {ratios}.{warning}"]


def complaints(comparison: Comparison) -> list[str]:
    """A sentence for each region in which the reference's own error is too large for the measured modes, with the remedy."""
    found, reference = [], comparison.reference
    for region in ("frame", "insets"):
        own = reference.own_error(region)
        if own is None:
            continue
        errors = {mode: run.errors[region]["mape"][-1] for mode, run in comparison.runs.items()}
        errors = {mode: error for mode, error in errors.items() if error < own / OWN_ERROR_SHARE}
        if errors:
            named = ", ".join(f"{mode}, {error:.4f}" for mode, error in errors.items())
            told = f"The reference's own error over the {region}, {own:.4f}, is more than a third of the error of {named}"
            found.append(f"{told}; {_remedy(reference, own, min(errors.values()))}.")
    return found


def _remedy(reference: Reference, own: float, error: float) -> str:
    """The advice for a reference with the error `own`, which should be OWN_ERROR_SHARE of `error`. Errors fall with √SPP."""
    if reference.spp is None or error <= 0.0:
        return "give a reference with more SPP"
    spp = math.ceil(reference.spp * (own / (OWN_ERROR_SHARE * error)) ** 2)
    return f"render at least {spp:,} SPP, with --reference-spp {spp}"


def errors_table(comparison: Comparison) -> str:
    """MAPE over all regions and relMSE over frame and insets; in brackets the ratio to the first mode."""
    modes = summary(comparison)["modes"]
    regions = list(next(iter(modes.values()))["mape"])
    columns = [("mape", region) for region in regions] + [("relmse", region) for region in regions[:2]]
    names = {"mape": "MAPE", "relmse": "relMSE"}
    heads = ["mode", *(f"{names[measure]} {region.replace('-', ' ')}" for measure, region in columns)]
    first = next(iter(modes.values()))
    rows = [
        [mode, *(with_ratio(facts[measure][region], first[measure][region]) for measure, region in columns)]
        for mode, facts in modes.items()
    ]
    return markdown([heads, *rows])


def cost_table(comparison: Comparison) -> str:
    """Time, rays, and MAPE over frame and insets at equal rays and at equal time; in brackets the ratio to the first mode."""
    modes = summary(comparison)["modes"]
    regions = list(next(iter(modes.values()))["mape"])[:2]
    columns = [(budget, region) for budget in ("at_equal_rays", "at_equal_time") for region in regions]
    heads = [f"MAPE {region} {budget.replace('_', ' ')}" for budget, region in columns]
    first = next(iter(modes.values()))
    pixels = comparison.scene.film.width * comparison.scene.film.height
    rows = [["mode", "seconds", "million rays", "rays per sample", *heads]]
    for mode, facts in modes.items():
        costs = [f"{facts['seconds']:.4g}", f"{facts['rays'] / 1e6:.4g}", f"{facts['rays'] / pixels / facts['spp']:.2f}"]
        cells = [with_ratio(facts[at]["mape"][region], first[at]["mape"][region]) for at, region in columns]
        rows.append([mode, *costs, *cells])
    return markdown(rows)


def with_ratio(value: float | None, first: float | None) -> str:
    """An error and its ratio to that of the first mode; - without an error."""
    if value is None:
        return "-"
    return f"{value:.4f} ({value / first:.3f})" if first else f"{value:.4f}"


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table whose first row is the heading."""
    rule = ["---"] + ["---:"] * (len(rows[0]) - 1)
    return "\n".join("| " + " | ".join(row) + " |" for row in [rows[0], rule, *rows[1:]])
