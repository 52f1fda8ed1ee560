"""Metering: the exposure that suits a picture.

The meter works on means over square blocks, so that the noise of few samples and single bright pixels hardly matter.

- The logarithmic mean of the lit blocks becomes middle grey, KEY. Blocks count by their alpha. The reference is the lower bound
  of the upper quarter of the lit blocks. Blocks count as four stops below the reference at least and as the reference at most:
  emitters out of focus often cover a tenth of a picture, and must not darken the rest.
- The highlights, the luminance that HIGHLIGHT_SHARE of the area exceeds, become HIGHLIGHTS at most. The view rolls off the rest.
- Where little of the picture is lit, the highlights become diffuse white at least: an emitter before black surroundings shines.
"""

from __future__ import annotations

import numpy as np

from bokehguide.color import LUMINANCE
from bokehguide.limits import MAX_EXPOSURE

KEY = 0.2
"""Radiance of a grey card, a little above its reflectance, as ACES shows middle grey darker than the sRGB curve does."""
HIGHLIGHTS, HIGHLIGHT_SHARE = 16.0, 0.02
UPPER_SHARE, DARKEST = 0.25, 1.0 / 16.0
"""Share of the lit blocks above the reference, and least luminance of a block relative to the reference."""
BLACK = 2.0**-12
"""Luminance of a block, relative to the highlights, below which the block is not lit."""
LIT_SHARE = 0.25
"""Share of the area below which little of a picture is lit."""
BLOCKS_ACROSS = 64
"""Blocks along the longer side of a picture."""
LEAST_ALPHA = 0.05
"""Alpha below which a block shows too little to have a luminance."""


def metered_exposure(radiance: np.ndarray, alpha: np.ndarray | None = None) -> float:
    """Exposure in EV for radiance `[H, W, 3]`, premultiplied by `alpha` `[H, W]`; 0 for a black picture.

    Rounded to hundredths. A picture times 2^n has an exposure lower by n.
    """
    light = np.stack([np.asarray(row, np.float64) @ LUMINANCE for row in radiance])  # the whole would take 24 bytes per pixel
    light = _block_means(np.nan_to_num(light, copy=False, posinf=0.0, neginf=0.0).clip(min=0.0))
    cover = np.ones(radiance.shape[:2]) if alpha is None else np.nan_to_num(np.asarray(alpha, np.float64)).clip(0.0, 1.0)
    cover = _block_means(cover)
    seen = cover > LEAST_ALPHA
    light, cover = light[seen] / cover[seen], cover[seen]
    if not light.any():
        return 0.0
    highlights = float(np.quantile(light, 1.0 - HIGHLIGHT_SHARE)) or float(light.max())
    lit = light > BLACK * highlights
    lit_share = float(cover[lit].sum() / cover.sum())
    light, cover = light[lit], cover[lit]
    reference = float(np.quantile(light, 1.0 - UPPER_SHARE))
    mean = float(cover @ np.log2(light.clip(DARKEST * reference, reference))) / float(cover.sum())
    stops = min(np.log2(KEY) - mean, np.log2(HIGHLIGHTS / highlights))
    if lit_share < LIT_SHARE:
        stops = max(stops, -np.log2(highlights))
    return round(float(np.clip(stops, -MAX_EXPOSURE, MAX_EXPOSURE)), 2)


def _block_means(image: np.ndarray) -> np.ndarray:
    """Means over blocks of an image `[H, W]`, flat; blocks at the right and the lower edge are smaller."""
    side = max(1, round(max(image.shape) / BLOCKS_ACROSS))
    rows, columns = (np.arange(0, length, side) for length in image.shape)
    sums = np.add.reduceat(np.add.reduceat(image, rows, 0), columns, 1)
    heights, widths = (np.diff(starts, append=length) for starts, length in zip((rows, columns), image.shape))
    return (sums / (heights[:, None] * widths)).ravel()
