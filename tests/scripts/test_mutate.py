"""The audit of the tests distinguishes killed, surviving and invalid mutations."""

import subprocess
import sys

import pytest

from tests.support.paths import REPOSITORY

pytestmark = pytest.mark.slow

LIST = """
[[mutation]]
name = 'indices of the other entries'
file = 'bokehguide/runtime/indexing.py'
old = 'np.flatnonzero(mask.numpy())'
new = 'np.flatnonzero(~mask.numpy())'
tests = ['tests/unit/test_runtime_indexing.py']

[[mutation]]
name = 'no change of meaning'
file = 'bokehguide/runtime/indexing.py'
old = 'np.flatnonzero(mask.numpy())'
new = 'np.flatnonzero(mask.numpy() != 0)'
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
    assert "| indices of the other entries | bokehguide/runtime/indexing.py | killed |" in finished.stdout
    assert "3 mutations: 1 killed, 1 survived, 1 invalid" in finished.stdout
