"""`import bokehguide.mitsuba` without a Mitsuba that works."""

import importlib
import sys
from types import ModuleType

import pytest

from bokehguide.errors import BokehguideError


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    """The package is imported anew in each test."""
    for name in [name for name in sys.modules if name.startswith("bokehguide.mitsuba")]:
        monkeypatch.delitem(sys.modules, name)


def test_a_missing_mitsuba(monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(BokehguideError, match=r"Mitsuba is missing; run pip install 'bokehguide\[mitsuba\]'"):
        importlib.import_module("bokehguide.mitsuba")


@pytest.mark.parametrize("version", ["3.8.1", "3.10.0", "4.0.0"])
def test_another_version(monkeypatch, version):
    module = ModuleType("mitsuba")
    module.__version__ = version
    monkeypatch.setitem(sys.modules, "mitsuba", module)
    with pytest.raises(BokehguideError, match=f"Mitsuba {version} is installed; install a version from 3.9 and before 3.10"):
        importlib.import_module("bokehguide.mitsuba")
