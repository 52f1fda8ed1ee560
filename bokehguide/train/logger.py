"""TensorBoard logs: the curves and images of a render."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from bokehguide.errors import reason
from bokehguide.image import Display
from bokehguide.scene.types import Scene
from bokehguide.train.metadata import describe_render

if TYPE_CHECKING:
    from bokehguide.render.film import Film
    from bokehguide.render.halves_film import HalvesFilm
    from bokehguide.train.adaptive import AdaptiveLoop
    from bokehguide.train.loop import RenderLoop
    from bokehguide.train.settings import RenderSettings
    from bokehguide.train.step_stats import StepStats

log = logging.getLogger(__name__)


class RenderLogger:
    """Writes the steps of one render into `logdir/SCENE/MODE`.

    A log that cannot be written, as on a full disk, ends with one warning. The render goes on.

    The modes of a scene are sibling folders, so `tensorboard --logdir logdir/SCENE` overlays their curves. An older log of the
    same mode is removed.

    display: of the images. resumed: last step of the checkpoint. The log continues after this step, and TensorBoard discards
    later entries of the old log. silent: write nothing. All ranks except the first are silent, but take part in collective calls.
    """

    def __init__(
        self,
        logdir: str | Path,
        scene: Scene,
        settings: RenderSettings,
        display: Display = Display(),
        resumed: int = 0,
        silent: bool = False,
    ):
        self.display = display
        self._images_at = resumed
        self.writer = None
        self._hook = threading.excepthook
        if silent:
            return
        from torch.utils.tensorboard import SummaryWriter  # takes over a second to import

        self._folder = run_folder(logdir, scene, settings)
        threading.excepthook = self._report
        with self._writing():
            if not resumed:
                for old in self._folder.glob("events.out.tfevents.*"):
                    old.unlink()
            self.writer = SummaryWriter(self._folder, purge_step=resumed + 1 if resumed else None)
            facts = describe_render(scene, settings, settings.spp)
            table = "\n".join(f"| {key} | {value} |" for key, value in facts.items())
            self.writer.add_text("settings", f"| | |\n|---|---|\n{table}", resumed)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """A context that ends the log, with a warning, if the log cannot be written."""
        try:
            yield
        except OSError as error:
            self.writer = None
            log.warning("%s: the log ends here (%s); the render goes on", self._folder, error.strerror or reason(error))

    def _report(self, failure: threading.ExceptHookArgs) -> None:
        """Report the exception of a thread, except of TensorBoard's writer, which raises its exception again in `_writing`."""
        if not (issubclass(failure.exc_type, OSError) and type(failure.thread).__name__ == "_AsyncWriterThread"):
            self._hook(failure)

    def log(
        self, loop: RenderLoop | AdaptiveLoop, stats: StepStats, errors: Mapping[str, float], picture: Film | HalvesFilm
    ) -> None:
        """Write the scalars of one step, and images at powers of two; collective.

        errors: by name (`mape`, `relmse`); empty without a reference. In this case, the logger writes the estimated relative
        noise of `picture`, the film so far, from the second step on.
        """
        scalars = {f"error/{name}": value for name, value in errors.items()}
        if not errors and stats.step > 1:  # a single step has no estimate
            scalars["error/relative_noise"] = picture.relative_noise()
        scalars |= {
            "guide/kl": stats.kl,
            "guide/gaussians": stats.gaussians,
            "guide/beta": stats.beta,
            "guide/outside_share": stats.outside,
            "speed/samples_per_second": stats.samples / stats.seconds,
        }
        scalars |= {f"time/{name.replace(' ', '_')}": seconds for name, seconds in loop.phases.items()}
        with self._writing():
            for tag, value in scalars.items() if self.writer else ():
                if self.writer and not math.isnan(value):
                    self.writer.add_scalar(tag, value, stats.step)
        if stats.step & (stats.step - 1) == 0:
            self._log_images(loop, stats.step, picture)

    def flush(self) -> None:
        """Write buffered entries to the file."""
        if self.writer:
            with self._writing():
                self.writer.flush()

    def finish(self, loop: RenderLoop | AdaptiveLoop, step: int, picture: Film | HalvesFilm) -> None:
        """Write the images of the last step, and close the log; collective."""
        if step != self._images_at:
            self._log_images(loop, step, picture)
        if self.writer:
            with self._writing():
                self.writer.flush()
                self.writer.close()
        threading.excepthook = self._hook

    def _log_images(self, loop: RenderLoop | AdaptiveLoop, step: int, picture: Film | HalvesFilm) -> None:
        images = {"render": self.display.show(picture.radiance()), **loop.guide_images()}
        with self._writing():
            for name, image in images.items() if self.writer else ():
                if self.writer:
                    self.writer.add_image(name, image, step, dataformats="HWC")
        self._images_at = step


def run_folder(logdir: str | Path, scene: Scene, settings: RenderSettings) -> Path:
    """The folder of the log of this scene and mode."""
    return Path(logdir) / scene.name / settings.mode
