"""Compiled kernels against the functions they are made of."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import chisquare

from bokehguide.image.exr import read_rgb
from bokehguide.render.lights.alias_table import AliasTable
from bokehguide.runtime.compile import compiling, kernels
from bokehguide.runtime.native import SWITCH
from bokehguide.scene.shapes import transform, transformed, unit_rectangle
from bokehguide.scene.types import Environment, Material
from bokehguide.train import RenderLoop, RenderSettings
from tests.support import scenes

pytestmark = pytest.mark.slow  # most of these tests compile kernels

STEPS = 3
needs_a_compiler = pytest.mark.skipif(not any(map(shutil.which, ("g++", "clang++", "c++"))), reason="no C++ compiler")


@pytest.fixture(autouse=True, scope="module")
def own_cache(tmp_path_factory):
    """Kernels are kept in a folder that the tests of this file share. The native core, which needs no kernels, is off."""
    with pytest.MonkeyPatch.context() as patch:
        cache = tmp_path_factory.mktemp("cache")
        patch.setenv("XDG_CACHE_HOME", str(cache))
        patch.setenv(SWITCH, "0")
        yield cache / "bokehguide" / "kernels"


@pytest.fixture
def folder(own_cache) -> Iterator[Path]:
    """The folder of compiled kernels; the test's thread compiles kernels."""
    with kernels.compile_kernels(2):
        yield own_cache


def scene():
    """Emitters, a parallelogram and a map with a peak over a floor."""
    radiance = np.full((64, 128, 3), 0.05, np.float32)
    radiance[30:32, 62:64] = 100.0
    emitters = scenes.emitters(48, 27)
    parallelogram = replace(
        transformed(unit_rectangle(), transform((0.3, 0.1, -5.0), (0.0, 20.0, 0.0), (0.2, 0.1, 1.0))), material=0
    )
    floor = replace(
        transformed(unit_rectangle(), transform((0.0, -0.3, -4.0), (-90.0, 0.0, 0.0), 5.0)), material=len(emitters.materials)
    )
    materials = (*emitters.materials, Material("floor", (0.5, 0.4, 0.3), roughness=0.4, clearcoat=0.5))
    meshes, film = (*emitters.meshes, parallelogram, floor), replace(emitters.film, max_depth=3)
    return replace(emitters, meshes=meshes, materials=materials, environment=Environment(radiance), film=film)


def rendered(compiled: bool, threads: int = 1) -> torch.Tensor:
    loop = RenderLoop(scene(), RenderSettings("guided", threads=threads, compile=compiled))
    for _ in range(STEPS):
        loop.step()
    return loop.film.radiance()


@pytest.fixture(scope="module")
def calls():
    """The arguments of one call of every variant of a kernel that the scene has, by name and key."""
    found = {}
    call = kernels._Kernel.__call__

    def record_samples(self, *arguments):
        tensors, marks = [], []
        kernels._flatten(arguments, tensors, marks)
        large = found.get((self._function.__qualname__, repr(marks)))
        if large is None or tensors[-1].numel() > large[2]:
            copied = kernels._rebuilt(arguments, iter([tensor.clone() for tensor in tensors]))
            found[self._function.__qualname__, repr(marks)] = (self, copied, tensors[-1].numel())
        return call(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels._Kernel, "__call__", record_samples)
        rendered(compiled=False)
    return [(name, self, arguments) for (name, _), (self, arguments, _) in found.items()]


def tensors_of(value: object) -> list[torch.Tensor]:
    tensors: list[torch.Tensor] = []
    kernels._flatten(value, tensors, [])
    return tensors


@needs_a_compiler
def test_all_agree_with_the_functions(calls, capsys, folder):
    """Whole numbers to the bit, others to rounding."""
    assert len({name for name, _, _ in calls}) >= 15
    for name, made, arguments in calls:
        with torch.no_grad():
            expected, found = tensors_of(made._function(*arguments)), tensors_of(made(*arguments))
        assert len(expected) == len(found)
        for one, other in zip(expected, found):
            assert one.shape == other.shape and one.dtype == other.dtype, name
            if not one.is_floating_point():
                assert float((one == other).float().mean()) > 0.999, name  # of comparisons, some at the very edge
            else:
                scale = one.abs().clamp(min=1e-3 * float(one.abs().nan_to_num(0.0, 0.0, 0.0).mean()) + 1e-12)
                apart = ((one - other).abs() / scale).nan_to_num(0.0)
                assert float((apart > 1e-3).float().mean()) < 1e-2, name  # small differences of large numbers
    assert "is not compiled" not in capsys.readouterr().err


@kernels.kernel
def sum_and_product(one: torch.Tensor, other: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return one + other, one * other


@needs_a_compiler
def test_arguments_that_were_the_same_the_first_time_need_not_be_so_again(folder):
    """And sizes may change, down to 1 and 0; a batch of one is not worth a compilation, which takes seconds."""
    sum_and_product(*[torch.arange(5.0)] * 2)
    for size in (7, 1, 0, 100_000):
        one, other = torch.rand(2, 3, size, generator=torch.Generator().manual_seed(size))[:, 0]
        for found, expected in zip(sum_and_product(one, other), (one + other, one * other)):
            assert torch.equal(found, expected)
    assert [type(variant).__name__ for variant in sum_and_product._variants.values()] == ["_Variant", "_AsTwo"]


@needs_a_compiler
def test_one_path_alone_gives_the_same_bits_as_among_others(calls, folder):
    """Or the bits of a picture would depend on how its pixels are cut into batches."""
    tried = 0
    for name, made, arguments in calls:
        made(*arguments)
        variant = next((each for each in made._variants.values() if type(each).__name__ == "_Variant"), None)
        tensors = tensors_of(arguments)
        batched = [tensor.shape[-1:] == tensors_of(made(*arguments))[0].shape[-1:] for tensor in tensors]
        assert variant is not None and any(batched), name
        for place in (0, 1, 7, 20):
            parts = [tensor[..., place : place + 1] if whole else tensor for tensor, whole in zip(tensors, batched)]
            alone = made(*kernels._rebuilt(arguments, iter(parts)))
            for one, whole in zip(tensors_of(alone), tensors_of(made(*arguments))):
                assert torch.equal(one.nan_to_num(7.0), whole[..., place : place + 1].nan_to_num(7.0)), name
                tried += 1
    assert tried > 100


@needs_a_compiler
def test_threads_run_kernels_side_by_side(folder):
    """While one runs, Python goes on: it does not hold the lock."""
    large = torch.rand(2, 20_000_000)
    sum_and_product(*large)
    ticks, done = [], threading.Event()

    def tick():
        while not done.is_set():
            ticks.append(time.perf_counter())
            time.sleep(0.0001)

    other = threading.Thread(target=tick)
    other.start()
    start = time.perf_counter()
    sum_and_product(*large)
    end = time.perf_counter()
    done.set()
    other.join()
    assert sum(start < moment < end for moment in ticks) > 5


HEADERS = """
import os, sys
from pathlib import Path
import torch
from bokehguide.runtime.compile import compiling, kernels
from bokehguide.runtime.native import SWITCH

@kernels.kernel
def difference(one, other):
    return one - other

searched, compile_one = [], compiling._package
def record_samples(*arguments):
    searched.append(os.environ["CPLUS_INCLUDE_PATH"])
    compile_one(*arguments)

compiling._package, compiling.HEADERS = record_samples, Path(sys.argv[1])
with kernels.compile_kernels(1):
    assert torch.equal(difference(torch.ones(9), torch.zeros(9)), torch.ones(9))
assert [type(variant).__name__ for variant in difference._variants.values()] == ["_Variant"]
assert os.environ["CPLUS_INCLUDE_PATH"] == "before"
print(*searched)
"""


@needs_a_compiler
@pytest.mark.parametrize("useful", [True, False])
def test_our_headers_are_used_and_not_needed(useful, tmp_path):
    """The compiler's own are, where ours do not do: as with a PyTorch that asks more of them. Each in a process that has
    compiled nothing before."""
    folder = compiling.HEADERS if useful else tmp_path
    (tmp_path / "regex").write_text("#error of no use\n")
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "CPLUS_INCLUDE_PATH": "before"}
    command = [sys.executable, "-c", HEADERS, str(folder)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "is not compiled" not in done.stderr, done.stderr
    assert done.stdout.split() == [f"{folder}{os.pathsep}before"] + ["before"] * (not useful)


DEVICES = r"""
#include <iostream>
#include <regex>
int main(int count, char** names) {
  const std::regex device("(cpu|cuda|xpu|mps)(:([0-9]+))?");
  for (int i = 1; i < count; ++i) {
    const std::string name = names[i];
    std::smatch match;
    if (std::regex_match(name, match, device))
      std::cout << match[0].str() << ' ' << match[1].str() << ' ' << match[2].str() << ' ' << match[3].matched << match[3].str();
    std::cout << '\n';
  }
}
"""


@needs_a_compiler
def test_our_regex_takes_devices_apart_as_the_standard_one(tmp_path):
    compiler = next(filter(None, map(shutil.which, ("g++", "clang++", "c++"))))
    names = ("cpu", "cuda", "cuda:1", "xpu:12", "mps:0", "cpu:", "cpu:x", "cpu:-1", "cuda:1:2", "cuda:1x")
    (tmp_path / "devices.cpp").write_text(DEVICES)
    found = []
    for headers in ((), ("-isystem", str(compiling.HEADERS))):
        program = tmp_path / f"devices{len(found)}"
        subprocess.run(
            [compiler, "-std=c++20", *headers, "-o", str(program), str(tmp_path / "devices.cpp")], check=True, timeout=120
        )
        found.append(subprocess.run([str(program), *names], check=True, capture_output=True, text=True, timeout=10).stdout)
    assert found[0] == found[1] and found[0].count("\n") == len(names) and "cuda:1 cuda :1 11\n" in found[0]


@kernels.kernel
def by_length(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    return one * len(other)


@needs_a_compiler
def test_what_depends_on_a_size_is_not_compiled(capsys, folder):
    """`len` is a number to the compiler, and that of the first call would stay."""
    for size in (50, 20):
        assert torch.equal(by_length(torch.ones(7), torch.ones(size)), torch.full((7,), float(size)))
    assert "by_length is not compiled (its code depends on the size 50 of an argument)" in capsys.readouterr().err


@needs_a_compiler
def test_tables_of_other_sizes_are_drawn_from_alike(folder):
    """One kernel serves maps of all sizes: what was compiled with the first must not hold on to its size."""
    for size in (50, 4000, 7):
        weights, uniforms = np.random.default_rng(size).random(size), torch.rand(2, 100_000)
        drawn = torch.bincount(AliasTable(weights, "cpu").sample(uniforms), minlength=size)
        assert chisquare(drawn.numpy(), 100_000 * weights / weights.sum()).pvalue > 1e-4


@needs_a_compiler
def test_random_numbers_are_the_same_to_the_bit(calls, folder):
    found = set()
    for name, made, arguments in calls:
        if name in ("_uniform", "_scrambled"):
            found.add(name)
            for one, other in zip(tensors_of(made._function(*arguments)), tensors_of(made(*arguments))):
                assert torch.equal(one, other)
    assert len(found) == 2


@needs_a_compiler
def test_the_picture_is_the_same_but_for_rounding_and_threads_change_no_bit(monkeypatch):
    monkeypatch.setattr("bokehguide.train.scheduler.SMALL_BATCH", 40)
    alone, eager = rendered(True), rendered(False)
    for threads in (2, 3, 24):
        assert torch.equal(alone, rendered(True, threads))
    assert not torch.equal(alone, eager)  # or nothing was compiled
    apart = (alone - eager).abs() / (eager + 0.01)
    assert float((apart > 0.01).float().mean()) < 0.01


@needs_a_compiler
def test_what_is_compiled_is_kept(calls, folder):
    """The second time no file is written."""
    for _, made, arguments in calls:
        made(*arguments)
    kept = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    for _, made, arguments in calls:
        made._variants.clear()
        made(*arguments)
    assert kept and kept == {path: path.stat().st_mtime_ns for path in folder.iterdir()}


@needs_a_compiler
def test_a_damaged_file_is_reported_and_removed(calls, capsys, folder):
    _, made, arguments = next(call for call in calls if call[0] == "_target")
    made(*arguments)
    for path in folder.iterdir():
        if "._target-" in path.name:
            path.write_bytes(b"no package")
    made._variants.clear()
    for one, other in zip(tensors_of(made._function(*arguments)), tensors_of(made(*arguments))):
        assert torch.equal(one, other)
    assert "_target is not compiled" in capsys.readouterr().err
    made._variants.clear()
    made(*arguments)
    assert next(iter(made._variants.values())) is not None


def test_a_folder_that_cannot_be_is_told_and_no_traceback(tmp_path, calls, capsys):
    """A file stands where the folder should be."""
    (tmp_path / "file").write_text("")
    _, made, arguments = next(call for call in calls if call[0] == "_target")
    made._variants.clear()
    with kernels.compile_kernels(2, tmp_path / "file" / "kernels"):
        found = tensors_of(made(*arguments))
    assert all(map(torch.equal, found, tensors_of(made._function(*arguments))))
    made._variants.clear()
    assert "_target is not compiled" in capsys.readouterr().err


def test_without_a_compiler_it_renders_all_the_same(tmp_path):
    """One line says so, and the picture is that of no `--compile`, to the bit."""
    environment = {**os.environ, "PATH": "", "CXX": "/no/such/compiler", "XDG_CACHE_HOME": str(tmp_path)}
    common = ["render", "cutout", "--size", "32x18", "--spp", "2", "--mode", "uniform", "--threads", "1", "--out"]
    for name, extra in (("with", ["--compile"]), ("without", [])):
        command = [sys.executable, "-m", "bokehguide", *common, str(tmp_path / f"{name}.exr"), *extra]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        assert done.stderr.count("no C++ compiler") == (name == "with")
        assert "is not compiled (" not in done.stderr and "Traceback" not in done.stderr
    pictures = [read_rgb(tmp_path / f"{name}.exr") for name in ("with", "without")]
    np.testing.assert_array_equal(*pictures)
