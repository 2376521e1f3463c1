"""The files for the real controller: what the tool writes, and what the drivers' defaults ask for."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from arms import KR10_R1100_SIXX
from places import REPO

from drivers.kuka import eki as kuka_eki
from drivers.kuka import rsi as kuka_rsi
from drivers.kuka.eki import wire
from drivers.kuka.rsi.corrections import NAMES
from drivers.kuka.rsi.wire import answer_template, stop_element
from sim.devices.kuka_settings import Limits

ROOT = REPO
KUKA = ROOT / "configs" / "kuka"
OF_RSI = {"arm_model": KR10_R1100_SIXX, "any_controller_by": "A. Person"}


@pytest.fixture(scope="module")
def tool() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "tools" / "make_kuka_files.py"))


@pytest.fixture(scope="module")
def rsi() -> ElementTree.Element:
    return ElementTree.parse(KUKA / "rsi" / "coupole_rsi_ethernet.xml").getroot()


@pytest.fixture(scope="module")
def eki() -> ElementTree.Element:
    return ElementTree.parse(KUKA / "eki" / "CoupoleEki.xml").getroot()


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_the_committed_files_are_what_the_tool_writes(tool: dict[str, Any], tmp_path: Path) -> None:
    tool["main"](["--output", str(tmp_path)])
    assert tree(tmp_path) == tree(KUKA)


def test_rsi_names_the_port_the_type_and_asks_for_answers(rsi: ElementTree.Element) -> None:
    settings = kuka_rsi.Settings(**OF_RSI)
    assert rsi.tag == "ROOT"
    assert rsi.findtext("CONFIG/PORT") == settings.listen.rsplit(":", 1)[1]
    assert rsi.findtext("CONFIG/SENTYPE") == settings.sen_type
    assert rsi.findtext("CONFIG/ONLYSEND") == "FALSE"


def test_rsi_sends_what_the_driver_reads(rsi: ElementTree.Element) -> None:
    settings = kuka_rsi.Settings(**OF_RSI)
    elements = [element.attrib for element in rsi.iterfind("SEND/ELEMENTS/ELEMENT")]
    assert {f"DEF_{settings.measured_tag}", f"DEF_{settings.delay_tag}"} <= {e["TAG"] for e in elements}
    assert {element["INDX"] for element in elements} == {"INTERNAL"}


@pytest.mark.parametrize(("mode", "hold_on"), [("absolute", "1"), ("relative", "0")])
@pytest.mark.parametrize("corrects", ["axes", "pose"])
def test_rsi_receives_what_the_driver_sends_and_holds_what_may_be_held(
    tool: dict[str, Any], corrects: str, mode: str, hold_on: str
) -> None:
    settings = kuka_rsi.Settings.model_validate(OF_RSI | {"corrects": corrects, "mode": mode})
    template = answer_template(settings.sen_type, settings.tag, NAMES[corrects], stop_element("Stop", stops=True))
    sent = ElementTree.fromstring(template % (*(0.0,) * 6, b"1"))
    corrections = [f"{child.tag}.{name}" for child in sent for name in child.attrib]
    assert sent.findtext("Stop") == "1"
    configuration = ElementTree.fromstring(tool["rsi_xml"](settings, "192.168.1.10"))
    outputs = [e for e in configuration.iterfind("RECEIVE/ELEMENTS/ELEMENT") if e.get("INDX") != "INTERNAL"]
    assert [e.get("TAG") for e in outputs] == [*corrections, "Stop"]
    assert [e.get("INDX") for e in outputs] == ["1", "2", "3", "4", "5", "6", "7"]
    assert {e.get("HOLDON") for e in outputs[:6]} == {hold_on}
    assert (outputs[6].get("TYPE"), outputs[6].get("HOLDON")) == ("BOOL", "0")


def test_without_a_stop_tag_neither_configuration_nor_context_stops(tool: dict[str, Any], tmp_path: Path) -> None:
    tool["main"](["--output", str(tmp_path), "--rsi", '{"stop_tag": ""}'])
    for name, word in (("coupole_rsi_ethernet.xml", '"Stop"'), ("context.md", "STOP1")):
        assert word in (KUKA / "rsi" / name).read_text()
        assert word not in (tmp_path / "rsi" / name).read_text()


@pytest.mark.parametrize(
    ("settings", "objects"),
    [
        ('{"axis_correction_deg": [30, 20, 20, 90, 60, 170]}', "`MaxA1` = 30; `MaxA2` = 20;"),
        ('{"corrects": "pose", "pose_correction_mm": 400}', "`POSCORRMON1`"),
        ('{"corrects": "pose", "pose_correction_mm": 400}', "`LowerLimX` to `UpperLimZ` = +-401 mm"),
        ('{"corrects": "pose"}', "`RefCorrSys` = BASE"),
        ('{"mode": "relative"}', "HOLDON is 0"),
    ],
)
def test_the_context_says_the_limits_and_the_meaning_of_the_settings(
    tool: dict[str, Any], tmp_path: Path, settings: str, objects: str
) -> None:
    tool["main"](["--output", str(tmp_path), "--rsi", settings])
    assert objects in (tmp_path / "rsi" / "context.md").read_text()


def test_the_monitor_stops_rsi_before_the_correction_is_clamped(tool: dict[str, Any]) -> None:
    stand_in = Limits()
    assert kuka_rsi.Settings(**OF_RSI).most_correction_deg == stand_in.axis_monitor_deg
    assert stand_in.axis_clamp_deg == tuple(limit + 1 for limit in stand_in.axis_monitor_deg)
    for axis, clamp in enumerate(stand_in.axis_clamp_deg, start=1):
        assert f"A{axis} +-{clamp:g}" in tool["correction_rows"](kuka_rsi.Settings(**OF_RSI))
    assert kuka_rsi.Settings(**OF_RSI).pose_correction_mm == stand_in.pose_monitor_mm < stand_in.pose_clamp_mm


@pytest.mark.parametrize(("mode", "word"), [("absolute", "#ABSOLUTE"), ("relative", "#RELATIVE")])
def test_rsi_is_started_in_the_mode_of_the_settings(
    tool: dict[str, Any], tmp_path: Path, mode: str, word: str
) -> None:
    tool["main"](["--output", str(tmp_path), "--rsi", f'{{"mode": "{mode}"}}'])
    assert f"RSI_ON({word},#IPO_FAST)" in (tmp_path / "rsi" / "coupole_rsi.src").read_text()


@pytest.mark.parametrize(("cycle_ms", "mode"), [(4, "#IPO_FAST"), (12, "#IPO")])
def test_rsi_runs_in_the_cycle_of_the_settings(
    tool: dict[str, Any], tmp_path: Path, cycle_ms: int, mode: str
) -> None:
    tool["main"](["--output", str(tmp_path), "--rsi", f'{{"cycle_ms": {cycle_ms}}}'])
    program = (tmp_path / "rsi" / "coupole_rsi.src").read_text()
    assert f"RSI_ON(#ABSOLUTE,{mode})" in program
    committed = (KUKA / "rsi" / "coupole_rsi.src").read_text()
    assert (committed == program) == (kuka_rsi.Settings(**OF_RSI).cycle_ms == cycle_ms)


def test_rsi_starts_where_the_arm_stands() -> None:
    program = (KUKA / "rsi" / "coupole_rsi.src").read_text()
    places = [program.index(s) for s in ("PTP $AXIS_ACT_MEAS", "RSI_CREATE", "RSI_ON", "RSI_MOVECORR", "RSI_OFF")]
    assert places == sorted(places)


def test_eki_listens_where_the_driver_connects(eki: ElementTree.Element) -> None:
    internal = eki.find("CONFIGURATION/INTERNAL")
    assert internal is not None
    assert eki.findtext("CONFIGURATION/EXTERNAL/TYPE") == "Client"
    assert (
        f"{internal.findtext('IP')}:{internal.findtext('PORT')}"
        == kuka_eki.Settings(arm_model=KR10_R1100_SIXX).address
    )
    assert internal.findtext("PROTOCOL") == "TCP"


def test_eki_connects_where_the_driver_listens(tool: dict[str, Any]) -> None:
    settings = kuka_eki.Settings(**OF_RSI, controller_is="client", address="192.168.1.10:54601")
    configuration = ElementTree.fromstring(tool["eki_xml"](settings))
    external = configuration.find("CONFIGURATION/EXTERNAL")
    assert external is not None
    assert [child.text for child in external] == ["Server", "192.168.1.10", "54601"]
    assert configuration.find("CONFIGURATION/INTERNAL/PORT") is None


def test_eki_receives_every_element_of_a_command(eki: ElementTree.Element) -> None:
    command = ElementTree.fromstring(wire.command_xml(wire.Command(1, 2, wire.MOVE, 50, 50, (0.0,) * 6)))
    sent = [f"{command.tag}/{child.tag}/@{name}" for child in command for name in child.attrib]
    received = [e.attrib for e in eki.iterfind("RECEIVE/XML/ELEMENT")]
    assert [e["Tag"] for e in received if "Type" in e] == sent
    assert [e["Tag"] for e in received if "Set_Flag" in e] == [command.tag]


def test_eki_sends_every_element_that_a_status_is_read_from(eki: ElementTree.Element) -> None:
    message = ElementTree.Element(wire.ROOT)
    for element in eki.iterfind("SEND/XML/ELEMENT"):
        root, child, name = element.attrib["Tag"].replace("@", "").split("/")
        assert root == wire.ROOT
        node = message.find(child)
        node = ElementTree.SubElement(message, child) if node is None else node
        assert name not in node.attrib
        node.set(name, "1")
    assert len(wire.StatusReader().feed(ElementTree.tostring(message))) == 1


def test_eki_statuses_come_at_the_rate_of_the_settings() -> None:
    program = (KUKA / "eki" / "coupole_link.src").read_text()
    assert f"$ROB_TIMER-CP_SENT_MS>={kuka_eki.Settings(arm_model=KR10_R1100_SIXX).status_ms})" in program


def test_the_eki_programs_touch_just_the_elements_that_are_configured(eki: ElementTree.Element) -> None:
    program = (KUKA / "eki" / "coupole_link.src").read_text()
    for verb, section in (("Get", "RECEIVE"), ("Set", "SEND")):
        used = re.findall(rf'EKI_{verb}\w+\("CoupoleEki","([^"]+)"', program)
        assert used == [e.get("Tag") for e in eki.iterfind(f"{section}/XML/ELEMENT") if "Set_Flag" not in e.attrib]


@pytest.mark.parametrize("name", ["eki/coupole_eki", "eki/coupole_link", "rsi/coupole_rsi"])
def test_the_programs_are_whole(name: str) -> None:
    program = re.sub(r";.*", "", (KUKA / f"{name}.src").read_text())
    words = re.findall(r"\w+", program)
    for opening, closing in (
        ("DEF", "END"),
        ("DEFFCT", "ENDFCT"),
        ("IF", "ENDIF"),
        ("LOOP", "ENDLOOP"),
        ("WHILE", "ENDWHILE"),
        ("FOR", "ENDFOR"),
        ("REPEAT", "UNTIL"),
    ):
        loops = words.count(opening) - len(re.findall(r"WAIT FOR", program)) * (opening == "FOR")
        assert loops == words.count(closing), opening
    assert not re.search(r"@[A-Z_]{3,}@", program)
    assert (KUKA / f"{name}.dat").read_text().rstrip().endswith("ENDDAT")


def test_every_variable_of_the_programs_is_declared() -> None:
    programs = "".join((KUKA / "eki" / f"coupole_{n}.src").read_text() for n in ("eki", "link"))
    declared = (KUKA / "eki" / "coupole_link.dat").read_text()
    used = set(re.findall(r"\bCP_\w+", programs))
    assert used == set(re.findall(r"\bCP_\w+", declared))
    shared = set(re.findall(r"\bCP_\w+", (KUKA / "eki" / "coupole_eki.src").read_text()))
    assert shared <= set(re.findall(r"GLOBAL \w+ (CP_\w+)", declared))


def test_names_are_no_longer_than_krl_allows() -> None:
    for path in KUKA.rglob("*.src"):
        program = re.sub(r";.*|\"[^\"]*\"", "", path.read_text())
        assert max(map(len, re.findall(r"[A-Za-z_]\w*", program))) <= 24
