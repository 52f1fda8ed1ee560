"""The notebook of the documentation runs: its cells in this process, and in a kernel as in Jupyter."""

from __future__ import annotations

import ast
import json
import warnings

import pytest

import bokehguide
import bokehguide.picture
from tests.support.paths import REPOSITORY

PATH = REPOSITORY / "docs/tutorials/notebook.ipynb"
NOTEBOOK = json.loads(PATH.read_text(encoding="utf-8"))
CODE = [cell for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]


@pytest.mark.slow
def test_the_cells_run(tmp_path, monkeypatch, capsys):
    """With one sample for each of a few pixels; the last expression of a cell is shown, as a notebook does."""
    monkeypatch.chdir(tmp_path)
    render = bokehguide.picture.render
    monkeypatch.setattr(
        bokehguide.picture, "render", lambda scene, **options: render(scene, **{**options, "spp": 1, "size": (32, 18)})
    )
    names: dict[str, object] = {"__name__": "__main__"}
    shown = []
    for number, cell in enumerate(CODE):
        body = ast.parse("".join(cell["source"])).body
        last = body.pop() if isinstance(body[-1], ast.Expr) else None
        exec(compile(ast.Module(body, []), f"cell {number}", "exec"), names)
        if last is not None:
            shown.append(eval(compile(ast.Expression(last.value), f"cell {number}", "eval"), names))
    pictures = [value for value in shown if isinstance(value, bokehguide.Picture)]
    assert len(pictures) == 4 and all(picture._repr_png_().startswith(b"\x89PNG") for picture in pictures)
    assert "Camera.focus_distance: -1 is out of range" in capsys.readouterr().out
    assert {path.name for path in tmp_path.iterdir()} == {"far.exr", "far.png"}


def test_the_notebook_holds_no_output():
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in CODE)
    assert PATH.stat().st_size < 20_000


@pytest.mark.slow
def test_the_notebook_runs_in_a_kernel(tmp_path):
    """As Jupyter does: pictures arrive as PNG, and the cell that provokes an error prints one line."""
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    import nbformat

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of zmq and asyncio
        notebook = nbformat.read(PATH, as_version=4)
        client = nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}})
        client.execute()
    pictures = [output for cell in notebook.cells for output in cell.get("outputs", []) if "image/png" in output.get("data", {})]
    assert len(pictures) == 4
    assert (tmp_path / "far.exr").exists()
