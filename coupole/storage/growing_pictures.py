"""Pictures of materials and the page to relight that grow while a run goes on, in the folder of its result.

::

    RESULT/beside/pictures/          until the result is complete
      pictures.json                  pictures of each view, with their scales; the page
      1a2b3c4d-normals.png           never changed: a newer picture has another name
      1a2b3c4d-relight.html

Readers need no lock. `pictures.json` is replaced whole, and names only files that are complete. A file that it
does not name any more stays for a minute, because a browser may still be loading it.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal
from uuid import uuid4

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from coupole.errors import InputError
from coupole.intake.plain_data import read_json
from coupole.storage.processing import FOLDER

PICTURES = f"{FOLDER}/pictures"
_INDEX = "pictures.json"
_PNG_BEGINS, _PNG_ENDS = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
_KEPT_S = 60.0
"""Time for which a file stays that the index does not name any more."""
_PictureName = Annotated[str, Field(pattern=r"^[0-9a-f]{8}-[a-z0-9-]{1,40}\.png$")]
_PageName = Annotated[str, Field(pattern=r"^[0-9a-f]{8}-relight\.html$")]


class _Plain(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")


class PictureShown(_Plain):
    """A picture whose colours stand for values. With a `palette` it shows one value for each pixel, otherwise the
    three `names` as red, green and blue."""

    file: _PictureName
    title: str
    width_px: Annotated[int, Field(gt=0)]
    height_px: Annotated[int, Field(gt=0)]
    unit: str
    low: float
    high: float
    palette: str = ""
    names: tuple[str, ...] = ()
    gamma: float = 1.0
    is_cut: bool = False
    """True if some values are above `high` and have its colour."""
    median: float | None = None
    """Median over the triangles, of a picture of one value."""


class ViewPictures(_Plain):
    """Pictures of a view, and the data from which they were fitted."""

    view: str
    kind: Literal["first-look", "so-far"]
    """`first-look`: a quick fit to this view alone. `so-far`: the result of all views so far."""
    fitted_views: Annotated[int, Field(ge=1)]
    """Views to which the materials were fitted."""
    views: Annotated[int, Field(ge=1)]
    """Views of the plan."""
    frames: Annotated[int, Field(ge=0)]
    """Frames under one LED to which the materials were fitted."""
    arrived_frames: Annotated[int, Field(ge=0)] = 0
    """Frames under one LED that the view had then, while others still arrived; 0 if the view was complete."""
    triangles: Annotated[int, Field(ge=0)]
    """Triangles that were fitted."""
    t: str
    """Time when they were drawn, UTC."""
    pictures: tuple[PictureShown, ...]
    remark: str = ""
    """Sentence about the part of the view that is not drawn, and why."""


class PageSoFar(_Plain):
    """The page to relight of a result of the views so far."""

    file: _PageName
    fitted_views: Annotated[int, Field(ge=1)]
    views: Annotated[int, Field(ge=1)]
    t: str


class Growing(_Plain):
    """All that can be looked at while a run goes on."""

    is_simulated: bool = False
    of_views: tuple[ViewPictures, ...] = ()
    """Pictures of each view, in the order in which the views were drawn first."""
    page: PageSoFar | None = None

    @property
    def files(self) -> frozenset[str]:
        """Names of all files."""
        pictures = {picture.file for view in self.of_views for picture in view.pictures}
        return frozenset(pictures | ({self.page.file} if self.page else set()))


class GrowingPictures:
    """Writes the pictures of one result. There is one writer: the process that holds the result."""

    def __init__(self, result: Path, *, is_simulated: bool) -> None:
        """Continue with the pictures that an earlier session left."""
        self.folder = result / PICTURES
        self._shown = read_growing(result).model_copy(update={"is_simulated": is_simulated})
        self._unnamed_s: dict[str, float] = {}
        """Monotonic time since which the index does not name a file."""

    def new_page(self) -> str:
        """Return a new name for the page."""
        self.folder.mkdir(parents=True, exist_ok=True)
        return f"{uuid4().hex[:8]}-relight.html"

    def put_view(self, shown: ViewPictures, pngs: Mapping[str, bytes]) -> None:
        """Show these pictures of a view instead of earlier ones. `pngs` has the content of each file. Raises
        OSError."""
        self.folder.mkdir(parents=True, exist_ok=True)
        for name, png in pngs.items():
            (self.folder / name).write_bytes(png)
        of_views = {view.view: view for view in self._shown.of_views} | {shown.view: shown}
        self._write_index(self._shown.model_copy(update={"of_views": tuple(of_views.values())}))

    def put_page(self, page: PageSoFar) -> None:
        """Show a complete page instead of the earlier one. Raises OSError."""
        self._write_index(self._shown.model_copy(update={"page": page}))

    def _write_index(self, shown: Growing) -> None:
        part = self.folder / f"{_INDEX}.part"
        part.write_text(shown.model_dump_json() + "\n", encoding="utf-8")
        part.replace(self.folder / _INDEX)
        self._shown, now_s = shown, time.monotonic()
        unnamed_files = {
            path.name for path in self.folder.iterdir() if path.suffix in (".png", ".html")
        } - shown.files  # fmt: skip
        self._unnamed_s = {name: self._unnamed_s.get(name, now_s) for name in unnamed_files}
        for name, since_s in self._unnamed_s.items():
            if now_s - since_s > _KEPT_S:
                with contextlib.suppress(OSError):
                    (self.folder / name).unlink()


def new_picture_name(kind: str) -> str:
    """Return a new name for a picture of a kind (letters, digits, hyphens)."""
    return f"{uuid4().hex[:8]}-{kind}.png"


def read_growing(result: Path) -> Growing:
    """Return the pictures and pages that exist so far; empty if there are none, or if the index is not valid."""
    try:
        return Growing.model_validate(read_json(result / PICTURES / _INDEX))
    except (OSError, InputError, ValidationError):
        return Growing()


def file_so_far(result: Path, name: str) -> Path | None:
    """Return the path of a file that the index names, if it is complete and lies in the folder of the pictures;
    otherwise None."""
    if name not in read_growing(result).files:
        return None
    path = result / PICTURES / name
    if path.is_symlink() or not path.is_file() or not path.resolve().is_relative_to(result.resolve()):
        return None
    return path if path.suffix != ".png" or is_whole_png(path) else None


def is_whole_png(path: Path) -> bool:
    """Tell whether a file has the first and the last bytes of a PNG."""
    try:
        with path.open("rb") as file:
            begins = file.read(len(_PNG_BEGINS)) == _PNG_BEGINS
            file.seek(-len(_PNG_ENDS), 2)
            return begins and file.read() == _PNG_ENDS
    except OSError:
        return False
