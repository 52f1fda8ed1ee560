"""Audit the tests: each mutation of a list breaks one place of the package, and the tests that it names have to fail.

    python scripts/mutate.py
    python scripts/mutate.py --only 'film|alpha' --jobs 2

The script works on a temporary copy of the files that git tracks. Its table gives the outcome of each mutation:

- killed: a test fails or exceeds the time limit.
- survived: all tests pass.
- invalid: the old text does not occur exactly once, the tests fail without the mutation, or pytest cannot run them.

A list is a TOML file of `[[mutation]]` tables with the fields name, file, old, new and tests (files and node ids for pytest). The
exit code is 1 if a mutation survived or is invalid.
"""

from __future__ import annotations

import argparse
import os
import queue
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PASSED, FAILED = 0, 1
"""Exit codes of pytest."""
RUN_PYTEST = """
import sys, pytest
sys.meta_path[:] = [finder for finder in sys.meta_path if not type(finder).__module__.startswith("_editable_")]
sys.exit(pytest.main(sys.argv[1:]))
"""
"""Program of the tests. The finder of an editable installation would import the package of the repository, not the copy."""


@dataclass(frozen=True)
class Mutation:
    """Replacement of one text of a file, and the tests that have to fail."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    def apply(self, text: str) -> str | None:
        """The mutated text; None unless the old text occurs exactly once and differs from the new one."""
        return text.replace(self.old, self.new) if text.count(self.old) == 1 and self.old != self.new else None


class Audit:
    """Runs mutations. Threads may call `outcome` side by side, up to `jobs` at a time, each with a copy of the repository.

    folder: of the copies; limit: longest run of the tests of a mutation, seconds.
    """

    def __init__(self, folder: Path, jobs: int, limit: float):
        self._limit = limit
        self._copies: queue.Queue[Path] = queue.Queue()
        for number in range(jobs):
            self._copies.put(copy_repository(folder / str(number)))
        self._baselines: dict[tuple[str, ...], bool] = {}

    def outcome(self, mutation: Mutation) -> tuple[str, float]:
        """Outcome of a mutation, and the seconds that its tests took."""
        start, copy = time.monotonic(), self._copies.get()
        try:
            return self._run_mutation(copy, mutation), time.monotonic() - start
        finally:
            self._copies.put(copy)

    def _run_mutation(self, copy: Path, mutation: Mutation) -> str:
        path = copy / mutation.file
        original = path.read_text() if path.is_file() else ""
        mutated = mutation.apply(original)
        if mutated is None:
            return "invalid: the old text does not occur exactly once"
        if not self._passes_unchanged(copy, mutation.tests):
            return "invalid: the tests fail without the mutation"
        try:
            path.write_text(mutated)
            code = self._run_tests(copy, mutation.tests)
        finally:
            path.write_text(original)
        if code is None:
            return "killed: time limit exceeded"
        return {PASSED: "survived", FAILED: "killed"}.get(code, f"invalid: pytest ends with {code}")

    def _passes_unchanged(self, copy: Path, tests: tuple[str, ...]) -> bool:
        if tests not in self._baselines:  # two jobs may both run the tests, with the same result
            self._baselines[tests] = self._run_tests(copy, tests) == PASSED
        return self._baselines[tests]

    def _run_tests(self, copy: Path, tests: tuple[str, ...]) -> int | None:
        """Exit code of pytest; None if it exceeds the time limit."""
        # Python would reuse the bytecode of the other text for a file that changes twice within a second.
        environment = os.environ | {"BOKEHGUIDE_NATIVE": "0", "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
        command = [sys.executable, "-c", RUN_PYTEST, "-x", "-q", "-p", "no:cacheprovider", *tests]
        try:
            return subprocess.run(command, cwd=copy, env=environment, capture_output=True, timeout=self._limit).returncode
        except subprocess.TimeoutExpired:
            return None


def copy_repository(folder: Path) -> Path:
    """Copy the files that git tracks, with their uncommitted changes, to `folder`."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


def read_mutations(path: Path, pattern: str) -> list[Mutation]:
    """Mutations of a list whose name or file matches the regular expression `pattern`. Exits if two have the same name."""
    tables = tomllib.loads(path.read_text())["mutation"]
    mutations = [Mutation(**{**table, "tests": tuple(table["tests"])}) for table in tables]
    repeated = [name for name, count in Counter(mutation.name for mutation in mutations).items() if count > 1]
    if repeated:
        sys.exit(f"{path.name}: {', '.join(repeated)}: more than one mutation has this name")
    return [mutation for mutation in mutations if re.search(pattern, mutation.name) or re.search(pattern, mutation.file)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only", default="", metavar="PATTERN", help="run the mutations whose name or file matches this regular expression"
    )
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="mutations to run side by side")
    parser.add_argument("--list", type=Path, default=ROOT / "scripts/mutations.toml", metavar="PATH", help="list of mutations")
    parser.add_argument("--limit", type=float, default=900.0, metavar="SECONDS", help="time limit of the tests of one mutation")
    args = parser.parse_args()
    chosen, outcomes = read_mutations(args.list, args.only), []
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(args.jobs) as pool:
        print("| Mutation | File | Outcome | Seconds |\n|---|---|---|---|")
        for mutation, (outcome, seconds) in zip(chosen, pool.map(Audit(Path(folder), args.jobs, args.limit).outcome, chosen)):
            outcomes.append(outcome.partition(":")[0])
            print(f"| {mutation.name} | {mutation.file} | {outcome} | {seconds:.0f} |", flush=True)
    count = Counter(outcomes)
    print(f"\n{len(chosen)} mutations: " + ", ".join(f"{count[kind]} {kind}" for kind in ("killed", "survived", "invalid")))
    return int(count["killed"] < len(chosen))


if __name__ == "__main__":
    sys.exit(main())
