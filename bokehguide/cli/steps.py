"""The steps of `bokehguide render`: a bar, a log, pictures and checkpoints while they go on, and what may end them."""

from __future__ import annotations

import argparse
import signal

from torch import Tensor

from bokehguide.cli.checkpoints import Checkpoints
from bokehguide.cli.pictures import Pictures
from bokehguide.cli.report import Report
from bokehguide.interrupt import Interrupt
from bokehguide.metrics import mape, relmse
from bokehguide.render import Film
from bokehguide.train import AdaptiveLoop, Ranks, RenderLogger, RenderLoop


def take_steps(
    loop: RenderLoop | AdaptiveLoop,
    options: argparse.Namespace,
    reference: Tensor | None,
    checkpoints: Checkpoints,
    pictures: Pictures,
    earlier: float,
) -> tuple[int | str | None, Report]:
    """Take the steps that are left, with a bar, a log and checkpoints, and a picture after the first and with each checkpoint. Returns
    what ended them before the SPP that were asked for, a signal's number or words, and the report."""
    done, settings, ranks = loop.step_number, loop.settings, loop.ranks
    logger = None
    if options.logdir:
        logger = RenderLogger(options.logdir, loop.scene, settings, options.exposure, done, silent=not ranks.first)
    end = None
    with Interrupt() as interrupt:  # before the bar: who sees it may press Ctrl-C
        report = Report(f"{loop.scene.name} {settings.mode}", settings, done, earlier, silent=not ranks.first)
        while loop.step_number < settings.spp and end is None:
            if isinstance(loop, AdaptiveLoop) and loop.finished:
                end = f"every block is down to --target-noise {settings.target_noise:g}"
                break
            stats = loop.step()
            if (reference is not None or options.logdir) and is_shown(stats.step, ranks):
                picture = loop.picture()
                report.add(stats, errors := measure(picture, reference))
                if logger:
                    logger.log(loop, stats, errors, picture)
            else:
                report.add(stats, {})
            late = options.time_limit is not None and report.seconds + stats.seconds > options.time_limit
            interrupted, late, due = ranks.any(interrupt.requested, late, checkpoints.due())
            if due:
                if logger:
                    logger.flush()  # or what is saved could be missing in the log
                checkpoints.save(loop, report.seconds)
            if interrupted:
                end = interrupt.signal or signal.SIGTERM
            elif late and loop.step_number < settings.spp:
                end = f"another step would pass --time-limit {options.time_limit:g}"
            elif (due or loop.step_number == done + 1) and loop.step_number < settings.spp and not checkpoints.ahead(loop):
                pictures.refresh(loop)
        checkpoints.save(loop, report.seconds)
    if logger:
        logger.finish(loop, loop.step_number, loop.picture())
    return end, report


def is_shown(step: int, ranks: Ranks) -> bool:
    """Whether the error is measured after a step: always, or where films have to be merged for it, now and then."""
    return ranks.alone or step & (step - 1) == 0


def measure(picture: Film, reference: Tensor | None) -> dict[str, float]:
    """MAPE and relMSE, or nothing where there is no reference."""
    if reference is None:
        return {}
    radiance = picture.radiance().cpu()
    return {"mape": mape(radiance, reference), "relmse": relmse(radiance, reference)}
