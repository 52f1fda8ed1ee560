"""Damaged files: the loaders must refuse each in one or two lines, or render it, and must print nothing.

    scripts/fuzz.py [FORMAT ...] --cases 2000 --seed 0

prints a table, and writes the files of failures with their traces, and the files of slow cases, into `--out`. It needs the
test extra (hypothesis). Cases run in processes of their own, with --memory MB beyond the memory at the start (on Linux) and
--seconds for each case, so that crashes, hangs and decompression bombs count as failures.
"""

from __future__ import annotations

import argparse
import faulthandler
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
import traceback
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path

FORMATS = ("glb", "gltf", "meshopt", "glossy", "toml", "hdr", "exr", "images", "obj", "ply", "stl", "pbrt", "ckpt")
FORMATS += ("xml",) if find_spec("mitsuba") else ()
FORMATS += ("usda", "usdc", "usdz") if find_spec("pxr") else ()
FORMATS += ("mtlx",) if find_spec("pxr") and find_spec("MaterialX") else ()
BATCH = 500
"""Cases in one process."""
KEPT = 20
"""Number of failures of a batch whose files are kept."""


@dataclass
class Tally:
    """Results of the cases of a format. peak: MB of memory; slowest: processor seconds of the slowest case."""

    cases: int = 0
    loaded: int = 0
    refused: int = 0
    failures: list[str] = field(default_factory=list)
    peak: float = 0.0
    slowest: float = 0.0

    def add(self, other: Tally) -> None:
        for name in ("cases", "loaded", "refused", "failures"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.peak, self.slowest = max(self.peak, other.peak), max(self.slowest, other.slowest)


def main() -> int:
    options = parse()
    if options.worker:
        return work(options)
    tallies = {name: Tally() for name in options.formats}
    groups = [options.formats] if options.together else [[name] for name in options.formats]
    for group in groups:
        for number in range(math.ceil(options.cases / BATCH)):
            cases = min(BATCH, options.cases - number * BATCH)
            for name, tally in batch(group, cases, options.seed + 1_000_003 * number, options).items():
                tallies[name].add(tally)
        for name in group:
            print(f"{name}: {tallies[name].cases} cases, {len(tallies[name].failures)} failures", file=sys.stderr)
    print(table(tallies))
    if options.json:
        options.json.write_text(json.dumps({name: asdict(tally) for name, tally in tallies.items()}, indent=1))
    return 1 if any(tally.failures for tally in tallies.values()) else 0


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("formats", nargs="*", metavar="FORMAT", help=f"of {' '.join(FORMATS)} (default: all)")
    parser.add_argument("--cases", type=int, default=2000, metavar="N", help="cases of each format (default: 2000)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--memory", type=int, default=2560, metavar="MB", help="memory of a process (default: 2560)")
    parser.add_argument("--seconds", type=float, default=60.0, metavar="S", help="longest time of one case (default: 60)")
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"), metavar="DIR", help="for failures (default: out/fuzz)")
    parser.add_argument("--json", type=Path, metavar="PATH", help="also write the numbers of the table here")
    parser.add_argument("--together", action="store_true", help="run all formats in one process, which is faster for few cases")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    unknown = set(options.formats) - set(FORMATS)
    if unknown:
        parser.error(f"no such format: {', '.join(unknown)}; known are {', '.join(FORMATS)}")
    options.formats = options.formats or list(FORMATS)
    return options


def batch(formats: list[str], cases: int, seed: int, options: argparse.Namespace) -> dict[str, Tally]:
    """Run cases in a process. If it dies, the format at work has failed, and a new process runs the later formats."""
    tallies: dict[str, Tally] = {}
    left = list(formats)
    while left:
        with tempfile.TemporaryDirectory() as folder:
            result = Path(folder) / "result.jsonl"
            command = [sys.executable, __file__, "--worker", *left, "--cases", str(cases), "--seed", str(seed)]
            command += ["--memory", str(options.memory), "--seconds", str(options.seconds)]
            command += ["--out", str(options.out), "--json", str(result)]
            finished = subprocess.run(command, capture_output=True, text=True)
            lines = result.read_text().splitlines() if result.exists() else []
        done = {entry["name"]: Tally(**entry["tally"]) for entry in map(json.loads, lines)}
        if finished.stderr and not finished.returncode:
            next(iter(done.values())).failures.append(f"{' '.join(done)}: a reader printed: {finished.stderr[:1500]}")
        tallies |= done
        left = [name for name in left if name not in done]
        if left:
            output = f"{finished.stderr[:500]} … {finished.stderr[-1000:]}"
            died = f"the process died ({finished.returncode}), see {options.out / left[0]}-last: {output}"
            tallies[left.pop(0)] = Tally(cases, failures=[died])
    return tallies


def table(tallies: dict[str, Tally]) -> str:
    """All formats in Markdown."""
    lines = [
        "| format | cases | loaded | refused | failures | peak memory (MB) | slowest case (s) |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for name, t in tallies.items():
        lines.append(f"| {name} | {t.cases} | {t.loaded} | {t.refused} | {len(t.failures)} | {t.peak:.0f} | {t.slowest:.2f} |")
    return "\n".join(lines)


def work(options: argparse.Namespace) -> int:
    """Run all cases of some formats in this process; appends a line of JSON for each finished format."""
    os.environ["OMP_NUM_THREADS"] = "1"
    from fuzzing.samples import SAMPLES
    from fuzzing.trial import trial
    from hypothesis.configuration import set_hypothesis_home_dir

    if {"usdc", "usdz"} & set(options.formats):
        from fuzzing.warm_usd import WarmProcess

        from bokehguide.scene.usd import isolation

        isolation.answer_of_process = WarmProcess().answer
    with tempfile.TemporaryDirectory() as home:
        set_hypothesis_home_dir(home)
        samples = {}
        for name in options.formats:
            folder = Path(home) / name
            folder.mkdir()
            samples[name] = SAMPLES[name](folder)
            for sample in samples[name]:
                lay_out(sample, folder)
                if not trial(folder / sample.loaded):
                    raise SystemExit(f"{name}: the sound file is refused")
        limit_memory(options.memory)
        for name in options.formats:
            tally = run_format(name, samples[name], Path(home) / name, options)
            with options.json.open("a") as file:
                file.write(json.dumps({"name": name, "tally": asdict(tally)}) + "\n")
    return 0


def lay_out(sample, folder: Path) -> None:
    for name, data in sample.files.items():
        (folder / name).write_bytes(data)


def limit_memory(megabytes: int) -> None:
    """Limit the memory of this process to `megabytes` beyond its present memory."""
    if sys.platform == "linux":
        now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (now + megabytes * 2**20,) * 2)


def run_format(name: str, samples: list, folder: Path, options: argparse.Namespace) -> Tally:
    import hypothesis
    from fuzzing.damage import damaged, damages
    from hypothesis import strategies

    from bokehguide.cli.report import peak_memory_mb

    tally, state, last = Tally(), {}, options.out / f"{name}-last"
    options.out.mkdir(parents=True, exist_ok=True)

    @hypothesis.seed(options.seed)
    @hypothesis.settings(
        max_examples=options.cases, database=None, deadline=None, suppress_health_check=list(hypothesis.HealthCheck)
    )
    @hypothesis.given(strategies.data())
    def run(data: strategies.DataObject) -> None:
        sample = data.draw(strategies.sampled_from(samples))
        file = data.draw(strategies.sampled_from(sample.damaged))
        broken = damaged(sample.files[file], data.draw(damages(Path(file).suffix)))
        if state.get("sample") is not sample:
            lay_out(sample, folder)
            state["sample"] = sample
        (folder / file).write_bytes(broken)
        last.write_bytes(broken)  # kept if the process crashes
        one_case(tally, folder, sample, f"{name}-{options.seed}-{tally.cases}", options)
        (folder / file).write_bytes(sample.files[file])

    run()
    tally.peak = peak_memory_mb() or math.nan
    return tally


def one_case(tally: Tally, folder: Path, sample, label: str, options: argparse.Namespace) -> None:
    """Load the files in `folder` and count the result; an exception that is no refusal is a failure."""
    from fuzzing.trial import trial

    faulthandler.dump_traceback_later(options.seconds, exit=True)
    began = time.process_time()
    tally.cases += 1
    try:
        loaded = trial(folder / sample.loaded)
        tally.loaded, tally.refused = tally.loaded + loaded, tally.refused + (not loaded)
    except Exception as error:
        tally.failures.append(f"{label}: {type(error).__name__}: {str(error)[:500]}")
        if len(tally.failures) <= KEPT:
            keep(sample, folder, options.out / label)
            (options.out / label / "trace.txt").write_text(traceback.format_exc())
    finally:
        faulthandler.cancel_dump_traceback_later()
        took = time.process_time() - began
        tally.slowest = max(tally.slowest, took)
        if took > options.seconds / 20:
            keep(sample, folder, options.out / f"{label}-slow")


def keep(sample, folder: Path, where: Path) -> None:
    where.mkdir(parents=True, exist_ok=True)
    for name in sample.files:
        (where / name).write_bytes((folder / name).read_bytes())


if __name__ == "__main__":
    raise SystemExit(main())
