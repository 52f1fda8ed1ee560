"""The picture of a scene: its size, and boxes in it."""

from __future__ import annotations

from dataclasses import dataclass

from bokehguide.limits import MAX_PIXELS
from bokehguide.scene.checks import FieldError, Fields
from bokehguide.scene.tables import COUNT, EXPOSURE


@dataclass(frozen=True)
class FilmSettings:
    """Size in pixels, and the maximum path length in segments (1 is directly visible emission).

    exposure: of display images, EV; None: metered.
    """

    width: int = 640
    height: int = 360
    max_depth: int = 6
    exposure: float | None = None

    def __post_init__(self) -> None:
        fields = Fields(self)
        fields.check_wholes(width=COUNT, height=COUNT, max_depth=COUNT)
        if self.exposure is not None:
            fields.check_numbers(exposure=EXPOSURE)
        if self.width * self.height > MAX_PIXELS:
            raise FieldError(f"FilmSettings: {self.width}x{self.height} pixels are too many; give at most {MAX_PIXELS}")


@dataclass(frozen=True)
class Inset:
    """A crop box in fractions of the frame, measured from the top left corner."""

    x: float
    y: float
    width: float
    height: float

    def pixels(self, width: int, height: int) -> tuple[slice, slice]:
        """Rows and columns of this inset in an image of `height` rows and `width` columns."""
        top, left = round(self.y * height), round(self.x * width)
        bottom = max(top + 1, round((self.y + self.height) * height))
        right = max(left + 1, round((self.x + self.width) * width))
        return slice(top, bottom), slice(left, right)
