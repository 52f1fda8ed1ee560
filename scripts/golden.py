"""Golden hashes: whether films and learned states of small renders are unchanged to the bit.

    python scripts/golden.py --write scripts/golden.json
    python scripts/golden.py --check scripts/golden.json
    python scripts/golden.py --check scripts/golden.json --only "adaptive*"

The check lists the cases that differ and exits with 1. Hashes hold for one kind of processor and one version of each
library; the check tells where these differ. The number of threads changes no hash, nor do names in the state of a loop.
Hashes are those of the PyTorch code, without the native core.
Of the package's names, only `golden_scenes.py` and the functions down to `by_command` know any.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from fnmatch import fnmatch
from functools import partial
from pathlib import Path

import numpy as np
import torch
from golden_scenes import make_scene

import bokehguide
from bokehguide.image import read_exr
from bokehguide.runtime.native import SWITCH
from bokehguide.train import RenderSettings, make_loop

MODES = ("uniform", "lis", "lis-b", "lis-o", "guided", "area-restir", "area-restir+lis")
SCENES = ("fairy-lights", "chrome", "sunlit-street")
STEPS = {"lis-o": 10, "guided": 6, "area-restir": 2, "area-restir+lis": 2}
"""Steps of each mode, by default 4; lis-o learns offsets from the ninth step on."""
SIZE, SMALL = (64, 36), (32, 18)
Hashes = dict[str, str]


def start(scene: str, size: tuple[int, int], threads: int, mode: str, **settings: object) -> object:
    """A loop that has taken no step. settings: crop, target_noise."""
    return make_loop(make_scene(scene, size), RenderSettings(mode, threads=threads, reuse_radius=4.0, seed=5, **settings))


def take_steps(loop: object, count: int) -> None:
    for _ in range(count):
        loop.step()


def resumed(loop: object, other: object) -> object:
    """The loop `other`, in the state of `loop`."""
    other.load_state_dict(deepcopy(loop.state_dict()))
    return other


def film_layers(loop: object) -> Mapping[str, np.ndarray]:
    return loop.picture().layers()


def state_values(state: object) -> Iterator[object]:
    """The tensors and numbers within the state of a loop, but for seconds."""
    if isinstance(state, Mapping):
        state = [value for name, value in state.items() if name != "phases"]
    if isinstance(state, (list, tuple, set)):
        for value in state:
            yield from state_values(value)
    elif state is not None and not isinstance(state, str):
        yield state


def by_command(threads: int, ranks: int, scene: str, mode: str) -> Hashes:
    """Hashes of the files of the command line. The bits depend on the number of ranks (processes that share the work)."""
    many = ("torch.distributed.run", "--standalone", "--nproc-per-node", ranks, "-m") if ranks > 1 else ()
    options = ("--spp", STEPS[mode], "--size", "{}x{}".format(*SIZE), "--threads", threads, "--seed", 5, "--out", "a.exr")
    options += ("--checkpoint-every", 3600)  # a render that ends by itself leaves no other checkpoint
    command = (sys.executable, "-m", *many, "bokehguide", "render", scene, "--mode", mode, *options)
    paths = {"PYTHONPATH": str(Path(bokehguide.__file__).parent.parent), "OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(list(map(str, command)), cwd=folder, env=os.environ | paths, check=True, capture_output=True, timeout=120)
        state = torch.load(Path(folder, "a.ckpt"), weights_only=False)["loop"]
        return hashes(read_exr(Path(folder, "a.exr")), state)


def sha(*parts: object) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part if isinstance(part, bytes) else repr(part).encode())
    return digest.hexdigest()


def array_sha(values: object) -> str:
    """The hash of an array or a tensor with its type and shape, or of a number with its type.

    Doubles in arrays count in single precision. Many are sums over batches, and the cuts between batches depend on time.
    """
    if isinstance(values, torch.Tensor):
        values = values.detach().cpu().numpy()
    if isinstance(values, np.ndarray):
        rounded = values.astype(np.float32) if values.dtype == np.float64 else values
        return sha(str(values.dtype), values.shape, np.ascontiguousarray(rounded).tobytes())
    return sha(type(values).__name__, values)


def hashes(layers: Mapping[str, np.ndarray], state: object) -> Hashes:
    """Of the film, by the names of its layers, and of the state, whatever its names and their order."""
    film = sha(*((name, array_sha(layers[name])) for name in sorted(layers)))
    return {"film": film, "state": sha(*sorted(map(array_sha, state_values(state))))}


def rendered(threads: int, scene: str, mode: str, size: tuple = SIZE, steps: int = 0, stop: int = 0, **settings) -> Hashes:
    """Hashes after `steps`; where there is a `stop`, a second loop goes on from there, and has to end as the first one."""
    steps = steps or STEPS.get(mode, 4)
    loop = start(scene, size, threads, mode, **settings)
    take_steps(loop, stop or steps)
    other = resumed(loop, start(scene, size, threads, mode, **settings)) if stop else None
    take_steps(loop, steps - stop if stop else 0)
    found = hashes(film_layers(loop), loop.state_dict())
    if other is not None:
        take_steps(other, steps - stop)
        if hashes(film_layers(other), other.state_dict()) != found:
            raise AssertionError("a resumed render ends otherwise than one that was not interrupted")
    return found


def all_cases() -> dict[str, Callable[[int], Hashes]]:
    """The function that renders each case on a number of threads, by the name of the case."""
    cases = {f"modes/{scene}/{mode}": partial(rendered, scene=scene, mode=mode) for scene in SCENES for mode in MODES}
    cases["modes/long/area-restir+lis"] = partial(rendered, scene="chrome", mode="area-restir+lis", size=SMALL, steps=9)
    adaptive = {"scene": "chrome", "steps": 40}  # some of its blocks end after 32 steps
    for mode, noise in (("uniform", 0.3), ("guided", 0.2)):
        for scene in ("cutout", "hidden-sky", "materials", "cat-eye", "blades", "mask"):
            cases[f"scenes/{scene}/{mode}"] = partial(rendered, scene=scene, mode=mode)
        cases[f"adaptive/{mode}"] = partial(rendered, mode=mode, target_noise=noise, **adaptive)
    cases["scenes/cat-eye/lis-o"] = partial(rendered, scene="cat-eye", mode="lis-o")
    cases["scenes/pinhole/guided"] = partial(rendered, scene="pinhole", mode="guided", steps=2)
    for mode in ("uniform", "lis-b", "guided"):
        cases[f"crop/{mode}"] = partial(rendered, scene="fairy-lights", mode=mode, crop=(11, 5, 37, 22))
    for mode, stop, steps in (("uniform", 2, 4), ("guided", 3, 6), ("lis-o", 9, 11)):
        cases[f"resume/{mode}"] = partial(rendered, scene="fairy-lights", mode=mode, stop=stop, steps=steps)
    cases["resume/adaptive-guided"] = partial(rendered, mode="guided", target_noise=0.2, stop=34, **adaptive)
    for mode, ranks in (("guided", 1), ("guided", 2), ("lis-o", 2)):
        cases[f"command/{mode}/{ranks}"] = partial(by_command, ranks=ranks, scene="fairy-lights", mode=mode)
    return cases


def fingerprint() -> dict[str, str]:
    """The commit, libraries and CPU that hashes are valid for."""
    git = subprocess.run(("git", "rev-parse", "HEAD"), cwd=Path(__file__).parent, capture_output=True, text=True)
    info = Path("/proc/cpuinfo").read_text().split("\n\n")[0] if Path("/proc/cpuinfo").exists() else ""
    lines = dict(line.replace("\t", "").split(":", 1) for line in info.splitlines() if ":" in line)
    model = ", ".join(lines.get(key, "?").strip() for key in ("model name", "cpu family", "model"))
    cpu = f"{model if lines else platform.processor()}, {torch.backends.cpu.get_cpu_capability()}"
    return {"commit": git.stdout.strip(), "torch": torch.__version__, "numpy": np.__version__, "cpu": cpu}


def differences(known: dict[str, Hashes], cases: dict[str, Callable[[int], Hashes]], threads: int) -> Iterator[str]:
    """A line for each case that fails or whose hashes differ from the known ones."""
    for name, render in cases.items():
        try:
            found = render(threads)
        except Exception as error:
            yield f"{name}: {type(error).__name__}: {error}"
            continue
        different = [part for part in found if found[part] != known.get(name, {}).get(part)]
        if different:
            yield f"{name}: {' and '.join(different) if name in known else 'not in the file'}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    action = parser.add_mutually_exclusive_group(required=True)
    action.add_argument("--write", type=Path, metavar="JSON", help="write the hashes; with --only, into those of the file")
    action.add_argument("--check", type=Path, metavar="JSON", help="compare the hashes with those of the file")
    parser.add_argument("--only", default="*", metavar="PATTERN", help="cases whose names match, such as 'modes/*guided'")
    parser.add_argument("--threads", type=int, default=2, metavar="N", help="that render, default 2")
    args = parser.parse_args()
    os.environ[SWITCH] = "0"
    torch.set_num_threads(1)
    cases = {name: render for name, render in all_cases().items() if fnmatch(name, args.only)}
    path, since = args.check or args.write, time.perf_counter()
    before = json.loads(path.read_text()) if args.check or (args.only != "*" and path.exists()) else {"cases": {}}
    if args.write:
        found = {name: render(args.threads) for name, render in cases.items()}
        path.write_text(json.dumps({"origin": fingerprint(), "cases": before["cases"] | found}, indent=1) + "\n")
        print(f"{len(cases)} cases in {time.perf_counter() - since:.0f} s")
        return 0
    now = fingerprint()
    for key, value in before["origin"].items():
        if key != "commit" and now[key] != value:
            print(f"{path} holds for another {key}, so hashes may differ for that alone: {value}, here {now[key]}")
    failed = 0
    for line in differences(before["cases"], cases, args.threads):
        failed += 1
        print(line, flush=True)
    print(f"{failed} of {len(cases)} cases differ from {before['origin']['commit'][:12]} ({time.perf_counter() - since:.0f} s)")
    return 1 if failed or not cases else 0


if __name__ == "__main__":
    sys.exit(main())
