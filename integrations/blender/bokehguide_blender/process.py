"""A render in a process of its own. Needs no Blender."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import tempfile
import threading
from pathlib import Path
from typing import IO, Any, Self

DRIVER = Path(__file__).with_name("driver.py")
PATIENCE = 3.0
"""Seconds from the request to end to the forced end of a process."""


class ProcessError(Exception):
    """A message for the user."""


class Render:
    """A running render; a context that ends the process. python: interpreter with bokehguide. folder: for the job and pictures.

    Raises ProcessError where the interpreter is missing or cannot start.
    """

    def __init__(self, python: str, scene: Path, folder: Path, options: dict[str, Any]):
        require_python(python)
        job = folder / "job.json"
        job.write_text(json.dumps({"scene": str(scene), "folder": str(folder), "options": options}), encoding="utf-8")
        self._messages: queue.Queue[dict[str, Any] | None] = queue.Queue()
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed in __exit__
        try:
            self._process = subprocess.Popen(
                [python, "-u", str(DRIVER), str(job)],
                stdin=subprocess.DEVNULL,
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
            return self._messages.get(timeout=timeout)
        except queue.Empty:
            return {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End the process if it still runs."""
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
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
