"""Files appear whole or not at all."""

import subprocess
import sys
from pathlib import Path

import pytest

from bokehguide.errors import BokehguideError
from bokehguide.image.files import check_writable, remove_abandoned, replacing, write_text


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


def test_a_text_is_replaced_in_utf_8(tmp_path):
    path = tmp_path / "a.md"
    for text in ("older and longer", "β\n"):
        write_text(path, text)
    assert path.read_bytes() == "β\n".encode() and list(tmp_path.iterdir()) == [path]


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


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_told_with_the_name_of_the_file_and_a_remedy(tmp_path):
    told = r"/a\.txt: cannot be written \(No space left on device\); free some space, or choose another folder$"
    with pytest.raises(BokehguideError, match=told), replacing(tmp_path / "a.txt") as temporary:
        temporary.symlink_to("/dev/full")
        temporary.write_text("new")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("old", ["old", None])
def test_the_target_of_a_link_is_written_and_the_link_stays(old, tmp_path):
    target, link = tmp_path / "deep" / "b.txt", tmp_path / "a.txt"
    target.parent.mkdir()
    if old is not None:
        target.write_text(old)
    link.symlink_to("deep/b.txt")
    check_writable(link)
    with replacing(link) as temporary:
        temporary.write_text("new")
        assert temporary.parent.samefile(target.parent), "on another disk, the last step would not be atomic"
        assert target.exists() == (old is not None)
    assert link.is_symlink() and target.read_text() == "new"
    assert list(target.parent.iterdir()) == [target]


def test_a_link_into_a_missing_folder_is_told_at_once(tmp_path):
    (tmp_path / "a.txt").symlink_to("missing/b.txt")
    with pytest.raises(BokehguideError, match=r"/a\.txt: cannot be written \(No such file or directory\); create the folder, or"):
        check_writable(tmp_path / "a.txt")


def test_what_a_killed_writer_left_beside_the_target_of_a_link_is_removed(tmp_path):
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / f".b.txt.{ended.pid}.tmp").touch()
    (tmp_path / "a.txt").symlink_to("deep/b.txt")
    remove_abandoned(tmp_path / "a.txt")
    assert not list((tmp_path / "deep").iterdir())
