"""Renders in processes of their own. Needs no Blender."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import tempfile
import threading
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Self

FOLDER = Path(__file__).parent
PATIENCE = 3.0
"""Seconds from the request to end to the forced end of a process."""


class ProcessError(Exception):
    """A message for the user."""


class Driver:
    """A running program of this folder; a context that ends the process. python: interpreter with bokehguide.

    Raises ProcessError where the interpreter is missing or cannot start.
    """

    def __init__(self, python: str, program: str, argument: Path, stdin: int = subprocess.DEVNULL):
        require_python(python)
        self._messages: queue.Queue[dict[str, Any] | None] = queue.Queue()
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed in close
        try:
            self._process = subprocess.Popen(
                [python, "-u", str(FOLDER / program), str(argument)],
                stdin=stdin,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                env=clean_environment(),
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            )
        except OSError as error:
            self._errors.close()
            raise ProcessError(f"{python}: cannot start ({error.strerror}); check the path in the add-on's preferences") from None
        assert self._process.stdout is not None
        threading.Thread(target=self._read, args=(self._process.stdout,), daemon=True).start()

    def message(self, timeout: float) -> dict[str, Any] | None:
        """The next line of the driver; empty if none arrives within `timeout` seconds, None at the end of the process."""
        try:
            return self._messages.get(timeout > 0.0, timeout)
        except queue.Empty:
            return {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process if it still runs."""
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        if self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()
        self._errors.close()

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def failure(self) -> str | None:
        """Why the process ended, None after success. Waits for its end."""
        code = self._process.wait()
        if code == 0:
            return None
        self._errors.seek(0)
        last = self._errors.read().decode(errors="replace").strip().splitlines()
        return f"bokehguide ended with code {code}: {last[-1] if last else 'no message'}"

    def _read(self, stream: IO[bytes]) -> None:
        """Queue the messages of the driver. Other lines come from libraries and are left out."""
        with stream:
            for line in stream:
                try:
                    message = json.loads(line)
                except ValueError:
                    continue
                if isinstance(message, dict):
                    self._messages.put(message)
        self._messages.put(None)


class Render(Driver):
    """A render of a scene file. folder: for the job and pictures. layer: of the scene. options: of `bokehguide.render`."""

    def __init__(self, python: str, scene: Path, folder: Path, layer: str, options: dict[str, Any]):
        job = folder / "job.json"
        content = {"scene": str(scene), "folder": str(folder), "layer": layer, "options": options}
        job.write_text(json.dumps(content), encoding="utf-8")
        super().__init__(python, "driver.py", job)


class Preview(Driver):
    """Renders the latest of the views that are shown to it. folder: for pictures."""

    def __init__(self, python: str, folder: Path):
        super().__init__(python, "preview_driver.py", folder, subprocess.PIPE)

    def show(self, view: dict[str, Any]) -> None:
        """Render this view from now on; see `preview_driver.py`. The end of the process is told by `message`."""
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.write(json.dumps(view).encode() + b"\n")
            self._process.stdin.flush()


def require_python(python: str) -> None:
    """Raise ProcessError unless `python` is an existing file."""
    if not python:
        raise ProcessError("bokehguide is not installed; open the add-on's preferences and press Install")
    if not Path(python).is_file():
        raise ProcessError(
            f"{python}: no such Python interpreter; press Install in the add-on's preferences, or correct the path"
        )


def clean_environment() -> dict[str, str]:
    """The environment without the variables that lead an interpreter to the packages of another."""
    return {name: value for name, value in os.environ.items() if name not in ("PYTHONHOME", "PYTHONPATH", "PYTHONSTARTUP")}
