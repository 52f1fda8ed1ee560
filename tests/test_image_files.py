"""Files appear whole or not at all."""

import pytest

from bokehguide.errors import BokehguideError
from bokehguide.image.files import check_writable, replacing


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
