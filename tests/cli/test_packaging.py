"""What is installed works on its own, away from the checkout."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

from bokehguide.scene import BUILTIN
from tests.support.paths import REPOSITORY

SOURCES = ("pyproject.toml", "README.md", "LICENSE")


def test_the_wheel_lists_the_scenes(tmp_path):
    source, target = tmp_path / "source", tmp_path / "target"
    shutil.copytree(REPOSITORY / "bokehguide", source / "bokehguide", ignore=shutil.ignore_patterns("__pycache__"))
    for name in SOURCES:
        shutil.copy(REPOSITORY / name, source)
    run("-m", "build", "--wheel", "--no-isolation", "--outdir", tmp_path, source, folder=tmp_path)
    (wheel,) = tmp_path.glob("*.whl")
    files = {str(path.relative_to(source)) for path in (source / "bokehguide").rglob("*") if path.is_file()}
    with zipfile.ZipFile(wheel) as archive:
        assert {name for name in archive.namelist() if not name.split("/")[0].endswith(".dist-info")} == files
    run("-m", "pip", "install", "--no-deps", "--no-index", "--target", target, wheel, folder=tmp_path)
    listed = run("-m", "bokehguide", "scenes", folder=tmp_path, PYTHONPATH=str(target))
    assert [line.split()[0] for line in listed.splitlines()] == list(BUILTIN)
    where = run("-c", "import bokehguide; print(bokehguide.__file__)", folder=tmp_path, PYTHONPATH=str(target))
    assert Path(where.strip()).is_relative_to(target)


def run(*arguments, folder, **environment) -> str:
    """What Python prints, away from this checkout."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [sys.executable, *map(str, arguments)]
    finished = subprocess.run(command, cwd=folder, env=kept | environment, capture_output=True, text=True, timeout=120)
    assert finished.returncode == 0, finished.stdout + finished.stderr
    return finished.stdout
