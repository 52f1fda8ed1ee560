"""TensorBoard logs: the curves and images of a render."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from bokehguide.image import Display
from bokehguide.scene.types import Scene
from bokehguide.train.metadata import describe_render

if TYPE_CHECKING:
    from bokehguide.render.film import Film
    from bokehguide.train.adaptive import AdaptiveLoop, HalvesFilm
    from bokehguide.train.loop import RenderLoop
    from bokehguide.train.settings import RenderSettings
    from bokehguide.train.step_stats import StepStats


class RenderLogger:
    """Writes the steps of one render into `logdir/SCENE/MODE`.

    The modes of a scene are sibling folders, so `tensorboard --logdir logdir/SCENE` overlays their curves. An older log of the
    same mode is removed.

    display: of the images; resumed: the last step of a checkpoint, after which the log continues and TensorBoard discards
    later entries; silent: write nothing, for all ranks but the first, which still take part in collective calls.
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
        if silent:
            return
        from torch.utils.tensorboard import SummaryWriter  # takes over a second to import

        folder = run_folder(logdir, scene, settings)
        if not resumed:
            for old in folder.glob("events.out.tfevents.*"):
                old.unlink()
        self.writer = SummaryWriter(folder, purge_step=resumed + 1 if resumed else None)
        facts = describe_render(scene, settings, settings.spp)
        table = "\n".join(f"| {key} | {value} |" for key, value in facts.items())
        self.writer.add_text("settings", f"| | |\n|---|---|\n{table}", resumed)

    def log(
        self, loop: RenderLoop | AdaptiveLoop, stats: StepStats, errors: Mapping[str, float], picture: Film | HalvesFilm
    ) -> None:
        """Write the scalars of one step, and images at powers of two; collective.

        errors: by name (`mape`, `relmse`). Without a reference `errors` is empty, and the log has the estimated relative noise
        of `picture`, the film so far.
        """
        scalars = {f"error/{name}": value for name, value in errors.items()} or {"error/relative_noise": picture.relative_noise()}
        scalars |= {
            "guide/kl": stats.kl,
            "guide/gaussians": stats.gaussians,
            "guide/beta": stats.beta,
            "guide/outside_share": stats.outside,
            "speed/samples_per_second": stats.samples / stats.seconds,
        }
        scalars |= {f"time/{name.replace(' ', '_')}": seconds for name, seconds in loop.phases.items()}
        if self.writer:
            for tag, value in scalars.items():
                if not math.isnan(value):
                    self.writer.add_scalar(tag, value, stats.step)
        if stats.step & (stats.step - 1) == 0:
            self._log_images(loop, stats.step, picture)

    def flush(self) -> None:
        """Write buffered entries to the file."""
        if self.writer:
            self.writer.flush()

    def finish(self, loop: RenderLoop | AdaptiveLoop, step: int, picture: Film | HalvesFilm) -> None:
        """Write the images of the last step, and close the log; collective."""
        if step != self._images_at:
            self._log_images(loop, step, picture)
        if self.writer:
            self.writer.close()

    def _log_images(self, loop: RenderLoop | AdaptiveLoop, step: int, picture: Film | HalvesFilm) -> None:
        images = {"render": self.display.show(picture.radiance()), **loop.guide_images()}
        if self.writer:
            for name, image in images.items():
                self.writer.add_image(name, image, step, dataformats="HWC")
        self._images_at = step


def run_folder(logdir: str | Path, scene: Scene, settings: RenderSettings) -> Path:
    """The folder of the log of this scene and mode."""
    return Path(logdir) / scene.name / settings.mode
