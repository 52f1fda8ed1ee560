"""What holds for every test: one OpenMP thread, in this process and in those it starts."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

# Before torch is imported: two processes with several spinning OpenMP threads each
# stand in each other's way, and a test of a second takes a minute.
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
# The commands that tests start are those of this checkout, installed or not.
os.environ["PYTHONPATH"] = str(Path(__file__).parent.parent)

LAMPS = """
[camera]
position = [0.0, 0.0, 4.0]
target = [0.0, 0.0, 0.0]
fov = 40.0
aperture_radius = 0.5
focus_distance = 3.0
[film]
width = 32
height = 20
max_depth = 3
[environment]
color = [0.02, 0.03, 0.05]
[materials.wall]
base_color = [0.5, 0.4, 0.3]
[materials.lamp]
base_color = [0.0, 0.0, 0.0]
emission = [40.0, 30.0, 20.0]
[[object]]
shape = "box"
material = "wall"
translate = [-0.6, -0.3, 0.5]
[[object]]
shape = "sphere"
material = "lamp"
translate = [0.5, 0.2, -3.0]
scale = 0.2
"""


@pytest.fixture
def lamps_file(tmp_path: Path) -> Path:
    """A scene file of a box in focus and a lamp behind it, 32 × 20 pixels."""
    path = tmp_path / "lamps.toml"
    path.write_text(LAMPS)
    return path


@pytest.fixture
def bokehguide(tmp_path: Path):
    """Run the command in a folder of its own; gives the finished process with its texts."""

    def run(*arguments: object) -> subprocess.CompletedProcess:
        command = [sys.executable, "-m", "bokehguide", *map(str, arguments)]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)

    return run
