"""The prims of a stage that are drawn, each with its matrices in world space."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from bokehguide.errors import BokehguideError, printable
from bokehguide.scene.usd.libraries import Usd, UsdGeom, UsdLux
from bokehguide.scene.usd.stage import Stage

MAX_LEVELS = 8
"""Point instancers within prototypes of point instancers."""
MAX_GROUPS = 8
"""Names above a prim that are kept."""
DRAWN = ("default", "render")


@dataclass(frozen=True)
class Placed:
    """A prim, and the matrices `[N, 4, 4]` from its space to world space, one for each instance."""

    prim: Any
    matrices: np.ndarray

    @property
    def name(self) -> str:
        """The name of the prim."""
        return printable(self.prim.GetName(), 120)

    @property
    def groups(self) -> tuple[str, ...]:
        """The names above the prim, nearest first."""
        names = [printable(part, 120) for part in str(self.prim.GetPath()).split("/")[-2:0:-1]]
        return tuple(names[:MAX_GROUPS])


def drawn_prims(opened: Stage) -> Iterator[Placed]:
    """All active, visible prims of a stage, also those of instances, in the order of the tree.

    Raises BokehguideError for more instances than the files allow.
    """
    walk = _Walk(opened, UsdGeom.XformCache(opened.time))
    yield from walk.tree(opened.stage.GetPseudoRoot(), opened.world[None], 0)


class _Walk:
    """A walk over the prims of a stage. cache: of world matrices."""

    def __init__(self, opened: Stage, cache: Any):
        self._opened, self._cache, self._count = opened, cache, 0

    def tree(self, root: Any, base: np.ndarray, level: int) -> Iterator[Placed]:
        """The prims at and below `root`. base: matrices `[N, 4, 4]` from the space of `root` to world space."""
        predicate = Usd.PrimIsActive & Usd.PrimIsLoaded & Usd.PrimIsDefined
        if level == 0:
            predicate &= ~Usd.PrimIsAbstract
        prims = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies(predicate)))
        for prim in prims:
            self._opened.current = prim
            self._add(prim, len(base) if level and prim == root else 1)
            if not prim.IsA(UsdGeom.Imageable):
                continue
            if prim.GetAttribute("visibility").Get(self._opened.time) == UsdGeom.Tokens.invisible:
                prims.PruneChildren()
                continue
            is_instancer = prim.IsA(UsdGeom.PointInstancer)
            if is_instancer:
                prims.PruneChildren()
            elif not (prim.IsA(UsdGeom.Gprim) or prim.IsA(UsdGeom.Camera) or prim.HasAPI(UsdLux.LightAPI)):
                continue
            if UsdGeom.Imageable(prim).ComputePurpose() in DRAWN:
                placed = Placed(prim, base @ self._matrix(prim, root, level))
                yield from self._instances(placed, level) if is_instancer else (placed,)

    def _add(self, prim: Any, count: int) -> None:
        """Count prims and instances."""
        self._count += count
        if self._count > self._opened.files.most_instances:
            most = f"{self._opened.files.most_instances:,}"
            raise BokehguideError(f"{self._opened.place(prim)}: makes more than {most} instances in all; give fewer")

    def _matrix(self, prim: Any, root: Any, level: int) -> np.ndarray:
        """The matrix from the space of a prim to that of `root`."""
        if level == 0:
            return np.array(self._cache.GetLocalToWorldTransform(prim)).T
        return np.array(self._cache.ComputeRelativeTransform(prim, root)[0]).T

    def _instances(self, placed: Placed, level: int) -> Iterator[Placed]:
        """The prims of all instances of a point instancer."""
        opened, prim, instancer = self._opened, placed.prim, UsdGeom.PointInstancer(placed.prim)
        if level >= MAX_LEVELS:
            opened.fail(prim, f"has more than {MAX_LEVELS} point instancers within each other; give fewer")
        indices = np.asarray(instancer.GetProtoIndicesAttr().Get(opened.time) or (), np.int64)
        self._add(prim, len(indices) * len(placed.matrices))
        targets = instancer.GetPrototypesRel().GetForwardedTargets()
        if len(indices) and not (indices.min() >= 0 and indices.max() < len(targets)):
            opened.fail(prim, f"protoIndices lead out of the {len(targets)} prototypes; repair the file")
        transforms = instancer.ComputeInstanceTransformsAtTime(
            opened.time, opened.time, UsdGeom.PointInstancer.IncludeProtoXform, UsdGeom.PointInstancer.IgnoreMask
        )
        if len(transforms) != len(indices):
            opened.fail(prim, f"has {len(indices)} protoIndices, and no position for each of them; repair the file")
        if not len(indices):
            return
        local = np.asarray(transforms).reshape(-1, 4, 4).transpose(0, 2, 1)
        kept = np.asarray(instancer.ComputeMaskAtTime(opened.time) or np.ones(len(indices)), bool)
        for number, target in enumerate(targets):
            chosen = local[(indices == number) & kept]
            root = opened.stage.GetPrimAtPath(target)
            if len(chosen) and root:
                matrices = (placed.matrices[:, None] @ chosen[None]).reshape(-1, 4, 4)
                yield from self.tree(root, matrices, level + 1)
