"""Render every figure and table of the documentation on one revision: `make results`.

    python scripts/results.py
    python scripts/results.py --setting reduced --only fig6,seeds

Each item of `result_items.py` is one script with its options. The settings differ in sizes and SPP: on two cores `full`
takes days, `reduced` one to two hours, `smoke` under two minutes. An item writes one page into docs/results:
`figures-NAME.md` or `tables-NAME.md`, with its pictures as NAME-*.webp and a stamp of commit, machine, command and time.

Work files go into a folder for each setting and each state of the sources, in `--out`, references too. An item that is
finished there is skipped, so that the same command continues after an interruption. A page without results says so.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import shlex
import subprocess
import sys
import time
from pathlib import Path

from PIL import Image
from result_items import ITEMS, SETTINGS, Item

from bokehguide.cli.parser import Parser
from bokehguide.cli.scripts import run
from bokehguide.image import check_writable, write_text
from bokehguide.scene.digest import digest

REPOSITORY = Path(__file__).resolve().parents[1]
SCRIPTS = ("scripts/experiments", "scripts/figures", *sorted({f"scripts/{item.script}" for item in ITEMS}))
SOURCES = ("bokehguide", "native", *SCRIPTS)
"""Folders and files that the results depend on."""
PICTURE_WIDTH, QUALITY = 1440, 85
"""Most pixels across a WebP picture, and its quality of 100."""


def main() -> int:
    args = parse()
    work = args.out / args.setting / sources_digest()
    check_writable(work / "stamp")
    failed = [item.name for item in args.only if not finish(item, args.setting, work, args.docs)]
    for item in ITEMS:
        write_placeholder(item, args.docs)
    remove_unused(args.docs)
    if failed:
        print(f"results: failed: {', '.join(failed)}; the same command continues", file=sys.stderr)
    return 1 if failed else 0


def parse() -> argparse.Namespace:
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--setting", choices=SETTINGS, default="full", help="sizes and SPP (default: full)")
    known = ", ".join(item.name for item in ITEMS)
    add("--only", type=items, default=list(ITEMS), metavar="A,B,...", help=f"of {known} (default: all)")
    add("--out", type=Path, default=REPOSITORY / "out/results", metavar="DIR", help="work folder (default: out/results)")
    add("--docs", type=Path, default=REPOSITORY / "docs/results", metavar="DIR", help="pages (default: docs/results)")
    return parser.parse_args()


def items(text: str) -> list[Item]:
    by_name = {item.name: item for item in ITEMS}
    for name in text.split(","):
        if name not in by_name:
            raise argparse.ArgumentTypeError(f"{name!r} is no figure or table; choose from {', '.join(by_name)}")
    return [by_name[name] for name in text.split(",")]


def finish(item: Item, setting: str, work: Path, docs: Path) -> bool:
    """Run one item unless it is finished, and write its page; returns whether it succeeded."""
    options = item.options(setting)
    if options is None:
        return True
    if item.peer and importlib.util.find_spec("mitsuba") is None:
        print(f"{item.name}: skipped, Mitsuba is not installed; pip install '.[peers]'")
        return True
    folder = work / item.name
    command = [f"scripts/{item.script}", *options]
    stamp = read_stamp(folder)
    if stamp.get("command") == command:
        print(f"{item.name}: kept")
    else:
        print(f"{item.name}: {shlex.join(command)}", flush=True)
        stamp = execute(item, command, folder)
        if not stamp:
            return False
    write_page(item, setting, folder, stamp, docs)
    return True


def execute(item: Item, command: list[str], folder: Path) -> dict:
    """Run the command of an item in its work folder; returns the stamp, or an empty one if the command fails."""
    folder.mkdir(parents=True, exist_ok=True)
    script, *options = command
    options += ["--out", str(folder)] if item.output else []
    options += ["--cache", str(folder.parent / "references")] if item.cache else []
    start = time.perf_counter()
    finished = subprocess.run(
        [sys.executable, str(REPOSITORY / script), *options], stdout=subprocess.PIPE, text=True, check=False
    )
    (folder / "stdout.txt").write_text(finished.stdout)
    if finished.returncode not in ((0, 1) if item.verdict else (0,)):
        return {}
    stamp = {"command": command, "seconds": time.perf_counter() - start, "commit": commit(), "machine": machine()}
    write_text(folder / "stamp.json", json.dumps(stamp, indent=1) + "\n")
    return stamp


def read_stamp(folder: Path) -> dict:
    """The stamp of a finished item; empty if there is none, or if it is damaged."""
    try:
        stamp = json.loads((folder / "stamp.json").read_bytes())
    except (OSError, ValueError):
        return {}
    return stamp if isinstance(stamp, dict) else {}


def sources_digest() -> str:
    """Identifies the sources that the results depend on."""
    roots = [REPOSITORY / source for source in SOURCES]
    python = [path for root in roots for path in ([root] if root.is_file() else root.rglob("*.py"))]
    files = sorted([*python, *REPOSITORY.glob("native/*.h"), *REPOSITORY.glob("native/*.cpp")])
    return digest(tuple(f"{path.relative_to(REPOSITORY)}\n{path.read_text()}" for path in files))[:12]


def commit() -> str:
    """The short hash of the commit, with `+changes` if the sources differ from it."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "--short", "HEAD") + ("+changes" if git("status", "--porcelain", "--", *SOURCES) else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def machine() -> str:
    """Model of the processor and number of usable cores."""
    model = platform.processor() or platform.machine()
    information = Path("/proc/cpuinfo")
    if information.exists():
        lines = [line.partition(":")[2].strip() for line in information.read_text().splitlines() if line.startswith("model name")]
        model = lines[0] if lines else model
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{model}, {cores} cores"


def write_page(item: Item, setting: str, folder: Path, stamp: dict, docs: Path) -> None:
    """The page of a finished item: title, text, pictures, tables and stamp."""
    check_writable(docs / item.page)
    pictures = [write_picture(path, item, docs) for path in sorted(folder.glob(item.pictures))] if item.pictures else []
    lines = [f"![{path.stem}]({path.name})" for path in pictures]
    tables = sorted(folder.glob("*.md"))
    text = "\n".join(path.read_text() for path in tables) if tables else (folder / "stdout.txt").read_text()
    facts = f"Commit `{stamp['commit']}`, setting `{setting}`, {stamp['machine']}, {stamp['seconds']:.0f} s:"
    command = f"```text\npython {shlex.join(stamp['command'])}\n```"
    write_parts(docs / item.page, [f"# {item.title}", item.text, *lines, text.strip(), facts, command])


def write_picture(path: Path, item: Item, docs: Path) -> Path:
    """A PNG of the work folder as a WebP file of at most PICTURE_WIDTH pixels across."""
    stem = path.stem if path.stem.startswith(item.name) else f"{item.name}-{path.stem}"
    target = docs / f"{stem}.webp"
    with Image.open(path) as image:
        image.thumbnail((PICTURE_WIDTH, image.height))
        image.convert("RGB").save(target, quality=QUALITY, method=6)
    return target


def write_placeholder(item: Item, docs: Path) -> None:
    """The page of an item that was never rendered, so that links to it work."""
    if not (docs / item.page).exists():
        check_writable(docs / item.page)
        note = f"Not rendered yet: `python scripts/results.py --only {item.name}` renders this page."
        write_parts(docs / item.page, [f"# {item.title}", item.text, note])


def write_parts(path: Path, parts: list[str]) -> None:
    write_text(path, "\n\n".join(parts) + "\n")


def remove_unused(docs: Path) -> None:
    """Remove pages of items that are gone, and WebP files that no page shows."""
    pages = {item.page for item in ITEMS}
    for page in (*docs.glob("figures-*.md"), *docs.glob("tables-*.md")):
        if page.name not in pages:
            page.unlink()
    text = "\n".join(page.read_text() for page in docs.glob("*.md"))
    for picture in docs.glob("*.webp"):
        if f"({picture.name})" not in text:
            picture.unlink()


if __name__ == "__main__":
    run(main, "finished items are kept, and the same command continues")
