"""`identification.html` of an image cube: map of classes, shares, confidence, and each region's identification."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from coupole.appearance.spectra.envi_cube import Cube
from coupole.errors import StorageError, reason
from coupole.heritage.pigment_maps.image_identification import (
    AMBIGUOUS,
    FIRST_CLASS,
    UNKNOWN,
    UNLIKE,
    ImageFinding,
    ImageRegion,
    named_classes,
)
from coupole.heritage.result_pages import class_maps
from coupole.heritage.result_pages.class_colours import code_colours, css
from coupole.heritage.result_pages.identification_page import PAGE, finding_section, reliability_section
from coupole.heritage.result_pages.identification_record import Origin, new_record, write_record
from coupole.heritage.result_pages.report_parts import (
    compared_section,
    facts_of,
    limits_section,
    remark_of,
    signature_section,
)
from coupole.pages.maps import WIDTH_PX, picture_png, value_map
from coupole.pages.page_parts import (
    Code,
    Drawing,
    Inline,
    Legend,
    Link,
    Page,
    Picture,
    Section,
    Shape,
    Table,
    Verdict,
)
from coupole.pages.page_rendering import write_page
from coupole.storage.durable import make_folder

_STEADY = 0.95


def write(folder: Path, finding: ImageFinding, cube: Cube, origin: Origin) -> Path:
    """Write maps, page and record. Raises StorageError."""
    path = folder / PAGE
    try:
        make_folder(folder)
    except OSError as error:
        raise StorageError(f"{path}: {reason(error)}") from error
    files = class_maps.write_maps(folder, finding, cube)
    findings = [region.finding for region in finding.regions]
    record = new_record(origin, findings, {"map": class_maps.map_document(finding, cube)})
    write_page(path, _page(finding, cube, origin, record))
    write_record(folder, record, [path, *files])
    return path


def _page(finding: ImageFinding, cube: Cube, origin: Origin, record: dict[str, Any]) -> Page:
    step = max(1, -(-max(cube.rows, cube.columns) // (2 * WIDTH_PX)))
    picture = Picture("The object in three bands of the cube (620, 550 and 460 nm, or the nearest)",
                   picture_png(finding.picture[::step, ::step]))  # fmt: skip
    classes = Picture("Classes of pigments; grey: no class is stated", class_maps.class_picture(finding))
    return Page(
        title=f"{cube.header.stem}: map of pigments",
        pictures=[picture, classes],
        summary=[
            f"{finding.looked_at:,} pixels were put into {len(finding.regions)} regions of like spectra, whose "
            "means were compared with the library ",
            Code(origin.library.name),
            ".",
        ],
        quality=_quality(finding),
        next_step=[
            "Look at the regions without a class, and at ", Link("#confidence", "where pixels agree little"),
            "; confirm classes by another method at one point of each.",
        ],
        remark=remark_of(origin),
        facts=facts_of(origin),
        sections=[
            _shares(finding),
            _confidence(finding),
            _regions(finding),
            Section("means", "Mean spectra of the regions", sections=[_region(region) for region in
            finding.regions]), *([reliability_section(finding.regions[0].finding.rates)] if finding.regions else
            []), compared_section(origin),
            limits_section(),
            signature_section(origin, record),
        ],
    )  # fmt: skip


def _quality(finding: ImageFinding) -> str:
    total = max(finding.looked_at, 1)
    stated_pixels = sum(finding.pixels_of(code) for code in range(FIRST_CLASS, len(finding.names)))
    agree = sum(region.agreement * region.pixels for region in finding.regions) / max(
        sum(region.pixels for region in finding.regions), 1
    )
    unknown, ambiguous, unlike = (finding.pixels_of(code) / total for code in (UNKNOWN, AMBIGUOUS, UNLIKE))
    return (
        f"A class or mixture is stated for {stated_pixels / total:.1%} of the pixels. Of all pixels, "
        f"{unknown:.1%} are not "
        "in the "
        f"library, {ambiguous:.1%} are not decided, and {unlike:.1%} are like no region. For {agree:.1%} of the "
        "pixels, the pixel's own spectrum agrees with the answer of its region."
    )


def _shares(finding: ImageFinding) -> Section:
    total, colours = max(finding.looked_at, 1), code_colours(len(finding.names))
    rows: list[Sequence[Inline]] = []
    for code in [*range(FIRST_CLASS, len(finding.names)), AMBIGUOUS, UNKNOWN, UNLIKE]:
        if pixels := finding.pixels_of(code):
            patch = Shape("rect", {"width": 20, "height": 12, "style": f"fill:{css(colours[code])}"})
            swatch = Drawing(f"colour of {finding.names[code]}", 20, 12, [patch], most_px=20)
            rows.append((finding.names[code], swatch, f"{pixels:,}", f"{pixels / total:.1%}"))
    return Section(
        "shares",
        "Shares of classes",
        tables=[Table("Shares of classes", ("class", "colour", "pixels", "share"), rows)],
        notes=[
            "Shares are of pixels, not of pigment. Not in the library: the verdict of the region's mean is "
            "unknown. Not decided: several classes remain, which the table of regions names. Like no region: the "
            "pixel's spectrum is far from all regions; such pixels were not identified."
        ],
    )


def _confidence(finding: ImageFinding) -> Section:
    return Section(
        "confidence",
        "Confidence of the pixels",
        words=[
            "The value is the probability that the pixel's own spectrum gives to the answer of its region: to "
            "the class or one of the classes, or to none of the library. Noise outside the image's main "
            "components was removed."
        ],
        figures=[
            value_map("Probability of the map's answer by the pixel's own spectrum", finding.confidence, "", 1.0)
        ],
    )


def _regions(finding: ImageFinding) -> Section:
    colours = code_colours(len(finding.names))
    rows: list[Sequence[Inline]] = [
        (
            Link(f"#s{region.number}", str(region.number)),
            Verdict(region.finding.verdict, "ok" if region.code >= FIRST_CLASS else "stopped"),
            _answer(region),
            f"{region.finding.candidates[0].probability:.0%}",
            f"{region.finding.not_in_library:.0%}",
            f"{region.share:.1%}",
            f"{region.agreement:.1%}",
        )
        for region in finding.regions
    ]
    head = ("region", "verdict", "class", "probability", "not in library", "share", "pixels agree")
    used_codes = sorted({region.code for region in finding.regions})
    return Section(
        "regions",
        "Regions",
        tables=[Table("Regions", head, rows)],
        legend=Legend({finding.names[code]: css(colours[code]) for code in used_codes}),
        notes=[
            "Pixels agree: share of the region's pixels whose own spectrum has the region's answer.",
            _steadiness(finding),
        ],
    )


def _steadiness(finding: ImageFinding) -> str:
    """Return a sentence about the effect of the means' noise on the answers."""
    words = (
        "The mean of each region was drawn 200 times with its standard error, which follows from the scatter of "
        "the pixels. Errors that all pixels share, such as errors of the white, are not included. The first "
        "class, or the verdict unknown, stayed in "
    )
    unsteady_regions = [region for region in finding.regions if region.draws_alike < _STEADY]
    if not unsteady_regions:
        return f"{words}{_STEADY:.0%} or more of the draws of every region."
    shares = ", ".join(
        f"{region.draws_alike:.0%} of those of region {region.number}" for region in unsteady_regions
    )
    return f"{words}{shares}, and in {_STEADY:.0%} or more of the draws of the other regions."


def _answer(region: ImageRegion) -> str:
    finding = region.finding
    if finding.verdict == "ambiguous":
        return " or ".join(sorted(named_classes(finding)))
    if finding.verdict == "unknown":
        return f"(nearest: {finding.class_name})"
    return " + ".join(part.class_name for part in finding.parts) or finding.class_name


def _region(region: ImageRegion) -> Section:
    name = f"Region {region.number}: {region.finding.verdict}, {_answer(region)}"
    return finding_section(region.number, region.finding, name=name, is_folded=True)
