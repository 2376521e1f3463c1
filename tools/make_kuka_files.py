"""Writes the files that a KUKA controller needs for Coupole's two drivers: RSI and EthernetKRL.

    python tools/make_kuka_files.py [--output configs/kuka] [--pc-address 192.168.1.10]
                                    [--rsi JSON] [--eki JSON] [--load 1]

Ports, tags, cycle and rates come from the drivers' own settings: their defaults, or those given as JSON, as in
a rig's `robot: settings:`. KRL is made from the templates in `tools/kuka`. The same options give the same bytes.
Installation: docs/how-to/kuka-controller.md.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterable
from pathlib import Path

from coupole.plan.arm_description import shipped_arm
from drivers.kuka import eki as kuka_eki
from drivers.kuka import rsi as kuka_rsi
from drivers.kuka.eki import wire
from drivers.kuka.rsi.corrections import NAMES

ROOT = Path(__file__).resolve().parents[1]
TEMPLATES = ROOT / "tools" / "kuka"

EKI_NAME, RSI_CONTEXT, RSI_CONFIG = "CoupoleEki", "coupole_rsi", "coupole_rsi_ethernet.xml"
ALIVE_FLAG, RECEIVED_FLAG, ORDER_FLAG = 501, 502, 503
"""Elements of $FLAG: connection alive, message received, order for the robot program."""
STOP_OUTPUT = 7
"""Output of the ETHERNET object that ends the program; 1 to 6 are the corrections."""
STOP_NOTE = """\
- `STOP1` ends RSI_MOVECORR when the driver is closed, with the arm at rest: the program goes on to RSI_OFF and its
  end, without an error. Whatever else silences the PC still ends in KSS29002. RSI_MOVECORR must be what runs:
  outside of it the same input is an error.
"""
"""Note about the object that ends the program."""
PING_S = 1
"""EKI's shortest interval for detecting that the PC is gone."""

KRL_COMMAND = {
    "Command/@Session": "CP_IN_SESSION",
    "Command/@Number": "CP_IN_NUMBER",
    "Command/@Verb": "CP_IN_VERB",
    "Command/@Velocity": "CP_IN_VELOCITY",
    "Command/@Acceleration": "CP_IN_ACCELERATION",
} | {f"Axes/@A{axis}": f"CP_IN_AXES.A{axis}" for axis in range(1, 7)}
"""Variable of coupole_link.dat for each element."""
KRL_STATUS = (
    {
        "Status/@Session": "CP_SESSION",
        "Status/@Taken": "CP_TAKEN",
        "Status/@Done": "DONE",
        "Status/@Moving": "MOVING",
        "Status/@Fault": "FAULT",
        "Status/@Time": "$ROB_TIMER",
        "Status/@Override": "$OV_PRO",
        "Status/@T1": "T1",
        "Status/@Lapsed": "CP_LAPSED",
        "Arm/@Model": "$MODEL_NAME[]",
        "Arm/@Serial": "$KR_SERIALNO",
        "Pose/@Valid": "POSE_VALID",
    }
    | {f"Axes/@A{axis}": f"$AXIS_ACT_MEAS.A{axis}" for axis in range(1, 7)}
    | {f"Pose/@{name}": f"CP_POSE.{name}" for name in "XYZABC"}
)
"""Value that the controller sends in each element."""
WIRE_NUMBERS = (
    *("STOP", "MOVE", "ASK", "BEAT", "BEAT_MS", "NO_FAULT", "EMERGENCY_STOP", "DRIVES_OFF"),
    *("STOP_MESSAGE", "PROGRAM_ENDED", "TARGET_REFUSED"),
)
"""Numbers of the wire protocol used in the programs."""
_KRL_TYPE = {"INT": "Int", "REAL": "Real", "STRING": "String"}


def rsi_xml(settings: kuka_rsi.Settings, pc_address: str) -> str:
    """Configuration of the ETHERNET object: elements sent, elements received, address."""
    host, port = settings.listen.rsplit(":", 1)
    send_elements = "\n".join(
        f'      <ELEMENT TAG="DEF_{tag}" TYPE="{kind}" INDX="INTERNAL"/>'
        for tag, kind in (("RIst", "DOUBLE"), (settings.measured_tag, "DOUBLE"), (settings.delay_tag, "LONG"))
    )
    # With HOLDON, an absolute correction keeps the arm in place; a relative correction would keep moving it.
    hold_on = {"absolute": 1, "relative": 0}[settings.mode]
    receive_elements = "\n".join(
        f'      <ELEMENT TAG="{settings.tag}.{name}" TYPE="DOUBLE" INDX="{index}" HOLDON="{hold_on}"/>'
        for index, name in enumerate(NAMES[settings.corrects], start=1)
    )
    if settings.stop_tag:  # without HOLDON, because it must not outlast the program that it ends
        receive_elements += (
            f'\n      <ELEMENT TAG="{settings.stop_tag}" TYPE="BOOL" INDX="{STOP_OUTPUT}" HOLDON="0"/>'
        )
    return f"""\
<ROOT>
  <CONFIG>
    <IP_NUMBER>{pc_address if host == "0.0.0.0" else host}</IP_NUMBER>
    <PORT>{port}</PORT>
    <SENTYPE>{settings.sen_type}</SENTYPE>
    <ONLYSEND>FALSE</ONLYSEND>
  </CONFIG>
  <SEND>
    <ELEMENTS>
{send_elements}
    </ELEMENTS>
  </SEND>
  <RECEIVE>
    <ELEMENTS>
      <ELEMENT TAG="DEF_EStr" TYPE="STRING" INDX="INTERNAL"/>
{receive_elements}
    </ELEMENTS>
  </RECEIVE>
</ROOT>
"""


def eki_xml(settings: kuka_eki.Settings) -> str:
    """Configuration of the EthernetKRL connection. The flag is set when a complete message has arrived."""
    host, port = settings.address.rsplit(":", 1)
    here = f"<IP>{host}</IP>\n      <PORT>{port}</PORT>"
    if settings.controller_is == "server":
        external, internal = "<TYPE>Client</TYPE>", f"\n      {here}"
    else:
        external, internal = f"<TYPE>Server</TYPE>\n      {here}", ""
    receive_elements = "\n".join(
        f'      <ELEMENT Tag="{wire.ROOT}/{path}" Type="{kind}"/>' for path, kind in wire.COMMAND_ELEMENTS
    )
    send_elements = "\n".join(f'      <ELEMENT Tag="{wire.ROOT}/{path}"/>' for path, _ in wire.STATUS_ELEMENTS)
    return f"""\
<ETHERNETKRL>
  <CONFIGURATION>
    <EXTERNAL>
      {external}
    </EXTERNAL>
    <INTERNAL>
      <ENVIRONMENT>Submit</ENVIRONMENT>
      <BUFFERING Mode="FIFO" Limit="16"/>
      <ALIVE Set_Flag="{ALIVE_FLAG}" Ping="{PING_S}"/>{internal}
      <PROTOCOL>TCP</PROTOCOL>
    </INTERNAL>
  </CONFIGURATION>
  <RECEIVE>
    <XML>
{receive_elements}
      <ELEMENT Tag="{wire.ROOT}" Set_Flag="{RECEIVED_FLAG}"/>
    </XML>
  </RECEIVE>
  <SEND>
    <XML>
{send_elements}
    </XML>
  </SEND>
</ETHERNETKRL>
"""


def krl_get() -> str:
    """The lines that read one command."""
    return "\n".join(
        f'  RET=EKI_Get{_KRL_TYPE[kind]}("{EKI_NAME}","{wire.ROOT}/{path}",{KRL_COMMAND[path]})'
        for path, kind in wire.COMMAND_ELEMENTS
    )


def krl_set() -> str:
    """The lines that write one status."""
    return "\n".join(
        f'RET=EKI_Set{_KRL_TYPE[kind]}("{EKI_NAME}","{wire.ROOT}/{path}",{KRL_STATUS[path]})'
        for path, kind in wire.STATUS_ELEMENTS
    )


def correction_rows(settings: kuka_rsi.Settings) -> str:
    """Return the rows of the table of objects: the correction, its monitor, and the object that ends the program.
    The monitor stops RSI before the correction is clamped, because its limits are tighter by a degree or a
    millimetre."""
    clamp, monitor, inputs = {
        "axes": ("AXISCORR1", "AXISCORRMON1", "CorrA1 to CorrA6"),
        "pose": ("POSCORR1", "POSCORRMON1", "CorrX, CorrY, CorrZ, CorrA, CorrB, CorrC"),
    }[settings.corrects]
    if settings.corrects == "axes":
        most = settings.most_correction_deg
        clamp_limits = "; ".join(f"A{axis} +-{limit + 1:g}" for axis, limit in enumerate(most, start=1))
        clamp_limits = f"`LowerLimA1` to `UpperLimA6`, deg: {clamp_limits}"
        limits = "; ".join(f"`MaxA{axis}` = {limit:g}" for axis, limit in enumerate(most, start=1))
    else:
        clamp_limits = (
            f"`LowerLimX` to `UpperLimZ` = +-{settings.pose_correction_mm + 1:g} mm; "
            f"`MaxRotAngle` = {min(180.0, settings.pose_correction_deg + 1):g}; `RefCorrSys` = BASE"
        )
        limits = f"`MaxTrans` = {settings.pose_correction_mm:g}; `MaxRotAngle` = {settings.pose_correction_deg:g}"
    stop = f"\n| `STOP1` | input from output {STOP_OUTPUT} of `ETHERNET1` | `Mode` = ExitMoveCorr |"
    return (
        f"| `{clamp}` | inputs {inputs} from outputs 1 to 6 of `ETHERNET1` | {clamp_limits} |\n"
        f"| `{monitor}` | - (watches the sum of all corrections) | {limits} |{stop if settings.stop_tag else ''}"
    )


def fill_template(template: str, values: dict[str, str]) -> str:
    """Return the template with each @NAME@ replaced; raises KeyError for a name without a value."""
    return re.sub(r"@([A-Z_0-9]+)@", lambda match: values[match[1]], template)


def files(rsi: kuka_rsi.Settings, eki: kuka_eki.Settings, pc_address: str, load: int) -> Iterable[tuple[str, str]]:
    """Return path below the output folder, and text, of every file."""
    loss_condition = "CP_WAS_ALIVE"
    values = {name: str(getattr(wire, name)) for name in WIRE_NUMBERS} | {
        "ROOT": wire.ROOT,
        "EKI_NAME": EKI_NAME,
        "ALIVE_FLAG": str(ALIVE_FLAG),
        "RECEIVED_FLAG": str(RECEIVED_FLAG),
        "ORDER_FLAG": str(ORDER_FLAG),
        "STATUS_MS": str(eki.status_ms),
        "OPEN_AGAIN": loss_condition
        if eki.controller_is == "server"
        else f"{loss_condition} OR ($ROB_TIMER-CP_SENT_MS>2000)",
        "GET_COMMAND": krl_get(),
        "SET_STATUS": krl_set(),
        "LOAD": str(load),
        "RSI_CONTEXT": RSI_CONTEXT,
        "RSI_CONFIG": RSI_CONFIG,
        "IPO_MODE": {4: "#IPO_FAST", 12: "#IPO"}[rsi.cycle_ms],
        "RSI_MODE": {"absolute": "#ABSOLUTE", "relative": "#RELATIVE"}[rsi.mode],
        "DELAY_LIMIT": str(rsi.delay_limit),
        "STOP_NOTE": STOP_NOTE if rsi.stop_tag else "",
        "CORRECTION_ROWS": correction_rows(rsi),
        "NOTES": "".join(
            (TEMPLATES / f"context-{name}.md").read_text() for name in (rsi.mode, rsi.corrects)
        ).rstrip(),
    }
    yield f"eki/{EKI_NAME}.xml", eki_xml(eki)
    yield f"rsi/{RSI_CONFIG}", rsi_xml(rsi, pc_address)
    for folder, name in (
        ("eki", "coupole_eki.src"),
        ("eki", "coupole_eki.dat"),
        ("eki", "coupole_link.src"),
        ("eki", "coupole_link.dat"),
        ("rsi", "coupole_rsi.src"),
        ("rsi", "coupole_rsi.dat"),
        ("rsi", "context.md"),
    ):
        yield f"{folder}/{name}", fill_template((TEMPLATES / name).read_text(), values)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=ROOT / "configs" / "kuka")
    parser.add_argument("--pc-address", default="192.168.1.10", help="the PC's address in the RSI network")
    parser.add_argument("--rsi", default="{}", help="settings of drivers.kuka.rsi, JSON")
    parser.add_argument("--eki", default="{}", help="settings of drivers.kuka.eki, JSON")
    parser.add_argument("--load", type=int, default=1, help="number of the camera's LOAD_DATA")
    options = parser.parse_args(arguments)
    # The files do not contain the sender that the driver accepts.
    arm = {"arm_model": shipped_arm("kr10_r1100_sixx").arm, "any_controller_by": Path(__file__).name}
    rsi = kuka_rsi.Settings.model_validate(arm | json.loads(options.rsi) | {"controller": ""})
    eki = kuka_eki.Settings.model_validate(arm | json.loads(options.eki) | {"controller": ""})
    for path, text in files(rsi, eki, options.pc_address, options.load):
        target = options.output / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text)


if __name__ == "__main__":
    main()
