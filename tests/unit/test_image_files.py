"""Files appear whole or not at all."""

import subprocess
import sys

import pytest

from bokehguide.errors import BokehguideError
from bokehguide.image.files import check_writable, remove_abandoned, replacing


def test_a_block_that_fails_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(KeyError), replacing(path) as temporary:
        temporary.write_text("half of the n")
        raise KeyError
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_old_file_stands_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with replacing(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_trial_makes_the_folder_and_leaves_no_file(tmp_path):
    check_writable(tmp_path / "deep" / "er" / "a.txt")
    assert (tmp_path / "deep" / "er").is_dir()
    assert not list((tmp_path / "deep" / "er").iterdir())
    with pytest.raises(BokehguideError, match="deep: is a folder; give the path of a file in it"):
        check_writable(tmp_path / "deep")


def test_what_a_killed_writer_left_is_removed_and_what_is_being_written_is_not(tmp_path):
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    path = tmp_path / "a[1].txt"
    left, other = tmp_path / f".a[1].txt.{ended.pid}.tmp", tmp_path / f".a1.txt.{ended.pid}.tmp"
    left.touch()
    other.touch()
    with replacing(path) as temporary:
        temporary.write_text("new")
        remove_abandoned(path)
    assert path.read_text() == "new"
    assert sorted(tmp_path.iterdir()) == sorted([path, other])
