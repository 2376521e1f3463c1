"""The requested width of texels. The module has no heavy import, so that a wrong width is refused at once."""

from __future__ import annotations

from dataclasses import dataclass

from coupole.errors import InputError

_MOST_MM = 100.0


@dataclass(frozen=True)
class TexelSize:
    """Requested width of texels. Raises InputError for an impossible width."""

    mm: float | None = None
    """Width on the surface; None for single pixels of each view, `auto`."""

    def __post_init__(self) -> None:
        if self.mm is not None and not 0.0 < self.mm <= _MOST_MM:
            raise size_refused(f"{self.mm:g}")

    @property
    def text(self) -> str:
        """Width as it is written on the command line."""
        return "auto" if self.mm is None else f"{self.mm:g}"

    @property
    def in_words(self) -> str:
        """Name of the size for readers."""
        return "single pixels (auto)" if self.mm is None else f"{self.mm:g} mm"

    def side_px(self, of_pixel_mm: float) -> int:
        """Return the width of a texel, px, in a view with pixels of the given width on the surface."""
        return 1 if self.mm is None else max(1, round(self.mm / of_pixel_mm))


def size_refused(text: str) -> InputError:
    """Return the error for a text that does not state a size of texels."""
    return InputError(
        f"--texels: expected auto (each view's own pixels) or a width on the surface in mm up to {_MOST_MM:g}, "
        f"such as 0.2; got {text!r}"
    )
