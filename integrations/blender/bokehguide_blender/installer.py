"""Installs bokehguide into a Python environment of its own. Needs no Blender."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from .process import ProcessError, clean_environment

BUNDLED = Path(__file__).with_name("bokehguide-source.zip")
"""The sources of bokehguide in a built extension."""
OLDEST = (3, 11)
"""Version of Python that bokehguide needs."""
NAMES = ("python3.13", "python3.12", "python3.11", "python3", "python")
"""Interpreters of the system, in the order of the search. Blender's own has no headers, which the native core needs."""


def environment_python(folder: Path) -> Path:
    """The interpreter of an environment."""
    return folder / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")


def base_python(given: str) -> str:
    """The interpreter that makes the environment: the given one, else one of the system, else Blender's own."""
    if given:
        return given
    found = (shutil.which(name) for name in NAMES)
    return next((path for path in found if path and _is_recent(path)), sys.executable)


def chosen_source(given: str) -> str:
    """What pip installs: a folder, a file or a requirement. Raises ProcessError if there is none."""
    if given:
        return given
    if BUNDLED.is_file():
        return str(BUNDLED)
    raise ProcessError("no source of bokehguide; name the folder of its repository in the add-on's preferences")


def install(base: str, folder: Path, source: str, tell: Callable[[str], None]) -> Path:
    """Make an environment in `folder` and install `source` with the denoiser and Cryptomatte; returns its interpreter.

    tell: called with each line of the output. Raises ProcessError where a command fails.
    """
    python = environment_python(folder)
    _run([base, "-m", "venv", "--clear", str(folder)], tell)
    _run([str(python), "-m", "pip", "install", "--no-input", f"{source}[cryptomatte,denoise]"], tell)
    _run([str(python), "-c", "import bokehguide; print('installed bokehguide', bokehguide.__version__)"], tell)
    return python


def _run(command: list[str], tell: Callable[[str], None]) -> None:
    """Run a command. Raises ProcessError with its last line where it fails."""
    last = ""
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=clean_environment(),
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            encoding="utf-8",
            errors="replace",
        )
    except OSError as error:
        raise ProcessError(f"{command[0]}: cannot start ({error.strerror}); choose another Python in the preferences") from None
    assert process.stdout is not None
    with process.stdout as lines:
        for line in lines:
            if line.strip() and not line.startswith("[notice]"):
                last = line.strip()
                tell(last)
    if process.wait() != 0:
        raise ProcessError(f"installation failed: {last or command[0]}")


def _is_recent(python: str) -> bool:
    """Whether an interpreter is new enough and can make environments."""
    code = f"import sys, ensurepip; sys.exit(sys.version_info < {OLDEST})"
    try:
        return subprocess.run([python, "-c", code], env=clean_environment(), capture_output=True, timeout=20).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False
