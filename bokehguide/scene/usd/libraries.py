"""The modules of USD, imported at their first use: they take a while, and only USD files need them."""

from __future__ import annotations

from importlib import import_module
from typing import Any


class _Module:
    """A module of the package `pxr`, whose names have no types."""

    def __init__(self, name: str):
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(f"pxr.{self._name}"), name)


Ar, Gf, Sdf, Tf, Usd, UsdGeom = map(_Module, ("Ar", "Gf", "Sdf", "Tf", "Usd", "UsdGeom"))
UsdLux, UsdRender, UsdShade, UsdSkel, UsdUtils = map(_Module, ("UsdLux", "UsdRender", "UsdShade", "UsdSkel", "UsdUtils"))
