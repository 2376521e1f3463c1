"""The parts of a page. A page's author gives words and figures; HTML is written by the templates alone.

A page has one order, whatever it shows: title, picture, three sentences, facts, sections. A section has one
order too: words, figures, facts, lists, tables, notes. Words are plain text: the templates escape them.
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
    """A link to a file beside the page, or to `#name` in it; without words its path is shown."""

    kind: ClassVar = "link"
    path: str
    words: str = ""

    @property
    def href(self) -> str:
        """The link's address: letters that mean something in addresses are escaped."""
        return self.path if self.path.startswith("#") else quote(self.path)


@dataclass(frozen=True)
class Code:
    """Something to type, or to compare letter by letter."""

    kind: ClassVar = "code"
    words: str


@dataclass(frozen=True)
class Verdict:
    """A word of judgement; the sign gives its colour, and the word says it without colour."""

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
    """Lines and areas of `width` x `height` units, and what they show in words."""

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
    """Words for whoever does not see it; without them the title is said."""
    is_broad: bool = False
    """True for a picture as wide as the page, where it is the first."""


@dataclass(frozen=True)
class Map:
    """An image whose pixels are values: it has a colour bar, and the page tells the value under the pointer.

    With a `palette` a pixel is one value: its colour's place in the palette, from `low` to `high`. Without one its
    red, green and blue are the values of `names`, each from `low` to `high`, by the power `gamma`.
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
    """Some values are beyond `high` and have its colour."""
    shade_png: bytes = b""
    """Black of which more or less is seen, laid over the map: the shape of what it is a map of."""
    is_broad: bool = False
    """True for a picture as wide as the page, where it is the first."""


@dataclass(frozen=True)
class Plot:
    """A drawing with its title below, and what its colours mean."""

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
        """Columns of numbers alone: they stand to the right, digit below digit."""
        return frozenset(
            column
            for column in range(len(self.head))
            if (cells := [row[column] for row in self.rows if column < len(row) and row[column]])
            and all(isinstance(cell, str) and _NUMBER.fullmatch(cell) for cell in cells)
        )


@dataclass(frozen=True)
class Section:
    """A part of a page that links may lead to, as `#name`. Empty parts are left out."""

    name: str
    heading: Inline
    words: Sequence[Inline] = ()
    figures: Sequence[Figure] = ()
    figure_size: Literal["small", "medium", "triples", "wide"] = "medium"
    legend: Legend | None = None
    """The legend of all figures together."""
    facts: Mapping[str, Inline] = field(default_factory=dict)
    items: Sequence[Inline] = ()
    tables: Sequence[Table] = ()
    notes: Sequence[Inline] = ()
    sections: Sequence[Section] = ()
    is_folded: bool = False
    """True if only the heading is seen until it is asked for; paper has all."""

    @property
    def has_content(self) -> bool:
        """Tell whether anything is below the heading."""
        tables = any(table.rows for table in self.tables)
        facts = any(self.facts.values())
        return bool(tables or facts or self.words or self.figures or self.items or self.sections or self.notes)


@dataclass(frozen=True)
class Page:
    """A page: of what object or work, and what was done; the first picture; three sentences; facts; sections."""

    title: str
    pictures: Sequence[Figure]
    summary: Inline
    """One sentence: what was done."""
    quality: Inline
    """One sentence: how good it is, by a figure."""
    next_step: Inline
    """One sentence: what the reader does next."""
    remark: Inline = ""
    """Words that must be known before all else, as that it is simulated."""
    facts: Mapping[str, Inline] = field(default_factory=dict)
    sections: Sequence[Section] = ()

    @property
    def shown_sections(self) -> list[Section]:
        return [section for section in self.sections if section.has_content]

    def maps(self) -> list[Map]:
        """All maps of the page, those of its sections' sections too."""
        maps = [figure for figure in self.pictures if isinstance(figure, Map)]
        waiting = list(self.sections)
        while waiting:
            section = waiting.pop()
            maps += [figure for figure in section.figures if isinstance(figure, Map)]
            waiting += section.sections
        return maps


def anchor(name: str) -> str:
    """A name for links inside the page, from any text."""
    return "".join(letter if letter.isascii() and letter.isalnum() else "-" for letter in name)
