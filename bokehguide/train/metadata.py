"""Metadata of a render for file headers and logs."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING

from bokehguide import __version__
from bokehguide.scene.types import Scene

if TYPE_CHECKING:
    from bokehguide.train import RenderSettings


def describe_render(scene: Scene, settings: RenderSettings, spp: int) -> dict[str, str | int]:
    """Scene, mode, rendered SPP, seed, size and software; `settings` is JSON with the camera and the film."""
    whole = asdict(settings) | {"camera": asdict(scene.camera), "film": asdict(scene.film)}
    return {
        "scene": scene.name,
        "mode": settings.mode,
        "spp": spp,
        "seed": settings.seed,
        "size": f"{scene.film.width}x{scene.film.height}",
        # OpenEXR reserves the name `version` and drops such a text.
        "software": f"bokehguide {__version__}",
        "settings": json.dumps(whole, default=lambda mask: f"{mask.shape[1]} × {mask.shape[0]} texels"),
    }
