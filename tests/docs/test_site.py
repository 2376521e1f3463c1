"""The site: its source is whole, its checks find what they are for, and the built one is clean in a browser."""

from __future__ import annotations

import re
import subprocess
import sys
import unicodedata
from pathlib import Path

import pytest
from browser import Browser, needs_chromium
from places import REPO

sys.path.insert(0, str(REPO / "tools"))

import site_checks
import site_commands
import site_source
from coupole.commands.cli import GROUPS
from site_notebooks import ORDER

DOCS = REPO / "docs"
PAGES = ("index.html", "how-to/home-built-dome.html", "reference/run-folder.html", "reference/commands/cell.html")
HTML = '<html><body><article><a href="{link}">on</a> {text}</article></body></html>'


@pytest.fixture(scope="module")
def staged(tmp_path_factory: pytest.TempPathFactory) -> site_source.Source:
    """The source of the site, with notebooks that were not run."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "shown").mkdir()
    pages = site_commands.pages() | {f"{site_source.NOTEBOOKS}/{name}.md": f"# {name}\n" for name in ORDER}
    return site_source.stage(folder / "source", made_pages=pages, made_files=folder / "shown")


def anchors(text: str) -> set[str]:
    """Places on a page that a link can name: its headings, as forges and MyST write them."""
    headings = [
        match
        for is_prose, part in site_source.prose(text)
        if is_prose
        for match in re.findall(r"^#+ +(.+)$", part, re.MULTILINE)
    ]
    plain = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "") for heading in headings]
    return {
        re.sub(r"[^\w\- ]", "", unicodedata.normalize("NFKC", one.lower())).strip().replace(" ", "-")
        for one in plain
    }


def test_no_link_of_the_pages_is_broken(staged: site_source.Source) -> None:
    assert staged.broken_links == []


def test_no_text_has_the_marks_of_a_merge_that_was_not_finished() -> None:
    marks = re.compile(r"^(<{7} |={7}$|>{7} )", re.MULTILINE)
    texts = [*REPO.glob("*.md"), *DOCS.rglob("*.md")]
    assert REPO / "CHANGELOG.md" in texts
    assert [path.name for path in texts if marks.search(path.read_text(encoding="utf-8"))] == []


def test_places_that_links_name_are_on_their_pages() -> None:
    missing = []
    for path in [REPO / "README.md", *sorted(DOCS.rglob("*.md"))]:
        text = path.read_text(encoding="utf-8")
        for target in re.findall(r"\]\(([^()\s]*#[^()\s]+)\)", text):
            file, _, place = target.partition("#")
            if "://" in target or (file and not file.endswith(".md")):
                continue
            page = path.parent / file if file else path
            if not page.is_file() or place not in anchors(page.read_text(encoding="utf-8")):
                missing.append(f"{path.relative_to(REPO)}: {target}")
    assert missing == []


def test_each_page_is_in_the_contents_of_one_index_page(staged: site_source.Source) -> None:
    listed: list[str] = []
    for index in site_source.INDEX_PAGES:
        text = (staged.folder / index).read_text(encoding="utf-8")
        names = text.partition("```{toctree}\n:hidden:\n\n")[2].split("```")[0].split()
        listed += [str((staged.folder / index).parent.joinpath(name).resolve()) for name in names]
    pages = {str(path) for path in staged.folder.rglob("*.md") if path != staged.folder / "index.md"}
    assert sorted(listed) == sorted(pages)


def test_pages_of_the_forge_are_those_of_the_site_but_for_their_links(staged: site_source.Source) -> None:
    for path in DOCS.rglob("*.md"):
        name = str(path.relative_to(DOCS))
        shown = (staged.folder / name).read_text(encoding="utf-8")
        words = [
            re.sub(r"\[([^\]]*)\]\([^)]*\)|`[^`]*`", "", text)
            for text in (path.read_text(encoding="utf-8"), shown)
        ]
        if name not in {*site_source.INDEX_PAGES, site_commands.PAGE}:
            assert words[0] == words[1], name


def test_the_reference_names_each_command_under_its_heading() -> None:
    parts = (DOCS / site_commands.PAGE).read_text(encoding="utf-8").split("\n## ")[1:]
    assert [part.partition("\n")[0] for part in parts] == list(GROUPS)
    for part, names in zip(parts, GROUPS.values(), strict=True):
        assert [name for name in names if not re.search(rf"`coupole {name}\b", part)] == []


def test_a_link_that_leads_nowhere_is_named_with_its_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    docs = tmp_path / "docs"
    (docs / "how-to").mkdir(parents=True)
    (tmp_path / "configs/rigs").mkdir(parents=True)
    (tmp_path / "configs/plan.yaml").write_text("name: x\n")
    (tmp_path / "CHANGELOG.md").write_text("# Changelog\n")
    (docs / "how-to/page.md").write_text(
        "# A page\n\n[gone](gone.md) [plan](../../configs/plan.yaml) [configs/rigs](../../configs/rigs/)\n\n"
        "```\n[code](is-no-link.md)\n```\n"
    )
    monkeypatch.setattr(site_source, "REPO", tmp_path)
    monkeypatch.setattr(site_source, "DOCS", docs)
    (tmp_path / "shown").mkdir()
    staged = site_source.stage(tmp_path / "source", made_pages={}, made_files=tmp_path / "shown")
    assert staged.broken_links == ["docs/how-to/page.md:3: gone.md is not there"]
    shown = (staged.folder / "how-to/page.md").read_text()
    assert "gone [plan](../files/configs/plan.yaml) `configs/rigs/`\n" in shown
    assert (staged.folder / "files/configs/plan.yaml").read_text() == "name: x\n"


@pytest.mark.parametrize(
    ("file", "text", "named"),
    [
        ("index.html", '<script src="https://cdn.example.org/a.js"></script>', "https://cdn.example.org/a.js"),
        ("index.html", '<link rel="stylesheet" href="//fonts.example.org/css">', "//fonts.example.org/css"),
        ("index.html", '<img srcset="a.png 1x, http://example.org/b.png 2x">', "http://example.org/b.png"),
        ("index.html", '<p style="background: url(https://example.org/p.png)">', "https://example.org/p.png"),
        ("a.css", "@import 'https://example.org/a.css';", "https://example.org/a.css"),
        ("a.css", "@font-face { src: url('//example.org/a.woff2') }", "//example.org/a.woff2"),
        ("a.js", "fetch('https://example.org/a.json')", "fetch('https://"),
        ("a.js", 'script.src = "https://example.org/a.js"', '.src = "https://'),
    ],
)
def test_what_comes_from_another_host_is_found(tmp_path: Path, file: str, text: str, named: str) -> None:
    (tmp_path / "index.html").write_text(
        HTML.format(link="https://example.org/read", text="a link is no resource")
    )
    clean = {path: site_checks.Page(path) for path in tmp_path.rglob("*.html")}
    assert site_checks.foreign_resources(tmp_path, clean) == []
    (tmp_path / file).write_text(text)
    pages = {path: site_checks.Page(path) for path in tmp_path.rglob("*.html")}
    assert site_checks.foreign_resources(tmp_path, pages) == [f"{file}: fetches {named} from another host"]


def test_a_heavy_landing_page_and_far_answers_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(site_checks, "QUESTIONS", {"Where?": "here it is", "Who?": "nobody"})
    for number in range(5):
        text = "here it is" if number == 4 else ""
        name = "index.html" if number == 0 else f"{number}.html"
        (tmp_path / name).write_text(HTML.format(link=f"{number + 1}.html", text=text))
    found = site_checks.findings(tmp_path)
    assert found == [
        "Where? The answer is 4 clicks away; at most 3 are allowed",
        "Who? No page has the answer, or no link leads there",
    ]
    (tmp_path / "big.css").write_text("body { background: url('big.png') }")
    (tmp_path / "big.png").write_bytes(bytes(1_000_000))
    with (tmp_path / "index.html").open("a") as file:
        file.write('<link rel="stylesheet" href="big.css">')
    assert "bytes at first sight" in site_checks.findings(tmp_path)[0]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site as tools/make_site.py builds it, with notebooks that were not run."""
    to: Path = tmp_path_factory.mktemp("built") / "site"
    ended = subprocess.run(
        [REPO / "tools/site", "--do-not-run", "--to", to], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr
    return to


@pytest.fixture(scope="module")
def browser() -> Browser:
    return Browser()


@pytest.mark.full
@needs_chromium
@pytest.mark.parametrize("page", PAGES)
@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (1280, "dark"), (390, "light"), (390, "dark")])
def test_pages_have_no_barriers_at_a_desk_and_on_a_telephone(
    site: Path, browser: Browser, page: str, width: int, scheme: str
) -> None:
    from axe_selenium_python import Axe

    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    browser.open((site / page).as_uri())
    axe = Axe(browser.driver)
    axe.inject()
    found = [(one["id"], [node["target"] for node in one["nodes"]]) for one in axe.run()["violations"]]
    assert found == []
    assert not browser.run("document.documentElement.scrollWidth > window.innerWidth + 1")
    assert browser.troubles() == []


@pytest.mark.full
@needs_chromium
def test_search_works_from_the_disk(site: Path, browser: Browser) -> None:
    browser.open(f"{(site / 'search.html').as_uri()}?q=hand-eye")
    assert "calibrat" in browser.text("#search-results li a").lower()
