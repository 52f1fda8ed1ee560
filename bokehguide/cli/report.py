"""Progress of a render, and its summary as JSON."""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext, redirect_stdout
from pathlib import Path
from typing import Any

from tqdm import tqdm

from bokehguide.cli.forecast import Forecast
from bokehguide.cli.parser import STDOUT
from bokehguide.image import write_text
from bokehguide.render.film import Film
from bokehguide.render.halves_film import HalvesFilm
from bokehguide.runtime.bars import on_terminal, terminal_size
from bokehguide.train import AdaptiveLoop, RenderLoop, RenderSettings, StepStats

BAR = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{left}, {rate_fmt}{postfix}]"
"""The format of the bar, that of tqdm with another time left."""


class Bar(tqdm):
    """A progress bar whose time left is that of the limit that ends the render first.

    seconds_left: None before the first step.
    """

    seconds_left: float | None = None

    @property
    def format_dict(self) -> Any:
        """The values for BAR."""
        left = "?" if self.seconds_left is None else self.format_interval(self.seconds_left)
        return dict(super().format_dict) | {"left": left}


class Report:
    """Adds up the steps of a render and shows them in a progress bar on stderr.

    done, earlier: SPP and seconds of earlier sessions; silent: show no bar.
    """

    def __init__(self, title: str, settings: RenderSettings, forecast: Forecast, done: int, earlier: float, silent: bool):
        self.settings, self._forecast = settings, forecast
        self._samples = 0
        self._rendering = 0.0
        self._earlier = earlier
        self._start = time.perf_counter()
        # A terminal gets a moving bar, a log file a line every ten seconds.
        interval = 0.1 if on_terminal() else 10.0
        self.bar = Bar(
            None,
            title,
            settings.spp,
            disable=silent or sys.stderr is None,
            unit="SPP",
            initial=done,
            mininterval=interval,
            bar_format=BAR,
            **terminal_size(),
        )

    def add(self, stats: StepStats, errors: Mapping[str, float]) -> None:
        """Count one step. errors: `mape` and `relmse`, or empty without a reference. Collective."""
        self._samples += stats.samples
        self._rendering += stats.seconds
        self._forecast.add(stats)
        self.bar.seconds_left = self._forecast.seconds_left
        words = [f"{self._samples / self._rendering / 1e6:.2f} M samples/s", *self._forecast.words()]
        words += [f"MAPE {errors['mape']:.4f}"] if errors else []
        self.bar.set_postfix_str(", ".join(words), refresh=False)
        self.bar.update()

    @property
    def seconds(self) -> float:
        """Seconds of the render so far, in all its sessions."""
        return self._earlier + time.perf_counter() - self._start

    def finish(
        self, loop: RenderLoop | AdaptiveLoop, picture: Film | HalvesFilm, errors: Mapping[str, float]
    ) -> dict[str, object]:
        """Close the bar and return the summary of the render, ready for JSON; peak memory is that of this session."""
        self.bar.close()
        seconds = self.seconds
        phases = dict(loop.phases)
        # The loop does not time metrics, logs and files; they count as output.
        phases["output"] += seconds - sum(phases.values())
        return {
            "mode": self.settings.mode,
            "spp": loop.step_number,
            "seconds": seconds,
            "samples": int(picture.samples()),
            "samples_per_second": picture.samples() / seconds,
            "peak_memory_mb": peak_memory_mb(),
            "gaussians": loop.mode.lens.component_count,
            **errors,
            "phases": phases,
        }


def write_json(path: Path | str, facts: Mapping[str, object]) -> None:
    """Write one JSON object to a file or to STDOUT. Raises BokehguideError if the folder cannot be written."""
    text = json.dumps(facts, indent=2)
    if path == STDOUT:
        print(text)
        return
    write_text(path, text + "\n")


def text_beside(output: Path | str | None) -> AbstractContextManager[object]:
    """Within the block, print to stderr if `output`, the value of --json, is STDOUT."""
    return redirect_stdout(sys.stderr) if output == STDOUT else nullcontext()


def json_file(output: Path | str | None) -> Path | None:
    """The file of a value of --json, None without a file."""
    return output if isinstance(output, Path) else None


def peak_memory_mb() -> float | None:
    """Peak memory of this process in MiB, None where the system does not tell, as on Windows."""
    try:
        import resource
    except ImportError:
        return None
    if sys.platform == "darwin":
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    # ru_maxrss of Linux starts at the size of the parent process.
    (peak,) = re.findall(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return int(peak) / 2**10
