"""The width of texels that is asked for; without a heavy import, so that a wrong one is refused at once."""

from __future__ import annotations

from dataclasses import dataclass

from coupole.errors import InputError

_MOST_MM = 100.0


@dataclass(frozen=True)
class TexelSize:
    """Width of texels that was asked for. Raises InputError for one that cannot be."""

    mm: float | None = None
    """Width on the surface; None for single pixels of each view, `auto`."""

    def __post_init__(self) -> None:
        if self.mm is not None and not 0.0 < self.mm <= _MOST_MM:
            raise size_refused(f"{self.mm:g}")

    @property
    def text(self) -> str:
        """Text of the command line."""
        return "auto" if self.mm is None else f"{self.mm:g}"

    @property
    def in_words(self) -> str:
        """Name for people."""
        return "single pixels (auto)" if self.mm is None else f"{self.mm:g} mm"

    def side_px(self, of_pixel_mm: float) -> int:
        """Width of a texel, px, in a view whose pixels are that wide on the surface."""
        return 1 if self.mm is None else max(1, round(self.mm / of_pixel_mm))


def size_refused(text: str) -> InputError:
    """Return the error for what is no size of texels."""
    return InputError(
        f"--texels: expected auto, each view's own pixels, or a width on the surface in mm up to {_MOST_MM:g}, "
        f"such as 0.2; got {text!r}"
    )
