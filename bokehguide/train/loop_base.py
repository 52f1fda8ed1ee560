"""The parts that loops share: the end of their threads, and checks of their inputs."""

from __future__ import annotations

from typing import NoReturn, Self

from bokehguide.errors import BokehguideError
from bokehguide.runtime.workers import Workers
from bokehguide.scene.tables import shown
from bokehguide.scene.types import Scene
from bokehguide.train.settings import RenderSettings


class Loop:
    """Base class of loops: a context manager that ends the worker threads."""

    workers: Workers

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the workers; the film and the state stay."""
        self.workers.close()

    def __getstate__(self) -> NoReturn:
        """Refuse `copy` and `pickle`, which cannot take threads."""
        raise BokehguideError(
            f"{type(self).__name__}: a loop cannot be copied or pickled; "
            "copy its film, or load its state_dict() into another loop"
        )


def require_inputs(scene: object, settings: object) -> None:
    """Raise BokehguideError unless a loop can render these."""
    if not isinstance(scene, Scene):
        raise BokehguideError(f"RenderLoop: scene: {shown(scene)} is no Scene; give one, as from bokehguide.load_scene")
    if not isinstance(settings, RenderSettings):
        raise BokehguideError(f"RenderLoop: settings: {shown(settings)} is no RenderSettings; give RenderSettings(…)")
