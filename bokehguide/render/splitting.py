"""Strategies by which paths split at their primary hits."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from bokehguide.render.geometry import Geometry
from bokehguide.render.observer import PathObserver
from bokehguide.render.paths import Paths
from bokehguide.render.primary_hits import PrimaryHits
from bokehguide.render.surface import Surface
from bokehguide.render.visibility import Arrivals
from bokehguide.runtime.indexing import scatter_add


class Splitting:
    """Base class: each ray continues as one path from its primary hit, and there is no record of primary hits.

    counts: number of paths of each ray, float32 `[N]`, None for one path. primary_hits: record of the trace, None without splits.
    in_core: whether the native core can replace `split`, `add_direct`, `scattered` and `collect`.
    """

    in_core = False
    counts: Tensor | None = None
    primary_hits: PrimaryHits | None = None

    def split(
        self, geometry: Geometry, paths: Paths, found: Arrivals, surface: Surface, observers: Sequence[PathObserver]
    ) -> tuple[Paths, Surface, Tensor | None]:
        """P paths that leave the primary hits, their surfaces, and the hit of each path, int64 `[P]`, None if each hit has one
        path."""
        return paths, surface, None

    def add_direct(self, paths: Paths, direction: Tensor, contribution: Tensor) -> None:
        """Add the contribution `[3, P]` of light samples in unit directions `[3, P]`."""
        paths.radiance += contribution

    def scattered(self, direction: Tensor) -> None:
        """Paths leave their primary hits in unit directions `[3, P]`."""

    def collect(self, radiance: Tensor) -> None:
        """Add the radiance of the paths to the radiance of their rays, `[3, N]`, if the paths have their own array."""

    def recorded(self, hits: PrimaryHits | None) -> None:
        """The native core has traced all paths, and recorded the primary hits, None without hits."""


class _OnePath(Splitting):
    in_core = True


UNSPLIT = _OnePath()


class SplitPaths(Splitting):
    """Several paths for each ray of one trace (Arvo and Kirk 1990), and a record of the primary hits.

    counts: whole numbers of at least 1, float32 `[N]`.
    """

    in_core = True
    counts: Tensor

    def __init__(self, counts: Tensor):
        self.counts = counts

    @property
    def _hits(self) -> PrimaryHits:
        assert self.primary_hits is not None
        return self.primary_hits

    def split(
        self, geometry: Geometry, paths: Paths, found: Arrivals, surface: Surface, observers: Sequence[PathObserver]
    ) -> tuple[Paths, Surface, Tensor | None]:
        """See `Splitting`."""
        rays, emission = paths.index, paths.radiance
        counts = self.counts.index_select(0, rays).long()
        paths, owner = paths.split(counts, found.path_count)
        self.primary_hits = PrimaryHits(geometry, rays, found.hit, surface, emission, counts, owner, paths.collected)
        for observer in observers:
            observer.split(self.primary_hits.path_rays)
        return paths, self.primary_hits.path_surface, owner

    def add_direct(self, paths: Paths, direction: Tensor, contribution: Tensor) -> None:
        """See `Splitting`."""
        self._hits.light_direction, self._hits.direct = direction, contribution

    def scattered(self, direction: Tensor) -> None:
        """See `Splitting`."""
        self._hits.scattered_direction = direction

    def collect(self, radiance: Tensor) -> None:
        """See `Splitting`."""
        if self.primary_hits is not None:
            scatter_add(radiance, self._hits.path_rays, self._hits.direct + self._hits.indirect)

    def recorded(self, hits: PrimaryHits | None) -> None:
        """See `Splitting`."""
        self.primary_hits = hits
