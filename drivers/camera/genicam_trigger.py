"""Sets exposure and trigger of a GenICam camera, and reads its counters and frame id range."""

from __future__ import annotations

from coupole.devices import Exposure
from drivers.camera.genicam_features import Features
from drivers.camera.genicam_settings import Counter, GenICamSettings
from drivers.camera.genicam_state import FRAME_TRIGGER, TRIGGER_LINE, State

_LAST_WIDE_ID = 2**62
"""End of 64-bit ids, which is never reached."""


def set_exposure(features: Features, settings: GenICamSettings, exposure: Exposure) -> None:
    """Set exposure and trigger: each frame starts at an edge of the box or at a software trigger, and has the
    given exposure time."""
    set_trigger(State(features, settings), features, settings, by_edges=exposure.hardware_trigger)
    features.write(features.first_of("ExposureTimeAbs") or "ExposureTime", float(exposure.exposure_us))
    if exposure.gain_db or features.has("Gain"):
        features.write("Gain", float(exposure.gain_db))


def set_trigger(state: State, features: Features, settings: GenICamSettings, *, by_edges: bool) -> None:
    """Let each edge of the trigger line, or each software trigger, start one frame at once."""
    state.select("TriggerSelector", "FrameStart")
    state.set("TriggerMode", "On", "FrameStart")
    state.set("TriggerSource", settings.trigger_line if by_edges else settings.software_trigger, "FrameStart")
    if by_edges and features.has("TriggerActivation"):
        state.set("TriggerActivation", settings.trigger_activation)
    state.apply(FRAME_TRIGGER)
    if features.has("LineSelector") and settings.trigger_line in features.entries("LineSelector"):
        features.write("LineSelector", settings.trigger_line)
        state.apply(TRIGGER_LINE)


def frame_id_range(features: Features, *, gige: bool) -> tuple[int, int]:
    """Return the first and last frame id of the transport. They have 16 bits on GigE Vision, unless the camera
    reports the extended ids of version 2; otherwise 64 bits."""
    if not gige:
        return (0, _LAST_WIDE_ID)
    extended_id_feature = "GevGVSPExtendedIDMode"
    wide = features.has(extended_id_feature) and features.read_value(extended_id_feature) in {"On", True}
    return (1, _LAST_WIDE_ID if wide else 65535)


def counts(features: Features, settings: GenICamSettings) -> tuple[int, int]:
    """Return the numbers of exposures and of edges that came too early, from the camera's counters; -1 without a
    counter."""
    return (_count(features, settings.exposed_counter), _count(features, settings.over_trigger_counter))


def _count(features: Features, counter: Counter | None) -> int:
    if counter is None:
        return -1
    features.write_all(counter.select)
    return int(features.number(counter.read))


def since(count: int, before: int) -> int:
    """Return the increase of a 32-bit counter since it was `before`; -1 without a counter."""
    return count if count < 0 else (count - before) % 2**32
