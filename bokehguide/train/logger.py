"""TensorBoard: the curves and pictures of a render while it goes on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from bokehguide.image import tone_map
from bokehguide.scene.types import Scene
from bokehguide.train.metadata import describe_render

if TYPE_CHECKING:
    from bokehguide.render.film import Film
    from bokehguide.train import RenderLoop, RenderSettings, StepStats


class RenderLogger:
    """Writes the steps of one render into `logdir/SCENE/MODE`.

    The modes of a scene are sibling folders, so `tensorboard --logdir logdir/SCENE`
    lays their curves over each other. An older log of the same mode is removed.

    exposure: EV of the pictures. resumed: the step after which a render goes on; its log does
    too, and TensorBoard forgets what later steps had written before they were lost. silent: for the ranks that do
    not write; all of them log, as the guide's pictures are put together.
    """

    def __init__(
        self,
        logdir: str | Path,
        scene: Scene,
        settings: RenderSettings,
        exposure: float = 0.0,
        resumed: int = 0,
        silent: bool = False,
    ):
        self.exposure = exposure
        self._pictures_at = resumed
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

    def log(self, loop: RenderLoop, stats: StepStats, errors: Mapping[str, float], picture: Film) -> None:
        """Scalars of one step, and pictures where its number is a power of two. Collective.

        errors: by name (`mape`, `relmse`), or empty where there is no reference; the estimate of the relative
        noise of the `picture` so far stands in then.
        """
        scalars = {f"error/{name}": value for name, value in errors.items()} or {
            "error/relative_noise": picture.relative_noise()
        }
        scalars |= {
            "guide/kl": stats.kl,
            "guide/gaussians": stats.gaussians,
            "guide/beta": stats.beta,
            "guide/outside_share": stats.outside,
            "speed/samples_per_second": stats.samples / stats.seconds,
        }
        scalars |= {f"time/{name.replace(' ', '_')}": seconds for name, seconds in loop.phases.items()}
        for tag, value in scalars.items() if self.writer else ():
            if not math.isnan(value):
                self.writer.add_scalar(tag, value, stats.step)
        if stats.step & (stats.step - 1) == 0:
            self._log_pictures(loop, stats.step, picture)

    def flush(self) -> None:
        """Write what is still in memory."""
        if self.writer:
            self.writer.flush()

    def finish(self, loop: RenderLoop, step: int, picture: Film) -> None:
        """Pictures of the last step, whatever its number, and close the log. Collective."""
        if step != self._pictures_at:
            self._log_pictures(loop, step, picture)
        if self.writer:
            self.writer.close()

    def _log_pictures(self, loop: RenderLoop, step: int, picture: Film) -> None:
        pictures = {"render": tone_map(picture.radiance(), self.exposure), **loop.guide_images()}
        for name, picture in pictures.items() if self.writer else ():
            self.writer.add_image(name, picture, step, dataformats="HWC")
        self._pictures_at = step


def run_folder(logdir: str | Path, scene: Scene, settings: RenderSettings) -> Path:
    """Where the log of this scene and mode goes."""
    return Path(logdir) / scene.name / settings.mode
