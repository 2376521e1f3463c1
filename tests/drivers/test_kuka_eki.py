"""EthernetKRL's messages in any pieces, the watch without a connection, and the stand-in's motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arms import KR10_R1100_SIXX
from hypothesis import assume, given
from hypothesis import strategies as st

from coupole.errors import DeviceFault, DeviceLost, DeviceRefused
from coupole.kinematics import move_duration_s, slowed_arm
from drivers.arm_motion import farthest_stop_deg
from drivers.kuka.eki import wire
from drivers.kuka.eki.watch import Tolerances, Watch
from drivers.kuka.eki.wire import Status, StatusReader
from sim.devices.kuka_kinematics import AXIS_SPEEDS_DEG_S
from sim.devices.kuka_ptp import Motion, braking_motion, point_to_point

HOME_DEG = (0.0, -90.0, 90.0, 0.0, 90.0, 0.0)
TOLERANCES = Tolerances(settle_deg=0.003, settle_deg_s=0.1, follow_deg=1.0, follow_cycles=3)
STATUS = Status(
    session=7,
    taken=1,
    done=1,
    moving=False,
    fault=wire.NO_FAULT,
    time_ms=1000,
    override_percent=100,
    t1=False,
    lapsed=0,
    model="KR10R1100SIXX",
    serial=4711,
    joints_deg=HOME_DEG,
    pose=(540.0, 0.0, 915.0, 180.0, 0.0, 180.0),
)


def status_xml(status: Status) -> bytes:
    axes = " ".join(f'A{axis}="{angle!r}"' for axis, angle in enumerate(status.joints_deg, start=1))
    pose = " ".join(f'{n}="{v!r}"' for n, v in zip("XYZABC", status.pose or (0.0,) * 6, strict=True))
    return (
        f'<Coupole><Status Session="{status.session}" Taken="{status.taken}" Done="{status.done}" '
        f'Moving="{int(status.moving)}" Fault="{status.fault}" Time="{status.time_ms}" '
        f'Override="{status.override_percent}" T1="{int(status.t1)}" Lapsed="{status.lapsed}"></Status>'
        f'<Arm Model="{status.model}" Serial="{status.serial}"/><Axes {axes}/>'
        f'<Pose Valid="{int(status.pose is not None)}" {pose}/></Coupole>'
    ).encode()


six = st.tuples(*[st.floats(-1e3, 1e3)] * 6)
statuses = st.builds(
    replace,
    st.just(STATUS),
    session=st.integers(1, 2**31 - 1),
    taken=st.integers(0, 2**31 - 1),
    done=st.integers(0, 2**31 - 1),
    moving=st.booleans(),
    fault=st.integers(0, 9),
    lapsed=st.integers(0, 2**31 - 1),
    joints_deg=six,
    pose=st.none() | six,
)


def cut(data: bytes, cuts: list[int]) -> list[bytes]:
    places = sorted(c % (len(data) + 1) for c in cuts)
    return [data[a:b] for a, b in zip([0, *places], [*places, len(data)], strict=True)]


@given(sent=st.lists(statuses, max_size=5), cuts=st.lists(st.integers(0, 10**6), max_size=30))
def test_statuses_are_found_however_the_stream_is_cut(sent: list[Status], cuts: list[int]) -> None:
    reader = StatusReader()
    stream = b"\r\n".join(map(status_xml, sent))
    assert [status for piece in cut(stream, cuts) for status in reader.feed(piece)] == sent
    assert reader.malformed == 0


@given(
    rubbish=st.binary(max_size=200).filter(lambda b: b"</Coupole>" not in b),
    lost_bytes=st.integers(1, 300),
    cuts=st.lists(st.integers(0, 10**6), max_size=10),
)
def test_after_rubbish_or_a_torn_message_the_next_one_is_read(
    rubbish: bytes, lost_bytes: int, cuts: list[int]
) -> None:
    torn = status_xml(STATUS)[:-lost_bytes]
    reader = StatusReader()
    stream = rubbish + torn + status_xml(STATUS)
    assert [status for piece in cut(stream, cuts) for status in reader.feed(piece)] == [STATUS]


@pytest.mark.parametrize(
    ("good", "bad"),
    [
        (b' A3="90.0"', b""),
        (b'A3="90.0"', b'A3="nan"'),
        (b'A3="90.0"', b'A3="ninety"'),
        (b'Taken="1"', b'Taken=""'),
        (b"<Arm", b"<Arm<"),
    ],
)
def test_a_message_that_is_no_status_is_counted_and_left_out(good: bytes, bad: bytes) -> None:
    reader = StatusReader()
    message = status_xml(STATUS)
    assert good in message
    assert reader.feed(message.replace(good, bad) + message) == [STATUS]
    assert reader.malformed == 1


def test_an_endless_message_does_not_fill_the_memory() -> None:
    reader = StatusReader()
    for _ in range(100):
        assert reader.feed(b"<Coupole" * 500) == []
    assert len(reader._rest) < 20_000
    assert reader.feed(b"</Coupole>" + status_xml(STATUS)) == [STATUS]


def watch() -> Watch:
    fresh = Watch(7, TOLERANCES)
    fresh.note_order(1, None)
    return fresh


def test_what_another_session_was_told_is_not_this_ones_answer() -> None:
    judge = watch()
    judge.take(replace(STATUS, session=6))
    assert (judge.status, judge.foreign) == (None, 1)


def test_an_old_answer_does_not_settle_a_new_order() -> None:
    judge = watch()
    for n in range(5):
        judge.take(replace(STATUS, time_ms=20 * n))
    assert judge.settled_cycles > 0
    judge.note_order(2, HOME_DEG)
    judge.take(replace(STATUS, time_ms=120))
    assert judge.moving
    assert judge.settled_cycles == 0
    for n in range(5):
        judge.take(replace(STATUS, taken=2, done=2, time_ms=140 + 20 * n))
    assert judge.settled_cycles == 5


def test_what_was_said_before_a_question_was_taken_does_not_count() -> None:
    judge = watch()
    for n in range(5):
        judge.take(replace(STATUS, time_ms=20 * n))
    judge.note_command(2)
    judge.take(replace(STATUS, time_ms=100))
    assert judge.taken_ms is None
    judge.take(replace(STATUS, taken=2, time_ms=120))
    assert (judge.taken_ms, judge.settled_cycles) == (120, 1)


def test_a_slow_creep_does_not_count_as_settled() -> None:
    judge = watch()
    for n in range(20):
        judge.take(replace(STATUS, time_ms=20 * n, joints_deg=(0.01 * n, *HOME_DEG[1:])))
    assert judge.settled_cycles <= 1
    assert judge.moving


def test_an_arm_that_ends_elsewhere_does_not_follow() -> None:
    judge = watch()
    judge.note_order(2, (5.0, *HOME_DEG[1:]))
    for n in range(4):
        judge.take(replace(STATUS, taken=2, done=2, time_ms=20 * n))
    assert judge.fault is not None
    assert judge.fault.kind is DeviceFault
    assert "5.00 deg" in judge.fault.text


@pytest.mark.parametrize(
    ("number", "kind", "says"),
    [
        (wire.EMERGENCY_STOP, DeviceFault, "emergency stop"),
        (wire.DRIVES_OFF, DeviceFault, "drives are off"),
        (wire.STOP_MESSAGE, DeviceFault, "stop message"),
        (wire.PROGRAM_ENDED, DeviceFault, "not running"),
        (wire.TARGET_REFUSED, DeviceRefused, "software limits"),
        (99, DeviceFault, "fault 99"),
    ],
)
def test_each_fault_has_its_name_and_stays(number: int, kind: type, says: str) -> None:
    judge = watch()
    judge.take(replace(STATUS, fault=number))
    judge.take(replace(STATUS, time_ms=2000))
    judge.fail(DeviceLost, "later")
    assert judge.fault is not None
    assert judge.fault.kind is kind
    assert says in judge.fault.text


angles = st.tuples(*[st.floats(-120.0, 45.0)] * 6)


@given(start_deg=angles, target_deg=angles, share=st.floats(0.05, 1.0), acceleration=st.floats(50.0, 600.0))
def test_the_stand_ins_motion_lasts_as_long_as_preflight_says(
    start_deg: tuple[float, ...], target_deg: tuple[float, ...], share: float, acceleration: float
) -> None:
    assume(np.max(np.abs(np.subtract(target_deg, start_deg))) > 0.01)
    speeds = [share * v for v in AXIS_SPEEDS_DEG_S]
    motion = point_to_point(start_deg, target_deg, speeds, acceleration, 3000.0)
    arm = slowed_arm(KR10_R1100_SIXX, speed_fraction=share, acceleration_deg_s2=acceleration, jerk_deg_s3=3000.0)
    assert motion.duration_s == pytest.approx(move_duration_s(arm, start_deg, target_deg), rel=1e-6)
    assert np.allclose(motion.joints_deg(motion.duration_s), target_deg, atol=1e-6)


@given(
    way_deg=st.floats(0.1, 300.0), when=st.floats(0.0, 1.0), again=st.floats(0.0, 1.0), harder=st.floats(1.0, 4.0)
)
def test_braking_at_any_moment_ends_at_rest_on_the_way_within_the_limits(
    way_deg: float, when: float, again: float, harder: float
) -> None:
    motion = point_to_point((0.0, 0.0), (way_deg, way_deg / 3), (150.0, 150.0), 300.0, 3000.0)
    once = braking_motion(motion, when * motion.duration_s, harder * 300.0, harder * 3000.0)
    twice = braking_motion(once, again * once.duration_s, 300.0, 3000.0)
    for brake in (once, twice):
        s, v, a = brake.state(brake.duration_s)
        assert -1e-9 <= s <= 1.0 + 1e-6 or brake is motion
        assert v * way_deg == pytest.approx(0.0, abs=1e-5)
        assert a * way_deg == pytest.approx(0.0, abs=1e-4)
    assert slowest_change(once, way_deg) >= -harder * 300.0 * 1.0001


@given(
    start_deg=angles,
    target_deg=angles,
    share=st.floats(0.05, 1.0),
    acceleration=st.floats(50.0, 600.0),
    called=st.floats(0.0, 1.0),
    delay_s=st.floats(0.0, 0.1),
)
def test_no_axis_turns_farther_after_a_stop_than_the_driver_says(
    start_deg: tuple[float, ...],
    target_deg: tuple[float, ...],
    share: float,
    acceleration: float,
    called: float,
    delay_s: float,
) -> None:
    speeds = [share * v for v in AXIS_SPEEDS_DEG_S]
    motion = point_to_point(start_deg, target_deg, speeds, acceleration, 3000.0)
    called_s = called * motion.duration_s
    rest = braking_motion(motion, called_s + delay_s, acceleration, 3000.0)
    turned_deg = np.subtract(rest.joints_deg(rest.duration_s), motion.joints_deg(called_s))
    assert np.all(np.abs(turned_deg) <= farthest_stop_deg(speeds, acceleration, 3000.0, delay_s) + 1e-6)


def slowest_change(motion: Motion, way_deg: float) -> float:
    """The lowest acceleration on the way, deg/s2."""
    times = np.linspace(0.0, motion.duration_s, 50)
    return min(motion.state(float(t))[2] * way_deg for t in times)
