"""The box's SCPI interpreter: whatever comes, in whatever pieces, it answers and never falls over."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.devices.scpi_parser import QUEUE_LENGTH, Argument, Command, Interpreter, block, boolean, integer

SESSION = (
    b'*idn?\nECHO #15a\nb;c,3;:ECHO #10,4;*IDN?\r\n  :TEST:NUMBer 2.0e1 ; NUMB?;:SYST:ERR?\n"quoted;"\n'
    b"TEST:PAN4 ON;PAN4?;PAN 1;PANel?\nTEST:NUMB 5;*IDN?;NUMB?\n#9\n#0\n"
    b"ECHO #0x\nECHO #599999 x;*IDN?\nSYST:ERR?\n"
    b"\x00\xff\nSYST:ERR?;ERR?;ERR?;ERR?;ERR?;ERR?;ERR?;ERR?\n"
)


def make() -> Interpreter:
    state = {"number": 0, "panels": {}}

    def set_number(value: Argument) -> None:
        state["number"] = integer(value, 0, 100)

    def set_panel(panel: int, on: Argument) -> None:
        state["panels"][panel] = boolean(on)

    return Interpreter(
        {
            "*IDN?": Command(lambda: "me"),
            "ECHO": Command(lambda data, tail: block(data if isinstance(data, bytes) else b"text"), 2, 2),
            "TEST:NUMBer": Command(set_number, 1, 1),
            "TEST:NUMBer?": Command(lambda: str(state["number"])),
            "TEST:PANel#": Command(set_panel, 1, 1),
            "TEST:PANel#?": Command(lambda panel: str(state["panels"].get(panel))),
        },
        max_block_bytes=64,
    )


def errors(interpreter: Interpreter) -> list[int]:
    found = []
    while (code := int(interpreter.receive(b"SYST:ERR?\n").split(b",")[0])) != 0:
        found.append(code)
    return found


@pytest.mark.parametrize(
    ("message", "reply"),
    [
        (b"*idn?\n", b"me\n"),
        (b"TEST:NUMB 7;NUMB?\n", b"7\n"),
        (b"test:number 7;:Test:Numb?;*IDN?\n", b"7;me\n"),
        (b"TEST:NUMB 1.2E1;NUMB?\n", b"12\n"),
        (b"TEST:PAN3 ON;PAN3?;PAN2?\n", b"True;None\n"),
        (b"ECHO #15ab\ncd,x\n", b"#15ab\ncd\n"),
        (b"ECHO #203;;;,x;*IDN?\n", b"#13;;;;me\n"),
        (b"\n;;\n", b""),
        (b"SYST:ERR?\n", b'0,"No error"\n'),
    ],
)
def test_a_message_gets_its_reply(message: bytes, reply: bytes) -> None:
    assert make().receive(message) == reply


@pytest.mark.parametrize(
    ("message", "code"),
    [
        (b"NUMB 5\n", -113),
        (b"TEST:NUMBE 5\n", -113),
        (b"TEST:NUMB 5;TEST:NUMB?\n", -113),
        (b"TEST:NUMB\n", -109),
        (b"TEST:NUMB 5,\n", -109),
        (b"TEST:NUMB 5,6\n", -108),
        (b"TEST:NUMB five\n", -104),
        (b"TEST:NUMB 5.5\n", -104),
        (b"TEST:NUMB 101\n", -222),
        (b"TEST:PAN4 MAYBE\n", -224),
        (b"ECHO #0abc,x\n", -161),
        (b"ECHO #15abcde f,x\n", -161),
        (b"ECHO #3065" + bytes(65) + b",x\n", -363),
        (b"A" * 2000 + b"\n", -363),
        (b"\x07*IDN?\n", -101),
    ],
)
def test_a_wrong_message_leaves_one_error(message: bytes, code: int) -> None:
    interpreter = make()
    assert interpreter.receive(message) == b""
    assert errors(interpreter) == [code]


def test_a_wrong_unit_does_not_stop_the_units_after_it() -> None:
    assert make().receive(b"NONSENSE;*IDN?\n") == b"me\n"


def test_a_full_error_queue_ends_in_overflow() -> None:
    interpreter = make()
    interpreter.receive(b"NONSENSE\n" * (QUEUE_LENGTH + 5))
    assert errors(interpreter) == [-113] * (QUEUE_LENGTH - 1) + [-350]


def test_the_event_status_register_tells_the_kind_of_error_and_clears() -> None:
    interpreter = make()
    interpreter.receive(b"*CLS;NONSENSE;TEST:NUMB 101\n")
    assert interpreter.receive(b"*ESR?;*ESR?\n") == b"48;0\n"


def test_a_block_cut_off_can_be_dropped() -> None:
    interpreter = make()
    interpreter.receive(b"ECHO #19abc")
    assert interpreter.inside_block
    interpreter.drop_block()
    assert interpreter.receive(b"*IDN?\n") == b"me\n"
    assert errors(interpreter) == [-161]


@given(st.lists(st.integers(0, len(SESSION)), max_size=40))
def test_replies_do_not_depend_on_how_bytes_are_cut(cuts: list[int]) -> None:
    whole, pieces = make(), make()
    places = sorted({0, len(SESSION), *cuts})
    cut = b"".join(pieces.receive(SESSION[a:b]) for a, b in itertools.pairwise(places))
    assert cut == whole.receive(SESSION)


@given(st.binary(max_size=300), st.integers(1, 40))
def test_replies_to_garbage_do_not_depend_on_how_bytes_are_cut(garbage: bytes, size: int) -> None:
    whole, pieces = make(), make()
    stream = b"ECHO " + garbage + b"\n" * 80 + b"SYST:ERR?\n"
    cut = b"".join(pieces.receive(stream[i : i + size]) for i in range(0, len(stream), size))
    assert cut == whole.receive(stream)


@given(st.binary(max_size=2000) | st.text("#0123456789;:,*?\n \t@()ECHOTSNUMB", max_size=500).map(str.encode))
def test_after_garbage_the_box_still_answers(garbage: bytes) -> None:
    interpreter = make()
    interpreter.receive(garbage)
    interpreter.receive(b"\n")
    if interpreter.inside_block:
        interpreter.drop_block()
    assert interpreter.receive(b"\n*IDN?\n").endswith(b"me\n")
