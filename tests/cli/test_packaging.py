"""Wheels and source distributions work on their own, away from the checkout."""

import os
import re
import shutil
import site
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from bokehguide.scene import BUILTIN
from tests.support.paths import REPOSITORY

FILES = ("pyproject.toml", "README.md", "LICENSE")
BUILT = ("*.so", "*.pyd", "*.a", "*.cmake", "*.ninja", ".ninja*", ".skbuild*", "CMakeFiles", "CMakeCache.txt", "CMakeInit.txt")
"""Files that builds of the native core leave in a checkout."""
HAS_CORE = "from bokehguide.runtime.native import core; print(core() is not None)"
needs_compiler = pytest.mark.skipif(not any(map(shutil.which, ("c++", "g++", "clang++"))), reason="there is no C++ compiler")


def copied_source(folder: Path) -> Path:
    """The sources of the package in a new folder, without anything that was built."""
    folder.mkdir()
    for name in ("bokehguide", "native"):
        shutil.copytree(REPOSITORY / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", *BUILT))
    for name in FILES:
        shutil.copy(REPOSITORY / name, folder)
    return folder


def built(kind: str, source: Path, folder: Path, **environment: str) -> Path:
    """The one distribution of a kind, wheel or sdist, that is made of the source."""
    run("-m", "build", f"--{kind}", "--no-isolation", "--outdir", folder, source, folder=folder, **environment)
    (made,) = folder.glob("*.whl" if kind == "wheel" else "*.tar.gz")
    return made


def packaged(wheel: Path) -> set[str]:
    """The files of a wheel, without its metadata."""
    with zipfile.ZipFile(wheel) as archive:
        return {name for name in archive.namelist() if not name.split("/")[0].endswith(".dist-info")}


def package_files(source: Path) -> set[str]:
    return {path.relative_to(source).as_posix() for path in (source / "bokehguide").rglob("*") if path.is_file()}


def install(wheel: Path, target: Path) -> Path:
    run("-m", "pip", "install", "--no-deps", "--no-index", "--target", target, wheel, folder=wheel.parent)
    return target


def test_without_a_compiler_the_wheel_renders_with_pytorch(tmp_path):
    source = copied_source(tmp_path / "source")
    wheel = built("wheel", source, tmp_path, PATH=str(Path(sys.executable).parent), CXX="", CC="")
    assert wheel.name.endswith("-py3-none-any.whl")
    assert packaged(wheel) == package_files(source)
    target = install(wheel, tmp_path / "target")
    assert run_installed("-c", HAS_CORE, target=target).strip() == "False"
    listed = run_installed("-m", "bokehguide", "scenes", target=target)
    assert [line.split()[0] for line in listed.splitlines()] == list(BUILTIN)
    where = run_installed("-c", "import bokehguide; print(bokehguide.__file__)", target=target)
    assert Path(where.strip()).is_relative_to(tmp_path)


@pytest.mark.slow
@needs_compiler
def test_with_a_compiler_the_source_distribution_makes_a_wheel_with_the_native_core(tmp_path):
    source = copied_source(tmp_path / "source")
    (source / "bokehguide" / "_native.stale.so").touch()
    with tarfile.open(built("sdist", source, tmp_path)) as archive:
        archive.extractall(tmp_path, filter="data")
        assert not any(name.endswith(".so") for name in archive.getnames())
    (unpacked,) = tmp_path.glob("bokehguide-*/")
    wheel = built("wheel", unpacked, tmp_path)
    (extension,) = packaged(wheel) - package_files(unpacked)
    assert extension.startswith("bokehguide/_native.")
    assert run_installed("-c", HAS_CORE, target=install(wheel, tmp_path / "target")).strip() == "True"


@needs_compiler
@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the default compiler is Clang")
@pytest.mark.parametrize("works", [True, False])
def test_clang_is_taken_if_it_works(works, tmp_path):
    clang = tmp_path / "tools" / "clang++"
    clang.parent.mkdir()
    clang.write_text('#!/bin/sh\nexec c++ "$@"\n' if works else "#!/bin/sh\nexit 1\n")
    clang.chmod(0o755)
    assert (configured_compiler(tmp_path / "build", clang.parent) == clang) == works
    assert (configured_compiler(tmp_path / "with pip", clang.parent, CXX="g++") == clang) == works  # Python's own compiler


@needs_compiler
def test_the_variable_cxx_names_the_compiler(tmp_path):
    compiler = tmp_path / "own"
    compiler.write_text('#!/bin/sh\nexec c++ "$@"\n')
    compiler.chmod(0o755)
    assert configured_compiler(tmp_path / "build", tmp_path, CXX=str(compiler)) == compiler


def configured_compiler(build: Path, first_on_path: Path, **environment: str) -> Path:
    """The compiler that a build of the native core takes."""
    path = os.pathsep.join([str(first_on_path), str(Path(sys.executable).parent), os.environ["PATH"]])
    kept = {name: value for name, value in os.environ.items() if name not in ("CXX", "CXXFLAGS")}
    command = ["cmake", "-G", "Ninja", "-S", REPOSITORY / "native", "-B", build, f"-DPython_EXECUTABLE={sys.executable}"]
    subprocess.run(command, env=kept | {"PATH": path} | environment, capture_output=True, check=True, timeout=120)
    (line,) = re.findall(r"^CMAKE_CXX_COMPILER:\w+=(.+)$", (build / "CMakeCache.txt").read_text(), re.MULTILINE)
    return Path(line)


def run_installed(*arguments, target: Path) -> str:
    """Output of Python with the package in `target`.

    Python's option -S ignores the .pth files of site-packages, one of which may lead to this checkout.
    """
    paths = os.pathsep.join([str(target), *site.getsitepackages()])
    return run("-S", *arguments, folder=target.parent, PYTHONPATH=paths)


def run(*arguments, folder, **environment) -> str:
    """Output of Python, away from this checkout."""
    kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "BOKEHGUIDE_NATIVE")}
    command = [sys.executable, *map(str, arguments)]
    finished = subprocess.run(command, cwd=folder, env=kept | environment, capture_output=True, text=True, timeout=600)
    assert finished.returncode == 0, finished.stdout + finished.stderr
    return finished.stdout
