"""The script that renders every figure and table of the documentation."""

import json
import subprocess
import sys

import ablations
import pytest
import result_items
import results
from PIL import Image

from tests.support.paths import REPOSITORY

ITEMS = {item.name: item for item in result_items.ITEMS}


@pytest.mark.slow
def test_an_item_is_rendered_stamped_and_then_kept(tmp_path):
    command = [sys.executable, str(REPOSITORY / "scripts/results.py"), "--setting", "smoke", "--only", "fig7"]
    command += ["--out", str(tmp_path / "out"), "--docs", str(tmp_path / "docs")]
    finished = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout == "fig7: scripts/figures/fig7.py chrome --size 16x9 --spp 2\n"
    (path,) = tmp_path.glob("out/smoke/*/fig7/stamp.json")
    stamp = json.loads(path.read_text())
    assert stamp["command"] == ["scripts/figures/fig7.py", "chrome", "--size", "16x9", "--spp", "2"] and stamp["seconds"] > 0.0
    text = (tmp_path / "docs/figures-fig7.md").read_text()
    assert "![fig7](fig7.webp)" in text and "| lis-o | 2 |" in text
    assert f"Commit `{stamp['commit']}`, setting `smoke`, {stamp['machine']}" in text
    assert "python scripts/figures/fig7.py chrome --size 16x9 --spp 2" in text and str(tmp_path) not in text
    with Image.open(tmp_path / "docs/fig7.webp") as picture:
        assert picture.width == results.PICTURE_WIDTH
    pages = {page.name for page in (tmp_path / "docs").glob("*.md")}
    assert pages == {item.page for item in ITEMS.values()}, "every item has a page"

    again = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (again.returncode, again.stdout, again.stderr) == (0, "fig7: kept\n", "")
    assert (tmp_path / "docs/figures-fig7.md").read_text() == text


@pytest.mark.slow
@pytest.mark.parametrize("name", ["speed", "profile"])
def test_the_smallest_setting_of_measurements_succeeds(name, tmp_path):
    assert results.finish(ITEMS[name], "smoke", tmp_path, tmp_path / "docs")


@pytest.mark.parametrize("path", ["bokehguide/one.py", "native/one.h", "native/one.cpp"])
def test_results_of_other_sources_are_not_kept(tmp_path, monkeypatch, path):
    monkeypatch.setattr(results, "REPOSITORY", tmp_path)
    monkeypatch.setattr(results, "SOURCES", ("bokehguide", "native"))
    (tmp_path / path).parent.mkdir()
    (tmp_path / path).write_text("first")
    before = results.sources_digest()
    (tmp_path / path).write_text("second")
    assert results.sources_digest() != before


@pytest.mark.slow
def test_a_failure_leaves_no_stamp(tmp_path, capfd):
    broken = result_items.Item("broken", "Broken", "", "bench.py", smoke="--size 0x0", output=False, cache=False)
    assert not results.finish(broken, "smoke", tmp_path, tmp_path / "docs")
    assert "'0x0' is not a size" in capfd.readouterr().err
    assert not (tmp_path / "broken/stamp.json").exists() and not (tmp_path / "docs").exists()


def test_pages_and_pictures_of_no_item_are_removed(tmp_path):
    for name in ("index.md", "tables-seeds.md", "tables-gone.md"):
        (tmp_path / name).write_text("![](shown.webp)" if name == "index.md" else "")
    for name in ("shown.webp", "gone.webp"):
        (tmp_path / name).touch()
    results.remove_unused(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"index.md", "tables-seeds.md", "shown.webp"}


@pytest.mark.parametrize("item", result_items.ITEMS, ids=lambda item: item.name)
def test_items_name_what_exists(item):
    assert (REPOSITORY / "scripts" / item.script).is_file()
    for setting in result_items.SETTINGS:
        options = item.options(setting) or []
        if "--only" in options:
            ablations.names(options[options.index("--only") + 1])


def test_names_are_checked():
    assert results.items("seeds,fig6") == [ITEMS["seeds"], ITEMS["fig6"]]
    with pytest.raises(results.argparse.ArgumentTypeError, match="'fig5' is no figure or table; choose from fig6, "):
        results.items("fig5")
