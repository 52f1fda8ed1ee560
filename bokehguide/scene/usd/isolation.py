"""USD files as models, binary files in a process of their own, with bounded memory.

The reader of binary files trusts their tables: a damaged file can end the process, or ask for any amount of memory.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from pathlib import Path

from bokehguide.errors import BokehguideError, encoding_problem
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.model import Model, ModelState
from bokehguide.scene.tables import shown
from bokehguide.scene.usd.loading import read_usd
from bokehguide.scene.usd.stage import BinaryLayer

PROGRAM = "from bokehguide.scene.usd.isolation import main; main()"
FREE_MEMORY, MEMORY_PER_BYTE = 2**31, 300
"""Bytes that the process may take beyond its start, and for each byte of the files in the scene's folder."""
SHARE = 0.75
"""Largest share of the machine's memory."""
MAX_FILES = 100_000


def load_usd(path: Path, files: SceneFiles, state: ModelState) -> Model:
    """The stage of a USD file. Instances become triangles.

    files: the files that the stage may name. state: variants and time. Raises BokehguideError, naming file and prim, for missing
    USD libraries, damaged data, values out of range, a variant that the stage lacks, and more triangles than the files allow.
    """
    whole = str(path.resolve())
    if problem := encoding_problem(whole):
        raise BokehguideError(f"{path}: {shown(whole)} {problem}")
    try:
        return read_usd(path, files, state, binary=not sys.executable)
    except BinaryLayer:
        return _load_isolated(path, files, state)


def _load_isolated(path: Path, files: SceneFiles, state: ModelState) -> Model:
    """As `read_usd` in another process. Raises BokehguideError also where this process dies."""
    code, answer = answer_of_process(pickle.dumps((path, files.folder, files.allow_outside, state)))
    if code or not answer:
        raise BokehguideError(
            f"{path}: the USD libraries fail on this file (exit code {code}): it is damaged, or needs too much memory; save it "
            "again, or convert it to .usda with usdcat"
        )
    model, used, found, problem = pickle.loads(answer)
    if model is None:
        raise BokehguideError(problem)
    files.add_used(used, str(path))
    files.found |= found
    return model


def answer_of_process(request: bytes) -> tuple[int, bytes]:
    """The exit code of a new process that runs `main`, and its answer to a request. No module comes from the working folder."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(part for part in sys.path if part), "OMP_NUM_THREADS": "1"}
    finished = subprocess.run([sys.executable, "-P", "-c", PROGRAM], input=request, stdout=subprocess.PIPE, env=environment)
    return finished.returncode, finished.stdout


def main() -> None:
    """The work of the other process: a request on stdin, and the answer on stdout, which USD must not print to."""
    path, folder, allow_outside, state = pickle.load(sys.stdin.buffer)
    answer, null = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    _limit_memory(folder)
    files = SceneFiles(folder, allow_outside)
    try:
        result = read_usd(path, files, state, binary=True), files.used, files.found, ""
    except BokehguideError as error:
        result = None, files.used, files.found, str(error)
    with os.fdopen(answer, "wb") as out:
        pickle.dump(result, out, protocol=pickle.HIGHEST_PROTOCOL)


def _limit_memory(folder: Path) -> None:
    """Limit the memory of this process, where the system can."""
    try:
        import resource

        start = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ImportError, OSError, ValueError):
        return
    most = start + min(FREE_MEMORY + MEMORY_PER_BYTE * _stored(folder), int(SHARE * machine))
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def _stored(folder: Path) -> int:
    """Bytes of the files in a folder and below, at most MAX_FILES of them."""
    total, left = 0, MAX_FILES
    for parent, _, names in os.walk(folder):
        for name in names[:left]:
            place = Path(parent) / name
            total += place.lstat().st_size if place.exists() else 0
        left -= len(names)
        if left <= 0:
            break
    return total
