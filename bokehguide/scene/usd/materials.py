"""Materials of a stage as looks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from bokehguide.errors import printable
from bokehguide.scene.types import Material, Vector
from bokehguide.scene.usd.libraries import UsdGeom, UsdShade
from bokehguide.scene.usd.materialx_surfaces import SURFACES, MaterialXSurface
from bokehguide.scene.usd.networks import kind_of
from bokehguide.scene.usd.nodes import Nodes
from bokehguide.scene.usd.preview_surface import DEFAULT_GREY, DEFAULT_ROUGHNESS, PreviewSurface
from bokehguide.scene.usd.stage import Stage
from bokehguide.scene.usd.surface_inputs import DISPLAY_COLOR, WHITE, Look
from bokehguide.scene.usd.textures import Textures
from bokehguide.scene.vectors import fractions

PREVIEW = ("UsdPreviewSurface", "ND_UsdPreviewSurface_surfaceshader")
PURPOSES = ("full", "preview")
CONTEXTS = ("mtlx", "")
"""Render contexts of the surfaces of a material, the first choice first. The second one serves all renderers."""

DEFAULT = Look(Material("default", DEFAULT_GREY, roughness=DEFAULT_ROUGHNESS))
"""The look of a prim without a material and without a display colour."""
COLORED = Look(replace(DEFAULT.material, base_color=WHITE), colors=DISPLAY_COLOR)
"""The look of a prim without a material, whose display colours are vertex colours."""


class Looks:
    """The looks of a stage, each converted once."""

    def __init__(self, opened: Stage):
        self._opened = opened
        self.textures = Textures(opened)
        self._nodes = Nodes(opened, self.textures)
        self._known: dict[str, Look | None] = {}
        self._plain: dict[Vector, Look] = {}

    def of(self, prim: Any) -> Look | None:
        """The look of a prim or of a subset; None if no material that can be read is bound."""
        binding, named = UsdShade.MaterialBindingAPI(prim), ""
        for purpose in PURPOSES:
            material = binding.ComputeBoundMaterial(purpose)[0]
            if not material:
                continue
            named = str(material.GetPath())
            if named not in self._known:
                self._known[named] = self._look(material)
            if self._known[named] is not None:
                return self._known[named]
        if named:
            self._opened.lose("materials without a surface that is read: the display colour in their place", named)
        elif missing := _missing_target(prim):
            self._opened.lose("bindings to materials that the stage has not: the display colour in their place", missing)
        return None

    def of_color(self, prim: Any, constant: bool = False) -> Look:
        """The look of a prim without a material, by its display colour. constant: only a colour of the whole prim counts."""
        primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(DISPLAY_COLOR)
        values = primvar.ComputeFlattened(self._opened.time) if primvar and primvar.HasValue() else None
        if values is None or not len(values):
            return DEFAULT
        if len(values) > 1 and not constant:
            return COLORED
        color = fractions(np.nan_to_num(np.asarray(values[0], np.float64).reshape(3)))
        return self._plain.setdefault(color, Look(replace(DEFAULT.material, base_color=color)))

    def _look(self, material: Any) -> Look | None:
        """The look of a material, None without a surface that can be read."""
        name = printable(str(material.GetPrim().GetName()), 120)
        for context in CONTEXTS:
            shader = material.ComputeSurfaceSource(context)[0]
            kind = kind_of(shader) if shader else ""
            if kind in PREVIEW:
                return PreviewSurface(self._opened, shader, self.textures, self._nodes, name).look()
            if kind in SURFACES:
                if material.ComputeDisplacementSource(context)[0]:
                    self._opened.lose("displacement: left out", name)
                return MaterialXSurface(self._opened, shader, self.textures, self._nodes, name, SURFACES[kind]).look()
        return None


def _missing_target(prim: Any) -> str:
    """The path of a material that a prim or a prim above it binds, and that does not exist; empty for none."""
    while prim and not prim.IsPseudoRoot():
        path = UsdShade.MaterialBindingAPI(prim).GetDirectBinding().GetMaterialPath()
        if not path.isEmpty:
            return "" if prim.GetStage().GetPrimAtPath(path) else f"{prim.GetPath()}: {path}"
        prim = prim.GetParent()
    return ""
