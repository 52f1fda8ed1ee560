"""Damaged files of every format, by hypothesis: refused in a line or two, or rendered, within a bound of memory and time."""

import json
import subprocess
import sys

import fuzz
import pytest
from fuzzing.damage import Damage, damaged
from fuzzing.trial import Fault, check_message

from tests.support.paths import REPOSITORY

SCRIPT = REPOSITORY / "scripts/fuzz.py"
CASES = 60


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory):
    """What the script tells of a few cases of each format, always the same ones."""
    folder = tmp_path_factory.mktemp("fuzz")
    command = [sys.executable, str(SCRIPT), "--cases", str(CASES), "--seed", "1", "--together"]
    finished = subprocess.run([*command, "--json", "a.json"], cwd=folder, capture_output=True, text=True, timeout=600)
    return finished, json.loads((folder / "a.json").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("name", fuzz.FORMATS)
def test_damaged_files(fuzzed, name):
    finished, tallies = fuzzed
    tally = tallies[name]
    assert not tally["failures"], "\n".join(tally["failures"])
    assert tally["cases"] == tally["loaded"] + tally["refused"] >= CASES
    assert tally["loaded"] > 0 and tally["refused"] > 0, "the damage is neither harmless nor always the same"
    assert f"| {name} | {tally['cases']} | {tally['loaded']} | {tally['refused']} | 0 |" in finished.stdout
    assert finished.returncode == 0


def run_worker(tmp_path, monkeypatch, capsys, code: str) -> list[str]:
    """The failures of a batch in whose process every trial runs `code`."""
    (tmp_path / "sitecustomize.py").write_text(
        "import sys, types\nmodule = types.ModuleType('fuzzing.trial')\n"
        f"def trial(path):\n    if sys._getframe(1).f_code.co_name == 'work':\n        return True\n    {code}\n"
        "module.trial = trial\nsys.modules['fuzzing.trial'] = module\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    options = ["--cases", "3", "--seconds", "2", "--out", str(tmp_path / "out"), "--json", str(tmp_path / "a.json")]
    monkeypatch.setattr(sys, "argv", ["fuzz.py", "stl", *options])
    assert fuzz.main() == 1
    assert "| stl | 3 |" in capsys.readouterr().out
    return json.loads((tmp_path / "a.json").read_text())["stl"]["failures"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "told"),
    [
        ("raise RuntimeError('what a reader let through')", "RuntimeError: what a reader let through"),
        ("bytearray(4 * 2**30)", "MemoryError"),
        ("import os; os.abort()", "the process died (-6)"),
        ("import time; time.sleep(60)", "Timeout (0:00:02)"),
    ],
)
def test_the_script_sees_what_must_not_be(tmp_path, monkeypatch, capsys, code, told):
    assert told in run_worker(tmp_path, monkeypatch, capsys, code)[0]
    assert any((tmp_path / "out").iterdir())


@pytest.mark.parametrize("text", ["no file", "{}: a\nb\nc", "{}: \x1b[2J", "{}: " + "x" * 2000, "{}: MemoryError", ""])
def test_messages_that_are_faults(tmp_path, text):
    check_message(f"{tmp_path}/a.toml: camera.fov: 190 is out of range", tmp_path / "a.toml")
    with pytest.raises(Fault):
        check_message(text.format(tmp_path / "a.toml"), tmp_path / "a.toml")


def test_damage_is_the_same_every_time():
    data = b'{"a": [1, 2, {"b": 3}]}'
    for kind in ("flip", "cut", "leave_out", "insert", "repeat", "word", "token", "line", "json_value"):
        results = [damaged(data, [Damage(kind, 12345, what)]) for what in range(20) for _ in range(2)]
        assert results[::2] == results[1::2] and len({*results}) > (1 if kind != "cut" else 0), kind
        assert any(result != data for result in results), kind
