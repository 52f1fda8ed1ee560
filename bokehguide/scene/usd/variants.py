"""The variant sets of a stage, and the choice of variants."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bokehguide.errors import BokehguideError, printable
from bokehguide.scene.usd.libraries import Sdf


def variant_names(stage: Any) -> list[str]:
    """All variants of the prims of a stage, each as SET=NAME, sorted. Prims within instances do not count."""
    return sorted({f"{each}={name}" for _, each, names in _sets(stage) for name in names})


def select_variants(path: Path, stage: Any, text: str) -> None:
    """Select variants in all prims that have them. No file changes.

    path: of the stage, for errors. text: SET=NAME, or several of them with commas in between. A variant may belong to a prim that
    another variant adds. Raises BokehguideError for a variant that no prim has.
    """
    parts = [[word.strip() for word in part.partition("=")[::2]] for part in text.split(",")]
    wanted, done = dict(parts), set()
    while found := [(prim, each) for prim, each, names in _sets(stage) if wanted.get(each) in names and (prim, each) not in done]:
        with Sdf.ChangeBlock():
            for prim, each in found:
                Sdf.CreatePrimInLayer(stage.GetSessionLayer(), prim).variantSelections[each] = wanted[each]
        done.update(found)
    if len(parts) > len(wanted) or {each for _, each in done} != set(wanted):
        known = printable(", ".join(variant_names(stage)), 600) or "none"
        raise BokehguideError(f"{path}: {printable(text)!r} is no variant of this stage; give SET=NAME; it has {known}")


def _sets(stage: Any) -> list[tuple[Any, str, list[str]]]:
    """The path of each prim with a variant set, the name of the set, and the names of its variants."""
    found = []
    for prim in stage.TraverseAll():
        sets = prim.GetVariantSets() if prim.HasVariantSets() else None
        found += [(prim.GetPath(), name, sets.GetVariantSet(name).GetVariantNames()) for name in sets.GetNames()] if sets else []
    return found
