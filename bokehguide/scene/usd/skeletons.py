"""Skinned meshes in the pose of a time."""

from __future__ import annotations

from typing import Any

from bokehguide.scene.usd.libraries import Gf, Usd, UsdSkel
from bokehguide.scene.usd.stage import Stage

ANIMATED = ("translations", "rotations", "scales", "blendShapeWeights")


def pose(opened: Stage) -> None:
    """Deform all skinned meshes of a stage by their skeletons and blend shapes, in the session layer, which no file stores."""
    stage, time = opened.stage, opened.time
    prims = list(Usd.PrimRange(stage.GetPseudoRoot()))  # without the prims of instances, which may be too many
    moment = 0.0 if time.IsEarliestTime() else time.GetValue()
    stage.SetEditTarget(stage.GetEditTargetForLocalLayer(stage.GetSessionLayer()))
    for prim in prims:
        if prim.IsA(UsdSkel.Animation):
            opened.current = prim
            _hold(prim, moment)
    for prim in prims:
        if not prim.IsA(UsdSkel.Root):
            continue
        opened.current = prim
        if not prim.IsInstance() and not UsdSkel.BakeSkinning(Usd.PrimRange(prim), Gf.Interval(moment, moment)):
            opened.lose("skinned meshes that USD cannot deform: drawn in the pose of their points", str(prim.GetPath()))


def _hold(animation: Any, moment: float) -> None:
    """Give an animation a sample at a moment: the deformation looks at times with samples alone."""
    for name in ANIMATED:
        attribute = animation.GetAttribute(name)
        if attribute and attribute.GetNumTimeSamples() > 1:
            attribute.Set(attribute.Get(moment), moment)
