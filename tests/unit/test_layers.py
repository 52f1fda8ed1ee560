"""Imports point one way: a layer imports only from itself and from layers below it."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.support.paths import REPOSITORY

LAYERS = (
    ("errors", "lazy_names", "limits", "color", "stopping"),
    ("memory",),
    ("image",),
    ("metrics",),
    ("scene",),
    ("export",),
    ("runtime",),
    ("render",),
    ("models",),
    ("guiding",),
    ("baselines",),
    ("train",),
    ("mitsuba",),
    ("evaluation",),
    ("picture",),
    ("view",),
    ("cli",),
)
HEIGHT = {name: height for height, names in enumerate(LAYERS) for name in names}
PACKAGE = REPOSITORY / "bokehguide"
FORBIDDEN = {"models": {"scene"}}
"""Layers below that a layer has to do without: models know the lens, and never the scene."""


def imported(path: Path) -> set[str]:
    """Layers that a module imports at run time; imports for type checkers alone do not count."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            node.body = []
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
        found |= {name.split(".")[1] for name in names if name.startswith("bokehguide.")}
    return found


@pytest.mark.parametrize("layer", HEIGHT)
def test_a_layer_imports_from_below_alone(layer):
    files = [PACKAGE / f"{layer}.py"] if (PACKAGE / f"{layer}.py").exists() else sorted((PACKAGE / layer).rglob("*.py"))
    assert files
    for path in files:
        for other in imported(path):
            allowed = HEIGHT[other] < HEIGHT[layer] or other == layer
            assert allowed and other not in FORBIDDEN.get(layer, ()), f"{path.relative_to(REPOSITORY)} imports {other}"


def test_every_part_of_the_package_is_in_a_layer():
    parts = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert parts - {"__init__", "__main__"} == set(HEIGHT)


def test_render_knows_no_guiding():
    for path in sorted((PACKAGE / "render").rglob("*.py")):
        assert "guid" not in path.read_text().lower().replace("bokehguide", ""), path.name
