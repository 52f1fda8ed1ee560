"""The steps of `bokehguide render`, with progress bar, log, images and checkpoints, and their early ends."""

from __future__ import annotations

import argparse
import math
import signal
import time

from torch import Tensor

from bokehguide.cli.checkpoints import Checkpoints
from bokehguide.cli.forecast import Forecast
from bokehguide.cli.pictures import Pictures
from bokehguide.cli.report import Report
from bokehguide.cli.terminal import clear_stage
from bokehguide.metrics import mape, relmse
from bokehguide.runtime.interrupt import Interrupt
from bokehguide.train import AdaptiveLoop, Ranks, RenderLogger, RenderLoop, StepStats


def take_steps(
    loop: RenderLoop | AdaptiveLoop,
    options: argparse.Namespace,
    reference: Tensor | None,
    checkpoints: Checkpoints,
    pictures: Pictures,
    earlier: float,
    interrupt: Interrupt,
) -> tuple[int | str | None, Report]:
    """Take the remaining steps; images are written after the first step and with each checkpoint.

    earlier: seconds of earlier sessions; interrupt: entered, so that a signal ends the render in order. Returns the report, and
    the reason of an end before `spp` steps: the number of a signal, a text, or None.
    """
    done, settings, ranks = loop.step_number, loop.settings, loop.ranks
    logger, end = make_logger(loop, options, pictures), None
    deadline = math.inf if options.time_limit is None else options.started + options.time_limit
    clear_stage()
    forecast = Forecast(loop, deadline)
    report = Report(f"{loop.scene.name} {settings.mode}", settings, forecast, done, earlier, silent=not ranks.first)
    while loop.step_number < settings.spp and end is None:
        if isinstance(loop, AdaptiveLoop) and loop.finished:
            end = f"every block has reached --target-noise {settings.target_noise:g}"
            break
        stats = loop.step(last=loop.step_number + 1 == settings.spp)
        report_step(loop, stats, reference, report, logger)
        late = time.monotonic() + stats.seconds > deadline
        interrupted, late, due, shown = ranks.any(interrupt.requested, late, checkpoints.due(), pictures.due())
        if due:
            save(loop, report, logger, checkpoints, interrupt)
        if interrupted and not loop.complete:
            end = interrupt.signal or signal.SIGTERM
        elif loop.step_number < settings.spp:
            if late:
                end = time_is_up(options, stats, loop.step_number == done + 1)
            elif (due or loop.step_number == done + 1) and not checkpoints.ahead(loop):
                with interrupt.saving():
                    pictures.refresh(loop)
            elif shown:
                pictures.show(loop)
    with interrupt.saving():
        checkpoints.end(loop, report.seconds, isinstance(end, int))
        if logger:
            logger.finish(loop, loop.step_number, loop.picture())
    return end, report


def make_logger(loop: RenderLoop | AdaptiveLoop, options: argparse.Namespace, pictures: Pictures) -> RenderLogger | None:
    """The log that the options ask for."""
    if not options.logdir:
        return None
    silent = not loop.ranks.first
    return RenderLogger(options.logdir, loop.scene, loop.settings, pictures.display, loop.step_number, silent)


def save(
    loop: RenderLoop | AdaptiveLoop,
    report: Report,
    logger: RenderLogger | None,
    checkpoints: Checkpoints,
    interrupt: Interrupt,
) -> None:
    """Write the log so far and the state; collective."""
    with interrupt.saving():
        if logger:
            logger.flush()  # the log must not end before the saved state
        checkpoints.save(loop, report.seconds)


def time_is_up(options: argparse.Namespace, stats: StepStats, first: bool) -> str:
    """The reason of an end by --time-limit. first: whether one step was taken."""
    limit = f"--time-limit {options.time_limit:g}"
    passed = time.monotonic() - options.started
    if first and passed > options.time_limit:
        return f"{limit} passed within {passed:.1f} s of loading and the first step, which is always taken"
    return f"another step would exceed {limit}"


def report_step(
    loop: RenderLoop | AdaptiveLoop, stats: StepStats, reference: Tensor | None, report: Report, logger: RenderLogger | None
) -> None:
    """Add a step to the bar, and to the log if there is one, with its errors if they are measured."""
    if (reference is None and logger is None) or not is_measured(stats.step, loop.ranks):
        report.add(stats, {})
        return
    picture = loop.picture()
    errors = {} if reference is None else measure(picture.radiance().cpu(), reference)
    report.add(stats, errors)
    if logger:
        logger.log(loop, stats, errors, picture)


def is_measured(step: int, ranks: Ranks) -> bool:
    """Whether errors are measured after a step: always for one rank; at powers of two for several, which merge films for it."""
    return ranks.alone or step & (step - 1) == 0


def measure(radiance: Tensor, reference: Tensor) -> dict[str, float]:
    """MAPE and relMSE."""
    return {"mape": mape(radiance, reference), "relmse": relmse(radiance, reference)}
