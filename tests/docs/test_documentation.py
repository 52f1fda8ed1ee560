"""The documentation: code blocks run, links resolve, and the README stays short.

Blocks of a page run in their order, in one empty folder:

- blocks with a title become the file of that name, and do not run;
- `python` blocks share one namespace;
- `bash` blocks run, and of `console` blocks the lines after `$`. Lines that call `bokehguide` go to its entry point in this
  process, which has PyTorch loaded already; a block with any other line runs under `bash -euo pipefail`.

A block with `{ no-run="reason" }` after its language is skipped.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import textwrap
import warnings
from dataclasses import dataclass
from pathlib import Path

import pytest

from bokehguide.cli import main

ROOT = Path(__file__).parent.parent.parent
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(r"^(?P<indent> *)```(?P<language>\w+)(?P<options>[^\n]*)\n(?P<code>.*?)^(?P=indent)```[ \t]*$", re.M | re.S)
OPTION = re.compile(r'([\w-]+)="([^"]*)"')
LINK = re.compile(r"!?\[[^\]]*\]\((?P<target>[^)\s]+)(?:\s+\"[^\"]*\")?\)|<img[^>]*\ssrc=\"(?P<source>[^\"]+)\"")
RUN = ("python", "bash", "console")
SLOW = ("how-to", "tutorials", "reference", "explanation")
"""Folders of the pages whose blocks are among the slow tests."""
SECONDS = 120


@dataclass(frozen=True)
class Block:
    language: str
    code: str
    line: int
    options: dict[str, str]

    @property
    def runs(self) -> bool:
        return "no-run" not in self.options and (self.language in RUN or "title" in self.options)


def blocks(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    return [
        Block(
            match["language"],
            textwrap.dedent(match["code"]),
            text.count("\n", 0, match.start()) + 2,
            dict(OPTION.findall(match["options"])),
        )
        for match in FENCE.finditer(text)
    ]


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.fixture
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """That of a shell in which `bokehguide` and `python` are those of this interpreter and checkout."""
    folder = tmp_path_factory.mktemp("bin")
    for command, start in (("bokehguide", f'"{sys.executable}" -m bokehguide'), ("python", f'"{sys.executable}"')):
        script = folder / command
        script.write_text(f'#!/bin/sh\nexec {start} "$@"\n')
        script.chmod(0o755)
    path = os.pathsep.join((str(folder), os.environ.get("PATH", os.defpath)))
    return os.environ | {"PATH": path, "PYTHONPATH": str(ROOT), "PYTHONSAFEPATH": "1", "COLUMNS": "100"}


RUNNING = [page for page in PAGES if any(block.runs for block in blocks(page))]


@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=[pytest.mark.slow] if page.parent.name in SLOW else []) for page in RUNNING], ids=name
)
def test_blocks_run(page, environment, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {"__name__": "__main__"}
    for block in blocks(page):
        if not block.runs:
            continue
        if "title" in block.options:
            path = tmp_path / block.options["title"]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.code)
        elif block.language == "python":
            # Empty lines before the code, so that a traceback names the page's own line.
            exec(compile("\n" * (block.line - 1) + block.code, str(page), "exec"), namespace)
        else:
            run(block, page, environment, tmp_path)


def run(block: Block, page: Path, environment: dict[str, str], folder: Path) -> None:
    code = block.code
    if block.language == "console":
        code = "\n".join(line[2:] for line in code.splitlines() if line.startswith("$ "))
    if commands := own_commands(code):
        for arguments in commands:
            with warnings.catch_warnings():
                warnings.simplefilter("default")  # a warning that a user would see is not an error
                assert main(arguments) == 0, f"{name(page)}:{block.line}: bokehguide {shlex.join(arguments)}"
        return
    command = ["bash", "-euo", "pipefail", "-c", code]
    finished = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=SECONDS)
    assert finished.returncode == 0, f"{name(page)}:{block.line}\n{code}\n{finished.stdout}{finished.stderr}"


def own_commands(code: str) -> list[list[str]]:
    """The arguments of each line if all lines call `bokehguide` and use nothing of a shell, else an empty list."""
    lines = [line for line in code.replace("\\\n", " ").splitlines() if line.strip()]
    if any(not line.startswith("bokehguide ") or re.search(r"[|&;<>$`*?~#]", line) for line in lines):
        return []
    return [shlex.split(line)[1:] for line in lines]


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_skipped_blocks_give_a_reason(page):
    text = page.read_text(encoding="utf-8")
    fences = len(re.findall(r"^ *```\w", text, re.M))
    assert fences == len(blocks(page)), "a fence is not closed, or its language is missing"
    assert all(block.options["no-run"].strip() for block in blocks(page) if "no-run" in block.options)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_resolve(page):
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    for match in LINK.finditer(text):
        target = match["target"] or match["source"]
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = page if not path else (page.parent / path).resolve()
        assert file.is_relative_to(ROOT) and file.exists(), f"{name(page)}: {target}"
        if anchor and file.suffix == ".md":
            assert anchor in anchors(file), f"{name(page)}: {target}: {sorted(anchors(file))}"


def anchors(page: Path) -> set[str]:
    """Of the headings of a page, as Markdown's `toc` extension and GitHub both make them of plain words."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ +(.+?)(?: *\{ *#([\w-]+) *\})?$", text, re.M)
    return {given or slug(heading) for heading, given in headings}


def slug(heading: str) -> str:
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower())


def test_the_readme_is_short():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 150


def test_pictures_of_the_readme_are_small():
    text = README.read_text(encoding="utf-8")
    sources = {match["target"] or match["source"] for match in LINK.finditer(text)}
    pictures = [ROOT / source for source in sources if Path(source).suffix in (".png", ".webp")]
    assert pictures and sum(picture.stat().st_size for picture in pictures) <= 2 * 2**20


SWITCHED_OFF = "api: false" in (ROOT / "mkdocs.yml").read_text(encoding="utf-8")


@pytest.mark.skipif(SWITCHED_OFF, reason="mkdocs.yml has `api: false`: the package does not have all names of the pages yet")
@pytest.mark.parametrize("page", [page for page in PAGES if page.parent.name == "explanation"], ids=name)
def test_named_files_and_classes_exist(page):
    text = page.read_text(encoding="utf-8")
    package = ROOT / "bokehguide"
    sources = {path: path.read_text(encoding="utf-8") for path in package.rglob("*.py")}
    classes = set(re.findall(r"^class (\w+)", "\n".join(sources.values()), re.M))
    paths = re.findall(r"`([\w/]+/(?:\w+\.py)?)`", text)
    missing = [path for path in paths if not (package / path).exists() and not (ROOT / path).exists()]
    missing += [word for word in re.findall(r"`([A-Z][a-z]+(?:[A-Z][a-z]+)+)(?:\.\w+)?`", text) if word not in classes]
    assert not missing
