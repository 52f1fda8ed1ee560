"""`bokehguide`, `bokehguide scenes` and `bokehguide info`."""

import re
import subprocess
import sys

import pytest

import bokehguide as package
from bokehguide.cli import main
from bokehguide.scene import BUILTIN, DESCRIPTIONS
from bokehguide.train import MODES


def test_version(bokehguide):
    finished = bokehguide("--version")
    assert (finished.returncode, finished.stdout) == (0, f"bokehguide {package.__version__}\n")


def test_help_names_every_mode_and_imports_nothing_heavy(bokehguide):
    assert ",".join(MODES) in bokehguide("render", "--help").stdout
    code = (
        "import sys; from bokehguide.cli.arguments import parse; import bokehguide.cli\n"
        "print({'torch', 'numpy', 'trimesh', 'kornia'} & set(sys.modules))"
    )
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert finished.stdout == "set()\n"


@pytest.mark.slow
def test_mistakes_in_options_wait_for_nothing_that_only_scenes_need():
    code = "import sys, bokehguide.train; print({'trimesh', 'scipy', 'kornia', 'matplotlib', 'OpenImageIO'} & set(sys.modules))"
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert finished.stdout == "set()\n"


def test_scenes_are_a_line_each(bokehguide):
    finished = bokehguide("scenes")
    assert finished.returncode == 0, finished.stderr
    lines = finished.stdout.splitlines()
    assert [line.split()[0] for line in lines] == list(BUILTIN)
    assert all(re.fullmatch(r"[a-z-]+ +\S.{15,}", line) for line in lines)


def test_scenes_are_listed_without_building_them(monkeypatch, capsys):
    def build():
        raise AssertionError("built")

    for name in BUILTIN:
        monkeypatch.setitem(BUILTIN, name, build)
    assert main(["scenes"]) == 0
    assert list(DESCRIPTIONS) == list(BUILTIN)
    out = capsys.readouterr().out
    assert all(description in out for description in DESCRIPTIONS.values())


@pytest.mark.slow
@pytest.mark.parametrize("arguments", ["scenes", "info emitters.toml", "--help"])
def test_a_reader_who_leaves_is_no_error(arguments, lamps_file, monkeypatch):
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)  # argparse keeps quiet about what is not buffered
    command = [sys.executable, "-m", "bokehguide", *arguments.split()]
    with subprocess.Popen(command, cwd=lamps_file.parent, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        stderr = process.stderr.read()
    assert (process.returncode, stderr) == (141, b"")


@pytest.mark.slow
def test_info_tells_what_was_loaded(bokehguide, lamps_file):
    finished = bokehguide("info", lamps_file)
    assert finished.returncode == 0, finished.stderr
    assert "32 × 20" in finished.stdout
    assert "wall" in finished.stdout


@pytest.mark.slow
def test_info_of_nothing(bokehguide):
    finished = bokehguide("info", "fairy-light")
    assert finished.returncode == 2
    assert finished.stderr.startswith("bokehguide: error: fairy-light: ")
    assert "fairy-lights" in finished.stderr
