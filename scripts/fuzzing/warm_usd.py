"""A process that has imported the USD libraries and forks for each binary file: a new process would import them each time."""

from __future__ import annotations

import os
import resource
import struct
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

from bokehguide.scene.usd import isolation

SIZE = struct.Struct("<q")
SECONDS = 120
"""Processor time of a file, after which its process ends."""
USD = ("Ar", "Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdLux", "UsdRender", "UsdShade", "UsdSkel", "UsdUtils")
MODULES = (*(f"pxr.{name}" for name in USD), "numpy.ma", "PIL.PngImagePlugin", "PIL.JpegImagePlugin")


class WarmProcess:
    """The process. It ends with this one."""

    def __init__(self) -> None:
        command, path = [sys.executable, __file__], os.pathsep.join(part for part in sys.path if part)
        environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)

    def answer(self, request: bytes) -> tuple[int, bytes]:
        """As `isolation.answer_of_process`."""
        wanted, answers = self._process.stdin, self._process.stdout
        assert wanted and answers
        wanted.write(SIZE.pack(len(request)) + request)
        wanted.flush()
        code, size = (SIZE.unpack(answers.read(SIZE.size))[0] for _ in range(2))
        return code, answers.read(size)


def serve() -> None:
    """Answer requests on stdin, each in a fork."""
    for name in MODULES:
        import_module(name)
    answers = os.fdopen(os.dup(1), "wb")
    while head := sys.stdin.buffer.read(SIZE.size):
        request = sys.stdin.buffer.read(SIZE.unpack(head)[0])
        with TemporaryFile() as wanted, TemporaryFile() as answer:
            wanted.write(request)
            wanted.seek(0)
            child = os.fork()
            if not child:
                answer_in_fork(wanted, answer)
            code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            answer.seek(0)
            found = answer.read()
        answers.write(SIZE.pack(code) + SIZE.pack(len(found)) + found)
        answers.flush()


def answer_in_fork(wanted: IO[bytes], answer: IO[bytes]) -> None:
    """Run `isolation.main` on files as stdin and stdout, and end this process."""
    try:
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
        os.dup2(wanted.fileno(), 0)
        os.dup2(answer.fileno(), 1)
        sys.stdin = os.fdopen(os.dup(0))
        isolation.main()
        os._exit(0)
    finally:
        os._exit(1)


if __name__ == "__main__":
    sys.path.remove(str(Path(__file__).parent))
    serve()
