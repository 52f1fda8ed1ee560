"""A lack of memory, before or during a render, causes one line that names the part that is too large."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.cli.memory import check_memory, explained, least_memory
from bokehguide.errors import BokehguideError
from bokehguide.memory import free_memory
from bokehguide.scene.types import FilmSettings, Texture
from bokehguide.train import RenderSettings
from tests.support.scenes import emitters


def test_errors_of_memory_are_explained():
    for allocate in (torch.empty, np.empty):
        said = r"^memory ran out \(.+\): a picture is too large for this machine; lower"
        with pytest.raises(BokehguideError, match=said), explained("a picture"):
            allocate(2**52)
    with pytest.raises(BokehguideError, match=r"\(MemoryError\): the scene is"), explained():
        raise MemoryError
    with pytest.raises(BokehguideError, match=r"\(1.2e\+09 GB more were needed\)"), explained():
        torch.empty(2**60, dtype=torch.uint8)


def test_other_errors_pass():
    with pytest.raises(RuntimeError, match="another"), explained():
        raise RuntimeError("another")


def test_the_estimate_grows_with_all_that_takes_memory():
    scene, settings = emitters(320, 200), RenderSettings("uniform")
    least = least_memory(scene, settings)
    assert 250 * 320 * 200 < least < 2e7 + 250 * 320 * 200
    assert least_memory(scene, replace(settings, target_noise=0.1)) == least + 250 * 320 * 200
    assert least_memory(scene, replace(settings, crop=(0, 0, 10, 10))) < least
    image = np.zeros((100, 100, 3), np.float32)
    textured = [replace(material, base_color_texture=Texture(image)) for material in scene.materials]
    assert least_memory(replace(scene, materials=tuple(textured)), settings) == least + 20 * 10_000


def test_a_picture_that_needs_more_than_is_free(monkeypatch):
    scene = replace(emitters(32, 20), film=FilmSettings(16000, 16000))
    monkeypatch.setattr("bokehguide.memory.free_memory", lambda: 10**10)
    with pytest.raises(
        BokehguideError, match=r"^memory: a picture of 16000x16000 pixels with .* at least 64.\d GB, and 10.0 GB are free"
    ):
        check_memory(scene, RenderSettings("uniform"))
    check_memory(emitters(32, 20), RenderSettings("uniform"))
    monkeypatch.setattr("bokehguide.memory.free_memory", lambda: None)
    check_memory(scene, RenderSettings("uniform"))


def test_free_memory_is_the_least_of_machine_and_group(tmp_path):
    (tmp_path / "proc").mkdir()
    (tmp_path / "sys/fs/cgroup").mkdir(parents=True)
    assert free_memory(tmp_path) is None
    (tmp_path / "proc/meminfo").write_text("MemTotal: 9000 kB\nMemAvailable:    3000 kB\n")
    assert free_memory(tmp_path) == 3000 * 1024
    (tmp_path / "sys/fs/cgroup/memory.max").write_text("max\n")
    (tmp_path / "sys/fs/cgroup/memory.current").write_text("1000\n")
    assert free_memory(tmp_path) == 3000 * 1024
    (tmp_path / "sys/fs/cgroup/memory.max").write_text("5000\n")
    assert free_memory(tmp_path) == 4000
    (tmp_path / "sys/fs/cgroup/memory.stat").write_text("anon 100\nfile 900\ninactive_file 500\nactive_file 300\nslab 9\n")
    assert free_memory(tmp_path) == 4800, "the cache of files gives way"
