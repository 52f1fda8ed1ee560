"""Metering: the exposure that suits a picture.

The meter works on means over square blocks, so that the noise of few samples and single bright pixels hardly matter. Two
conditions each give an exposure, and the lower one counts:

- The logarithmic mean of the blocks becomes middle grey, KEY. Blocks count by their alpha. Blocks more than four stops below the
  highlights count as four stops below: black surroundings are not to be brightened.
- The highlights, the luminance that HIGHLIGHT_SHARE of the area exceeds, become HIGHLIGHTS at most. Lamps and reflections that
  cover less are left to the view's roll-off.
"""

from __future__ import annotations

import numpy as np

from bokehguide.color import LUMINANCE
from bokehguide.limits import MAX_EXPOSURE

KEY = 0.2
"""Radiance of a grey card, a little above its reflectance, as ACES shows middle grey darker than the sRGB curve does."""
HIGHLIGHTS, HIGHLIGHT_SHARE = 4.0, 0.02
DARKEST = 1.0 / 16.0
"""Least luminance of a block by that of the highlights."""
BLOCKS_ACROSS = 64
"""Blocks along the longer side of a picture."""
LEAST_ALPHA = 0.05
"""Alpha below which a block shows too little to have a luminance."""


def metered_exposure(radiance: np.ndarray, alpha: np.ndarray | None = None) -> float:
    """Exposure in EV for radiance `[H, W, 3]`, premultiplied by `alpha` `[H, W]`; 0 for a black picture.

    Rounded to hundredths. A picture times 2^n has an exposure lower by n.
    """
    light = np.nan_to_num(np.asarray(radiance, np.float64) @ LUMINANCE, posinf=0.0, neginf=0.0).clip(min=0.0)
    cover = np.ones_like(light) if alpha is None else np.nan_to_num(np.asarray(alpha, np.float64)).clip(0.0, 1.0)
    light, cover = _block_means(light), _block_means(cover)
    seen = cover > LEAST_ALPHA
    light, cover = light[seen] / cover[seen], cover[seen]
    if not light.any():
        return 0.0
    highlights = float(np.quantile(light, 1.0 - HIGHLIGHT_SHARE)) or float(light.max())
    mean = float(cover @ np.log2(light.clip(min=DARKEST * highlights))) / float(cover.sum())
    stops = min(np.log2(KEY) - mean, np.log2(HIGHLIGHTS / highlights))
    return round(float(np.clip(stops, -MAX_EXPOSURE, MAX_EXPOSURE)), 2)


def _block_means(image: np.ndarray) -> np.ndarray:
    """Means over blocks of an image `[H, W]`, flat; blocks at the right and the lower edge are smaller."""
    side = max(1, round(max(image.shape) / BLOCKS_ACROSS))
    rows, columns = (np.arange(0, length, side) for length in image.shape)
    sums = np.add.reduceat(np.add.reduceat(image, rows, 0), columns, 1)
    heights, widths = (np.diff(starts, append=length) for starts, length in zip((rows, columns), image.shape))
    return (sums / (heights[:, None] * widths)).ravel()
