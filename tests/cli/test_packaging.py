"""What is installed works on its own, away from the checkout."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from bokehguide.runtime.native import core
from bokehguide.scene import BUILTIN
from tests.support.paths import REPOSITORY

SOURCES = ("pyproject.toml", "README.md", "LICENSE")


HAS_CORE = "from bokehguide.runtime.native import core; print(core() is not None)"


def built(tmp_path: Path, compiler: dict[str, str]) -> tuple[Path, set[str], set[str]]:
    """The wheel, the files in it, and those of the package; compiler: variables of the environment."""
    source = tmp_path / "source"
    package = shutil.ignore_patterns("__pycache__", "*.so", "*.pyd")
    shutil.copytree(REPOSITORY / "bokehguide", source / "bokehguide", ignore=package)
    sources = shutil.ignore_patterns("CMakeFiles", "CMakeCache.txt", "CMakeInit.txt", "*.cmake", "*.ninja", "*.a", ".ninja*")
    shutil.copytree(REPOSITORY / "native", source / "native", ignore=sources)
    for name in SOURCES:
        shutil.copy(REPOSITORY / name, source)
    run("-m", "build", "--wheel", "--no-isolation", "--outdir", tmp_path, source, folder=tmp_path, **compiler)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        found = {name for name in archive.namelist() if not name.split("/")[0].endswith(".dist-info")}
    return wheel, found, {str(path.relative_to(source)) for path in (source / "bokehguide").rglob("*") if path.is_file()}


def test_without_a_compiler_the_wheel_lists_the_scenes(tmp_path):
    target = tmp_path / "target"
    wheel, found, files = built(tmp_path, {"CXX": str(tmp_path / "missing")})
    assert found == files
    assert wheel.name.endswith("-py3-none-any.whl")
    run("-m", "pip", "install", "--no-deps", "--no-index", "--target", target, wheel, folder=tmp_path)
    assert run("-c", HAS_CORE, folder=tmp_path, PYTHONPATH=str(target)).strip() == "False"
    listed = run("-m", "bokehguide", "scenes", folder=tmp_path, PYTHONPATH=str(target))
    assert [line.split()[0] for line in listed.splitlines()] == list(BUILTIN)
    where = run("-c", "import bokehguide; print(bokehguide.__file__)", folder=tmp_path, PYTHONPATH=str(target))
    assert Path(where.strip()).is_relative_to(target)


@pytest.mark.slow
@pytest.mark.skipif(core() is None, reason="the native core is not built, so that there may be no compiler")
def test_with_a_compiler_the_wheel_has_the_native_core(tmp_path):
    target = tmp_path / "target"
    wheel, found, files = built(tmp_path, {})
    assert len(found - files) == 1 and next(iter(found - files)).startswith("bokehguide/_native.")
    run("-m", "pip", "install", "--no-deps", "--no-index", "--target", target, wheel, folder=tmp_path)
    assert run("-c", HAS_CORE, folder=tmp_path, PYTHONPATH=str(target)).strip() == "True"


def run(*arguments, folder, **environment) -> str:
    """What Python prints, away from this checkout."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [sys.executable, *map(str, arguments)]
    finished = subprocess.run(command, cwd=folder, env=kept | environment, capture_output=True, text=True, timeout=600)
    assert finished.returncode == 0, finished.stdout + finished.stderr
    return finished.stdout
