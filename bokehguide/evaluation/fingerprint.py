"""What a kept render was made from, as a digest that its file can hold."""

from __future__ import annotations

from bokehguide.scene.digest import digest
from bokehguide.scene.types import Scene
from bokehguide.train import RenderSettings


def fingerprint(scene: Scene, settings: RenderSettings) -> str:
    """A digest of all that decides what a long render converges to, and of its random numbers."""
    seen = (scene.camera, scene.meshes, scene.materials, scene.film, scene.environment, scene.suns)
    return digest((*seen, settings.mode, settings.seed))
