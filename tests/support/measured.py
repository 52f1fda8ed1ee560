"""Loads scenes one after another, and prints processor seconds, peak memory in MB and the message of each as JSON lines."""

from __future__ import annotations

import json
import resource
import sys
import time
from pathlib import Path


def peak_mb() -> float:
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def forget_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def main(paths: list[str]) -> None:
    from bokehguide.errors import BokehguideError
    from bokehguide.scene import load_scene
    from bokehguide.train import RenderLoop, RenderSettings

    resource.setrlimit(resource.RLIMIT_AS, (8 * 2**30,) * 2)
    for path in paths:
        forget_peak()
        start, message, loaded, triangles = time.process_time(), "", False, 0
        try:
            scene = load_scene(path)
            triangles = sum(len(mesh.triangles) for mesh in scene.meshes)
            loaded = True
            took = time.process_time() - start
            with RenderLoop(scene, RenderSettings("uniform", threads=1)):
                pass
            del scene
        except (BokehguideError, MemoryError, RuntimeError) as error:
            message = f"{type(error).__name__}: {error}"
            took = time.process_time() - start
        whole = time.process_time() - start
        facts = {"path": path, "seconds": took, "whole": whole, "mb": peak_mb(), "loaded": loaded, "triangles": triangles}
        print(json.dumps(facts | {"message": message}), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
