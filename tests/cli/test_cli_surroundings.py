"""Full disks, odd names, pipes and locales: one line, and never a lost picture."""

import fcntl
import json
import logging
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import numpy as np
import pytest
from tqdm import tqdm

from bokehguide.cli import main, render, terminal
from bokehguide.cli.arguments import parse
from bokehguide.cli.pictures import Pictures
from bokehguide.image import read_metadata, write_exr

COMMAND = (sys.executable, "-m", "bokehguide")


def run(folder: Path, *arguments: str | bytes, shell: str = "", **environment: str) -> subprocess.CompletedProcess:
    """The command in a folder, with bytes for its output. shell: redirections."""
    command = [*COMMAND, *arguments]
    if shell:
        command = ["sh", "-c", f'exec "$@" {shell}', "sh", *command]
    return subprocess.run(command, cwd=folder, capture_output=True, timeout=120, env=os.environ | environment)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_messages_that_find_a_full_disk(lamps_file, tmp_path):
    """The picture is there, and the code says whether the summary was lost."""
    finished = run(tmp_path, "render", "emitters.toml", "--spp", "2", "--out", "a.exr", shell="2>/dev/full")
    assert finished.returncode == 0 and b"wrote a.exr" in finished.stdout
    options = ("--spp", "3", "--out", "a.exr", "--json", "a.json")
    finished = run(tmp_path, "render", "emitters.toml", *options, shell=">/dev/full")
    assert finished.returncode == 2 and b"Traceback" not in finished.stderr
    assert finished.stderr.endswith(b"bokehguide: error: the output cannot be written (No space left on device)\n")
    assert read_metadata(tmp_path / "a.exr")["spp"] == 3 and (tmp_path / "a.json").exists()


def test_a_summary_that_cannot_be_written_is_a_warning(lamps_file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write = Pictures.write
    (tmp_path / "facts").mkdir()
    monkeypatch.setattr(Pictures, "write", lambda *arguments: (write(*arguments), Path("facts").rmdir()))
    assert main(["render", "emitters.toml", "--spp", "1", "--out", "a.exr", "--json", "facts/a.json"]) == 0
    assert "bokehguide: warning: facts/a.json: cannot be written (No such file or directory)" in capsys.readouterr().err
    assert read_metadata("a.exr")["spp"] == 1


@pytest.mark.parametrize("option", ["--out", "--json", "--reference", "--logdir", "--environment"])
def test_names_that_are_too_long(option, lamps_file, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    name = "x" * 300 + (".json" if option == "--json" else ".exr")
    assert main(["render", "emitters.toml", "--spp", "1", option, name]) == 2
    error = capfd.readouterr().err
    assert error.startswith("bokehguide: error: ") and "xxx" in error and error.count("\n") == 1 and "File name too long" in error


def test_a_scene_whose_name_is_too_long(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    for suffix in (".toml", ".glb"):
        assert main(["render", "x" * 300 + suffix]) == 2
        assert "File name too long" in capfd.readouterr().err


@pytest.mark.parametrize("option", [b"--out=", b"--environment=", b"--reference=", b"--json=", b""])
def test_names_that_are_not_utf8(option, lamps_file, tmp_path):
    name = b"caf\xe9.exr" if option else b"caf\xe9.toml"
    (tmp_path / os.fsdecode(name)).write_bytes(lamps_file.read_bytes())
    scene = [b"emitters.toml"] if option else []
    finished = run(tmp_path, b"render", *scene, option + name, b"--spp", b"1")
    assert finished.returncode == 2
    assert finished.stderr == b"bokehguide: error: '" + option + name.replace(b"\xe9", b"\\udce9") + (
        b"' is no UTF-8 text; rename the file or folder\n"
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "environment",
    [
        {"PYTHONIOENCODING": "ascii"},
        {"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    ],
)
def test_encodings_without_the_characters_of_messages(environment, lamps_file, tmp_path):
    told = run(tmp_path, "info", "emitters.toml", **environment)
    assert told.returncode == 0, told.stderr
    assert b"40 deg across" in told.stdout and b"32 x 20 pixels" in told.stdout
    finished = run(tmp_path, "render", "emitters.toml", "--spp", "1", "--out", "a.exr", **environment)
    assert finished.returncode == 0, finished.stderr
    finished.stderr.decode("ascii")


ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
NEEDED = b"needs file names in UTF-8, which this environment lacks; set PYTHONUTF8=1\n"


def test_names_beyond_the_encoding_of_the_environment(lamps_file, tmp_path):
    """Of an argument, and of a file that a scene names."""
    (tmp_path / "café.toml").write_bytes(lamps_file.read_bytes())
    (tmp_path / "derived.toml").write_text('base = "café.toml"\n', encoding="utf-8")
    for name in ("café.toml", "derived.toml"):
        refused = run(tmp_path, "info", name, **ASCII)
        assert refused.returncode == 2 and refused.stderr.count(b"\n") == 1 and refused.stderr.endswith(NEEDED)
    assert run(tmp_path, "info", "derived.toml", **ASCII | {"PYTHONUTF8": "1"}).returncode == 0


@pytest.mark.slow
def test_a_table_in_an_environment_of_ascii(lamps_file, tmp_path):
    write_exr(tmp_path / "given.exr", {"beauty": np.full((20, 32, 3), 0.1, np.float32)})
    options = ("--modes", "uniform", "--spp", "2", "--reference", "given.exr", "--out", "compared")
    finished = run(tmp_path, "compare", "emitters.toml", *options, **ASCII)
    assert finished.returncode == 0, finished.stderr
    assert "±" in (tmp_path / "compared/table.md").read_text("utf-8")


def test_links_stay_and_their_targets_are_written(lamps_file, tmp_path, monkeypatch):
    """The checkpoint of a finished render goes, and the next one is written to the same place."""
    monkeypatch.chdir(tmp_path)
    Path("disk").mkdir()
    kinds = ("exr", "png", "json", "ckpt")
    for kind in kinds:
        Path(f"a.{kind}").symlink_to(f"disk/{kind}")
    command = ["render", "emitters.toml", "--mode", "uniform", "--spp", "2", "--out", "a.exr", "--json", "a.json"]
    monkeypatch.setattr("bokehguide.cli.checkpoints.INTERVAL", 1e-6)
    assert main(command) == 0
    assert all(Path(f"a.{kind}").is_symlink() for kind in kinds)
    assert sorted(path.name for path in Path("disk").iterdir()) == ["exr", "json", "png"]
    assert read_metadata("disk/exr")["spp"] == 2
    assert main([*command, "--checkpoint-every", "60"]) == 0
    assert Path("a.ckpt").is_symlink() and Path("disk/ckpt").stat().st_size > 1000


def test_an_output_that_is_no_regular_file(lamps_file, tmp_path, monkeypatch, capfd):
    """A device would be replaced by a file."""
    monkeypatch.chdir(tmp_path)
    os.mkfifo("a.json")
    assert main(["render", "emitters.toml", "--json", "a.json"]) == 2
    assert "a.json: is no regular file, and would be replaced by one" in capfd.readouterr().err


def test_pipes_in_the_place_of_files_are_not_opened(lamps_file, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe.exr")
    for option in ("--reference", "--environment"):
        assert main(["render", "emitters.toml", option, "pipe.exr"]) == 2
        assert "pipe.exr: is no regular file" in capfd.readouterr().err
    assert main(["metrics", "pipe.exr", "pipe.exr"]) == 2
    os.mkfifo("a.ckpt")
    assert main(["render", "emitters.toml", "--out", "a.exr"]) == 2
    assert "a.ckpt: is no regular file" in capfd.readouterr().err


@pytest.mark.parametrize("folder", ["a/b", "a/b/c"])
@pytest.mark.parametrize("option", ["--out", "--json", "--logdir"])
def test_folders_are_created_in_existing_ones_alone(option, folder, lamps_file, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    Path("a").mkdir()
    path = {"--logdir": folder, "--json": f"{folder}/a.json", "--out": f"{folder}/a.exr"}[option]
    code = main(["render", "emitters.toml", "--spp", "1", option, path])
    error = capfd.readouterr().err
    if folder == "a/b":
        assert code == 0 and "bokehguide: created the folder a/b\n" in error
    else:
        assert code == 2 and error == (
            "bokehguide: error: a/b/c: the folder a/b does not exist; create it, or choose another folder\n"
        )
        assert not list(Path("a").iterdir())


@pytest.mark.slow
def test_stages_are_told_as_they_begin(lamps_file, tmp_path):
    command = [*COMMAND, "render", "emitters.toml", "--spp", "2", "--out", "a.exr"]
    start = time.process_time()
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr.readline() == "bokehguide: starting\n"
        assert "torch" not in Path(f"/proc/{process.pid}/maps").read_text(), "the first line comes before the libraries"
        told = process.communicate(timeout=60)[1]
    assert process.returncode == 0 and time.process_time() - start < 5
    stages = [
        "loading emitters.toml",
        "preparing 1,292 triangles and 2 materials",
        "building the tracing structure of 1,292 triangles",
    ]
    assert re.findall("bokehguide: (.*)\n", told)[:3] == stages


def test_a_stage_beside_a_bar_has_a_line_of_its_own(capsys):
    with tqdm(total=2, file=sys.stderr):
        terminal.Stages().emit(logging.LogRecord("bokehguide", logging.INFO, "", 0, "preparing triangles", None, None))
    assert "bokehguide: preparing triangles" in re.split("[\r\n]", capsys.readouterr().err)


@pytest.mark.slow
def test_one_rank_tells_the_stages(lamps_file, tmp_path):
    finished = run(tmp_path, "render", "emitters.toml", "--mode", "none", RANK="1")
    assert finished.returncode == 2 and finished.stderr.count(b"\n") == 1


def test_the_time_limit_counts_loading(lamps_file, tmp_path, capsys, monkeypatch):
    """One step is always taken."""
    monkeypatch.chdir(tmp_path)
    options = parse(["render", "emitters.toml", "--spp", "50", "--out", "a.exr", "--time-limit", "99"])
    options.started -= 100.0
    assert render.run(options) == 0
    assert re.search(r"stopped: --time-limit 99 passed within 10\d\.\d s of loading and the first step", capsys.readouterr().out)
    assert read_metadata("a.exr")["spp"] == 1


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_streams(closed, lamps_file, tmp_path):
    finished = run(tmp_path, "render", "emitters.toml", "--spp", "2", "--out", "a.exr", shell=closed)
    assert finished.returncode == 0 and b"Traceback" not in finished.stderr
    assert (b"wrote a.exr" in finished.stdout, b"2/2" in finished.stderr) == (">&-" not in closed.split(), "2>&-" not in closed)
    assert read_metadata(tmp_path / "a.exr")["spp"] == 2 and (tmp_path / "a.png").exists()


def test_a_system_without_the_modules_of_unix(lamps_file, tmp_path):
    """As Windows, which lacks them: no lock, and no peak memory in the summary."""
    hide = "import sys; sys.modules |= {'fcntl': None, 'resource': None}; from bokehguide.cli import main; sys.exit(main())"
    command = ["render", str(lamps_file), "--spp", "1", "--out", "a.exr", "--json", "a.json"]
    finished = subprocess.run([sys.executable, "-c", hide, *command], cwd=tmp_path, capture_output=True, text=True)
    assert finished.returncode == 0 and read_metadata(tmp_path / "a.exr")["spp"] == 1, finished.stderr
    assert json.loads((tmp_path / "a.json").read_text())["peak_memory_mb"] is None


def test_the_list_of_scenes_on_closed_streams(tmp_path):
    finished = run(tmp_path, "scenes", shell=">&-")
    assert (finished.returncode, finished.stderr) == (0, b"")


def test_a_pipe_that_its_reader_closes(lamps_file, tmp_path):
    """stdout and stderr go to the same pipe."""
    command = [*COMMAND, "render", "emitters.toml", "--spp", "8", "--out", "a.exr"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        assert process.stdout.readline() == b"bokehguide: starting\n"
        process.stdout.close()
        assert process.wait(timeout=60) == 141


PYTHON = "import bokehguide; bokehguide.render('emitters.toml', spp=2)"
RENDER = "render emitters.toml --spp 2 --out a.exr"
COMPARE = "compare emitters.toml --modes guided --spp 2 --reference given.exr --out out"


@pytest.mark.parametrize(
    "command",
    [[*COMMAND, *RENDER.split()], [*COMMAND, *COMPARE.split()], [sys.executable, "-c", PYTHON]],
    ids=["render", "compare", "Python"],
)
def test_the_bar_in_a_terminal_without_a_size(command, lamps_file, tmp_path):
    write_exr(tmp_path / "given.exr", {"beauty": np.full((20, 32, 3), 0.1, np.float32)})
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 0, 0, 0, 0))
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=theirs) as process:
        os.close(theirs)
        told = b""
        try:
            while part := os.read(ours, 4096):
                told += part
        except OSError:  # the end of a terminal
            os.close(ours)
    assert process.returncode == 0 and b"emitters guided: 100%" in told and b" 2/2 " in told
