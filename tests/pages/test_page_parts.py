"""Pages hold what they are given, in one order, and nothing of it is taken for HTML."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from places import REPO

from coupole.errors import StorageError
from coupole.pages.maps import value_map
from coupole.pages.page_charts import Curve, bars, chart, patches
from coupole.pages.page_parts import (
    Cited,
    Code,
    Drawing,
    Figure,
    Inline,
    Link,
    Moment,
    Page,
    Picture,
    Plot,
    Section,
    Shape,
    Table,
    Verdict,
    anchor,
)
from coupole.pages.page_rendering import render, write_page

HOSTILE = """<script>alert("x")</script>' onload='x' & {{ 7 * 7 }}"""
BY_HAND = re.compile(r"<(html|head|body|h[1-6]|table|tr|td|th|figure|svg|dl|section|p|ul|li|img)\b[^>]*>")
ELSEWHERE = ("coupole/console/", "coupole/exchange/", "coupole/viewing/live", "coupole/viewing/view_page.py")
"""Screens of the console, pages to relight and to paint, the live image and the plan in 3D: programs, no
reports."""


class Outline(HTMLParser):
    """The elements of a page, its words, and the values of all attributes."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.words: list[str] = []
        self.values: dict[str, list[str]] = {}

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            self.values.setdefault(name, []).append(value or "")

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def outline(page: Page) -> Outline:
    read = Outline()
    read.feed(render(page))
    return read


def everything(words: str) -> Page:
    """A page of all parts, each with these words."""
    drawing = Drawing(words, 10, 5, [Shape("text", {"x": 1, "y": 2, "class": words}, words)])
    lines: list[Inline] = [words, [words, Code(words)], Link(f"{words}.txt", words), Verdict(words, "ok"), drawing]
    lines += [Moment(words), Cited(words)]
    curve = Curve(words, np.array([0.1, 0.2, 0.3]), np.zeros(3), np.ones(3))
    figures: list[Figure] = [
        Picture(words, b"png"),
        Plot(drawing),
        value_map(words, np.eye(3), words, 1.0),
        chart(words, np.array([400.0, 500.0, 600.0]), [curve]),
        patches(words, [(words, (1, 2, 3))]),
        bars(words, [(words, 0.5)], words),
    ]
    section = Section(
        "part",
        words,
        words=lines,
        figures=figures,
        facts={words: words},
        items=lines,
        tables=[Table(words, [words, words], [lines[:2]])],
        notes=lines,
        sections=[Section("inner", words, words=lines, is_folded=True)],
    )
    return Page(words, figures[:1], words, words, words, words, {words: words}, [section])


def test_no_words_are_taken_for_html_wherever_they_stand() -> None:
    tame, hostile = outline(everything("tame")), outline(everything(HOSTILE))
    assert hostile.tags == tame.tags
    assert HOSTILE in hostile.words
    assert not any("49" in words for words in hostile.words if "onload" in words)
    assert "onload" not in hostile.values
    for name in ("aria-label", "alt", "title", "href"):
        assert len(hostile.values.get(name, [])) == len(tame.values.get(name, []))


def test_a_page_says_title_picture_three_sentences_facts_and_parts_in_this_order() -> None:
    text = render(everything("word"))
    places = [
        text.index(mark) for mark in ("<h1>", "<img", "<dt>What</dt>", "<dt>How good</dt>", "<dt>What to do</dt>")
    ]
    places += [text.index(mark) for mark in ("<dt>word</dt>", '<section id="part">')]
    assert places == sorted(places)
    part = text[text.index('<section id="part">') :]
    order = [part.index(mark) for mark in ("<p>", "<figure>", "<dl>", "<ul><li>word", "<table>", 'class="note"')]
    assert order == sorted(order)
    assert part.index('class="note"') < part.index("<details>")


def test_what_is_empty_is_left_out_and_long_pages_have_contents() -> None:
    empty = Section("nothing", "Nothing", facts={"a": ""}, tables=[Table("none", ("a",), [])])
    parts = [Section(f"s{k}", f"Part {k}", words=["."]) for k in range(5)]
    short = render(Page("t", [], "a", "b", "c", sections=[empty, *parts[:2]]))
    assert "Nothing" not in short
    assert "<nav" not in short
    assert "<script" not in short
    assert render(Page("t", [], "a", "b", "c", sections=parts)).count('<li><a href="#s') == 5


def test_numbers_stand_to_the_right_and_words_to_the_left() -> None:
    rows = [("a", "1.5", "+3 %", "held", ""), ("b", "-2e-05", "4.25 %", "7", "")]
    assert Table("t", ("n", "x", "y", "z", "e"), rows).numeric_columns == {1, 2}


def test_a_caption_that_says_the_heading_again_is_only_for_screen_readers() -> None:
    tables = [Table("Scans", ("a",), [("1",)]), Table("Points", ("a",), [("1",)])]
    html = render(Page("t", [], "a", "b", "c", sections=[Section("scans", "Scans", tables=tables)]))
    assert '<caption class="unseen">Scans</caption>' in html
    assert "<caption>Points</caption>" in html


def test_a_page_that_cannot_be_written_says_where(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"nowhere/page\.html: cannot write the page: No such file"):
        write_page(tmp_path / "nowhere/page.html", everything("a"))


def test_files_with_strange_names_are_linked_as_files() -> None:
    assert Link("a b#1?.txt").href == "a%20b%231%3F.txt"
    assert Link("javascript:alert(1)").href == "javascript%3Aalert%281%29"
    assert (Link("views/top.h5").href, Link("#part").href) == ("views/top.h5", "#part")


def test_names_for_links_have_no_letters_that_would_need_an_escape() -> None:
    assert anchor('top "left"/ä<') == "top--left----"


def test_no_report_is_put_together_from_strings() -> None:
    """All pages have their HTML from `coupole/pages/templates`; programs in a browser have files of their own."""
    found = []
    for path in sorted((REPO / "coupole").rglob("*.py")):
        name = path.relative_to(REPO).as_posix()
        if not name.startswith(ELSEWHERE) and BY_HAND.search(path.read_text(encoding="utf-8")):
            found.append(name)
    assert found == []
