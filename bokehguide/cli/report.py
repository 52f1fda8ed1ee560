"""What a render reports of itself: while it runs, at its end, and as JSON."""

from __future__ import annotations

import json
import re
import resource
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from tqdm import tqdm

from bokehguide.image import replacing
from bokehguide.render.film import Film
from bokehguide.train import RenderLoop, RenderSettings, StepStats


class Report:
    """Adds up the steps of a render and shows them in a progress bar on stderr.

    done: SPP of earlier sessions; earlier: the seconds that they took. silent: no bar.
    """

    def __init__(self, title: str, settings: RenderSettings, done: int = 0, earlier: float = 0.0, silent: bool = False):
        self.settings = settings
        self._samples = 0
        self._rendering = 0.0
        self._earlier = earlier
        self._start = time.perf_counter()
        # A log file gets a line now and then, a terminal a bar that moves.
        interval = 0.1 if sys.stderr.isatty() else 10.0
        words = {"desc": title, "unit": "SPP", "mininterval": interval, "dynamic_ncols": True}
        self.bar = tqdm(total=settings.spp, initial=done, disable=silent, **words)

    def add(self, stats: StepStats, errors: Mapping[str, float]) -> None:
        """Count one step; `errors` (`mape`, `relmse`) is empty where there is no reference."""
        self._samples += stats.samples
        self._rendering += stats.seconds
        words = [f"{self._samples / self._rendering / 1e6:.2f} M samples/s"]
        words += [f"MAPE {errors['mape']:.4f}"] if errors else []
        self.bar.set_postfix_str(", ".join(words), refresh=False)
        self.bar.update()

    @property
    def seconds(self) -> float:
        """That the render has taken so far, in all its sessions."""
        return self._earlier + time.perf_counter() - self._start

    def finish(self, loop: RenderLoop, picture: Film, errors: Mapping[str, float]) -> dict[str, object]:
        """Close the bar and give the facts of the whole render, ready for JSON; the memory is that of this session."""
        self.bar.close()
        seconds = self.seconds
        phases = dict(loop.phases)
        # Metrics, logs and files are output too, and the loop does not see them.
        phases["output"] += seconds - sum(phases.values())
        return {
            "mode": self.settings.mode,
            "spp": loop.step_number,
            "seconds": seconds,
            "samples": int(picture.samples()),
            "samples_per_second": picture.samples() / seconds,
            "peak_memory_mb": peak_memory_mb(),
            "gaussians": len(loop.guide.field) if loop.guide else 0,
            **({} if self.settings.target_noise is None else {"estimated_mape": picture.relative_noise()}),
            **errors,
            "phases": phases,
        }


def write_json(path: Path, facts: Mapping[str, object]) -> None:
    """Write one JSON object. Raises BokehguideError where the folder cannot be written."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(facts, indent=2) + "\n")


def peak_memory_mb() -> float:
    """The most memory this process has held, in MiB."""
    if sys.platform == "darwin":
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    # Linux's ru_maxrss begins at the size of the process that started this one.
    status = Path("/proc/self/status").read_text()
    return int(re.search(r"VmHWM:\s+(\d+) kB", status)[1]) / 2**10
