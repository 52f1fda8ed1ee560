"""Digest of the inputs of a kept render."""

from __future__ import annotations

from bokehguide.scene.digest import digest
from bokehguide.scene.types import Scene
from bokehguide.train import RenderSettings


def fingerprint(scene: Scene, settings: RenderSettings) -> str:
    """A digest of the inputs that determine the limit of a long render and its random numbers."""
    inputs = (scene.camera, scene.meshes, scene.materials, scene.film, scene.environment, scene.suns)
    return digest((*inputs, settings.mode, settings.seed))
