"""The audit of the tests tells killed mutations from those that survive."""

import subprocess
import sys

import pytest

from tests.support.paths import REPOSITORY

pytestmark = pytest.mark.slow

LIST = """
[[mutation]]
name = 'rows count as tiles'
file = 'bokehguide/runtime/indexing.py'
old = 'return rows * -(-width // side) + columns'
new = 'return rows * width + columns'
tests = ['tests/unit/test_runtime_indexing.py']

[[mutation]]
name = 'no change of meaning'
file = 'bokehguide/runtime/indexing.py'
old = 'return rows * -(-width // side) + columns'
new = 'return columns + rows * -(-width // side)'
tests = ['tests/unit/test_runtime_indexing.py']

[[mutation]]
name = 'a text that is gone'
file = 'bokehguide/runtime/indexing.py'
old = 'this text occurs nowhere'
new = ''
tests = ['tests/unit/test_runtime_indexing.py']
"""


def test_outcomes_of_mutations(tmp_path):
    """The tests must import the mutated copy, also where the package is installed in editable mode."""
    (tmp_path / "list.toml").write_text(LIST)
    command = [sys.executable, REPOSITORY / "scripts/mutate.py", "--list", tmp_path / "list.toml"]
    finished = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert finished.returncode == 1, finished.stderr
    assert "| rows count as tiles | bokehguide/runtime/indexing.py | killed |" in finished.stdout
    assert "3 mutations: 1 killed, 1 survived, 1 invalid" in finished.stdout
