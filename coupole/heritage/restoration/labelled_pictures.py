"""Labels for pictures of hypotheses: each picture says, in a strip below it and in its metadata, that it shows a
hypothesis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from coupole.heritage.restoration.restoration_file import Hypothesis

Picture = NDArray[np.uint8]
DISCLAIMER = "A hypothesis, computed by spectral path tracing: not a photograph, and not a proof of how it was."
_MOST_LINES = 7
_STRIP, _INK = (24, 25, 28), (214, 212, 206)
_SPACES = {
    "dc": "http://purl.org/dc/elements/1.1/",
    "rdf": "http://www.w3.org/1999/02/22-rdf-syntax-ns#",
    "x": "adobe:ns:meta/",
}
_LANGUAGE = "{http://www.w3.org/XML/1998/namespace}lang"
_XMP_KEYWORD = "XML:com.adobe.xmp"


def metadata_texts(hypotheses: Sequence[Hypothesis]) -> dict[str, str]:
    """Return texts for the metadata of a picture of one or more hypotheses, by their keywords."""
    names = "; ".join(f"{hypothesis.name}: {hypothesis.title}" for hypothesis in hypotheses)
    several = len(hypotheses) > 1
    sources = "\n".join(
        f"{hypothesis.name}: {source}" if several else str(source)
        for hypothesis in hypotheses
        for source in hypothesis.sources
    )
    return {"Hypothesis": names, "Sources": sources, "Disclaimer": DISCLAIMER}


def for_png(texts: Mapping[str, str]) -> dict[str, str]:
    """Return the same texts, also as XMP (ISO 16684-1: Dublin Core's title, description and source)."""
    return {**texts, "Title": f"Hypothesis: {texts['Hypothesis']}", _XMP_KEYWORD: _xmp(texts)}


def for_exr(texts: Mapping[str, str]) -> dict[str, str]:
    """Return texts under the names that EXR attributes may have."""
    return {keyword.lower(): words for keyword, words in texts.items()}


def restamp_exr(path: Path, attributes: Mapping[str, str]) -> None:
    """Give an EXR these attributes, unless it has them. Raises OSError, RuntimeError."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        header: dict[str, Any] = file.header()
        if all(header.get(name) == value for name, value in attributes.items()):
            return
        header.update(attributes)
        part = path.with_name(f".{path.name}.part")
        file.write(str(part))
    part.replace(path)


def captioned_picture(picture: Picture, hypothesis: Hypothesis, lines: int | None = None) -> Picture:
    """Return the picture [h, w, 3] with a strip of some lines below it: the word, title and references."""
    caption = caption_lines(picture.shape[1], hypothesis)
    return with_strip(picture, caption, lines or len(caption))


def caption_lines(width_px: int, hypothesis: Hypothesis) -> list[str]:
    """Return the lines of the strip, broken for a picture of this width. If the sources are too long, the last
    line says where all of them are."""
    references = "; ".join(dict.fromkeys(source.reference for source in hypothesis.sources))
    words = [f"Hypothesis: {hypothesis.title} (simulated)", f"Sources: {references}"]
    lines = [line for paragraph in words for line in break_lines(paragraph, width_px)]
    if len(lines) > _MOST_LINES:
        lines = [*lines[: _MOST_LINES - 1], "... (all of them in the file's metadata)"]
    return lines


def with_strip(picture: Picture, lines: Sequence[str], room: int) -> Picture:
    """Return the picture with lines of text below it, and room for the given number of lines."""
    from PIL import Image, ImageDraw

    height, width = picture.shape[:2]
    size = _size(width)
    pitch = round(1.35 * size)
    sheet = Image.new("RGB", (width, height + room * pitch + size), _STRIP)
    sheet.paste(Image.fromarray(picture), (0, 0))
    pen = ImageDraw.Draw(sheet)
    for number, line in enumerate(lines):
        pen.text((size, height + size // 2 + number * pitch), line, _INK, _font(size))
    return np.asarray(sheet)


# -- helpers --------------------------------------------------------------------------------------------------


def _size(width_px: int) -> int:
    return int(np.clip(round(width_px / 46), 9, 28))


def _font(size: int) -> Any:
    """Return DejaVu Sans from matplotlib, which has the letters of most European languages."""
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size)


def break_lines(words: str, width_px: int) -> list[str]:
    """Return lines that fit the strip; a word that is longer than a line is broken."""
    size = _size(width_px)
    font, room = _font(size), max(width_px - 2 * size, 4 * size)
    lines = [""]
    for word in words.split():
        rest = word
        if font.getlength(f"{lines[-1]} {rest}") <= room:
            lines[-1] = f"{lines[-1]} {rest}".strip()
            continue
        while font.getlength(rest) > room:
            fits = next(k for k in range(len(rest) - 1, 0, -1) if k == 1 or font.getlength(rest[:k]) <= room)
            lines.append(rest[:fits])
            rest = rest[fits:]
        lines.append(rest)
    return [line for line in lines if line]


def _xmp(texts: Mapping[str, str]) -> str:
    for prefix, space in _SPACES.items():
        ElementTree.register_namespace(prefix, space)
    dc, rdf, x = ("{" + _SPACES[prefix] + "}" for prefix in ("dc", "rdf", "x"))
    root = ElementTree.Element(f"{x}xmpmeta")
    about = ElementTree.SubElement(
        ElementTree.SubElement(root, f"{rdf}RDF"), f"{rdf}Description", {f"{rdf}about": ""}
    )
    for name, words in (
        ("title", f"Hypothesis: {texts['Hypothesis']}"),
        ("description", texts["Disclaimer"]),
    ):
        kinds = ElementTree.SubElement(ElementTree.SubElement(about, f"{dc}{name}"), f"{rdf}Alt")
        line = ElementTree.SubElement(kinds, f"{rdf}li", {_LANGUAGE: "x-default"})
        line.text = words
    ElementTree.SubElement(about, f"{dc}source").text = texts["Sources"]
    packet = ElementTree.tostring(root, encoding="unicode")
    return f'<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>{packet}<?xpacket end="r"?>'
