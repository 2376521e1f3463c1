"""The parts of a page. A page's author gives words and figures; only the templates write HTML.

Every page has the same order: title, picture, three sentences, facts, sections. Every section has the same order:
words, figures, facts, lists, tables, notes. Words are plain text: the templates escape them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal, TypeAlias
from urllib.parse import quote

_NUMBER = re.compile(r"[-+]?[\d,]*\.?\d+(e[-+]?\d+)?( ?%)?")


# -- words --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Link:
    """A link to a file beside the page, or to `#name` in the page. If it has no words, its path is shown."""

    kind: ClassVar = "link"
    path: str
    words: str = ""

    @property
    def href(self) -> str:
        """The link's address. Characters with a meaning in addresses are escaped."""
        return self.path if self.path.startswith("#") else quote(self.path)


@dataclass(frozen=True)
class Code:
    """Text to type, or to compare letter by letter."""

    kind: ClassVar = "code"
    words: str


@dataclass(frozen=True)
class Verdict:
    """A word of judgement. The sign gives its colour; the word says the same without colour."""

    kind: ClassVar = "verdict"
    words: str
    sign: Literal["ok", "stopped", "bad"]


@dataclass(frozen=True)
class Moment:
    """A time in UTC, as ISO 8601; shown to the second."""

    kind: ClassVar = "moment"
    utc: str

    @property
    def words(self) -> str:
        return self.utc[:19].replace("T", " ")


@dataclass(frozen=True)
class Cited:
    """A work that is named as a source."""

    kind: ClassVar = "cited"
    words: str


@dataclass(frozen=True)
class Shape:
    """An element of a drawing: its SVG name, its attributes, and the text in it."""

    tag: Literal["polyline", "polygon", "rect", "line", "circle", "text", "image"]
    attributes: Mapping[str, str | float]
    words: str = ""


@dataclass(frozen=True)
class Drawing:
    """Lines and areas of `width` x `height` units, with a description in words."""

    kind: ClassVar = "drawing"
    title: str
    width: float
    height: float
    shapes: Sequence[Shape]
    most_px: int = 0
    """Largest width on the page; 0: as wide as there is room."""


Inline: TypeAlias = "str | Link | Code | Verdict | Moment | Cited | Drawing | Sequence[Inline]"
"""Words of a line. A sequence is written without spaces between its parts."""


# -- figures ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Legend:
    """Names of colours, each a CSS colour."""

    colours: Mapping[str, str]


@dataclass(frozen=True)
class Picture:
    """An image in the page itself."""

    kind: ClassVar = "picture"
    title: str
    data: bytes
    coding: Literal["png", "jpeg"] = "png"
    alternative: str = ""
    """Words for a person who does not see the picture. Without them the title is used."""
    is_broad: bool = False
    """True for a picture as wide as the page, if it is the first picture."""


@dataclass(frozen=True)
class Map:
    """An image whose pixels are values. It has a colour bar, and the page shows the value under the pointer.

    With a `palette` a pixel is one value: the place of its colour in the palette, from `low` to `high`. Without a
    palette its red, green and blue are the values of `names`, each from `low` to `high`, by the power `gamma`.
    """

    kind: ClassVar = "map"
    title: str
    png: bytes
    unit: str
    low: float
    high: float
    palette: str = ""
    names: Sequence[str] = ()
    gamma: float = 1.0
    is_cut: bool = False
    """True if some values are beyond `high` and have its colour."""
    shade_png: bytes = b""
    """Black with varying opacity, laid over the map: it shows the shape of the mapped thing."""
    is_broad: bool = False
    """True for a map as wide as the page, if it is the first picture."""


@dataclass(frozen=True)
class Plot:
    """A drawing with its title below and the meaning of its colours."""

    kind: ClassVar = "plot"
    drawing: Drawing
    legend: Legend | None = None
    words: Inline = ""

    @property
    def title(self) -> str:
        return self.drawing.title


Figure: TypeAlias = Picture | Map | Plot


# -- sections -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Table:
    """Rows of cells, the first of each row its heading."""

    caption: str
    head: Sequence[Inline]
    rows: Sequence[Sequence[Inline]]

    @property
    def numeric_columns(self) -> frozenset[int]:
        """Columns that contain only numbers. They are aligned to the right, digit below digit."""
        return frozenset(
            column
            for column in range(len(self.head))
            if (cells := [row[column] for row in self.rows if column < len(row) and row[column]])
            and all(isinstance(cell, str) and _NUMBER.fullmatch(cell) for cell in cells)
        )


@dataclass(frozen=True)
class Section:
    """A part of a page, to which links may lead as `#name`. Empty parts are left out."""

    name: str
    heading: Inline
    words: Sequence[Inline] = ()
    figures: Sequence[Figure] = ()
    figure_size: Literal["small", "medium", "triples", "wide"] = "medium"
    legend: Legend | None = None
    """One legend for all figures."""
    facts: Mapping[str, Inline] = field(default_factory=dict)
    items: Sequence[Inline] = ()
    tables: Sequence[Table] = ()
    notes: Sequence[Inline] = ()
    sections: Sequence[Section] = ()
    is_folded: bool = False
    """True if only the heading is shown until the reader opens the section. On paper everything is shown."""

    @property
    def has_content(self) -> bool:
        """Tell whether anything is below the heading."""
        tables = any(table.rows for table in self.tables)
        facts = any(self.facts.values())
        return bool(tables or facts or self.words or self.figures or self.items or self.sections or self.notes)


@dataclass(frozen=True)
class Page:
    """A page. It names the object or work, says what was done, and has the first picture, three sentences, facts
    and sections."""

    title: str
    pictures: Sequence[Figure]
    summary: Inline
    """One sentence: what was done."""
    quality: Inline
    """One sentence: how good it is, by a figure."""
    next_step: Inline
    """One sentence: what the reader does next."""
    remark: Inline = ""
    """Words that must be known first, such as that the data are simulated."""
    facts: Mapping[str, Inline] = field(default_factory=dict)
    sections: Sequence[Section] = ()

    @property
    def shown_sections(self) -> list[Section]:
        return [section for section in self.sections if section.has_content]

    def maps(self) -> list[Map]:
        """All maps of the page, with the maps in sections of its sections."""
        maps = [figure for figure in self.pictures if isinstance(figure, Map)]
        waiting = list(self.sections)
        while waiting:
            section = waiting.pop()
            maps += [figure for figure in section.figures if isinstance(figure, Map)]
            waiting += section.sections
        return maps


def anchor(name: str) -> str:
    """Return a name for links inside the page, made from any text."""
    return "".join(letter if letter.isascii() and letter.isalnum() else "-" for letter in name)
