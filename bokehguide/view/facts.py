"""The facts beside a picture of the page."""

from __future__ import annotations

from typing import Any

from bokehguide.view.job import Job


def picture_facts(job: Job, limit: int, rendering: bool, revision: int, exposure: float) -> dict[str, Any]:
    """The facts beside a picture of a job, as JSON values. limit: samples per pixel at which its steps end."""
    stats = job.stats
    seconds = max(stats.seconds, 1e-9) if stats else 1.0
    spp = job.loop.step_number if job.full_size else 0
    return {
        "revision": revision,
        "width": job.scene.film.width,
        "height": job.scene.film.height,
        "reduction": job.reduction,
        "spp": spp,
        "limit": max(limit, spp),  # a render that has ended may have more samples than a picture that rests
        "rendering": rendering,
        "done": job.done(limit),
        "exact": False,
        "seconds": job.seconds,
        "rays_per_second": stats.rays / seconds if stats else 0.0,
        "samples_per_second": stats.samples / seconds if stats else 0.0,
        "error": job.curve[-1][1] if job.curve else None,
        "curve": job.curve[-512:],
        "exposure": exposure,
    }
