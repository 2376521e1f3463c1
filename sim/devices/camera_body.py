"""Parts common to all simulated cameras: trigger input, sensor timing, clock, counters.

An edge that comes while the sensor is ready begins an exposure. An edge that comes too early is counted and
ignored. Each exposure has a number, a frame id and a time on the camera's own clock. It is rendered on a worker
thread. It is passed to the camera's *wire* in order, but only after its readout has ended.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from typing import Annotated, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from coupole.geometry import Transform
from sim.devices.arm_bodies import NONE, Capsules
from sim.optics.disturbances import CALM, Disturbance
from sim.optics.sensor_model import SensorModel
from sim.world.lighting import Lighting
from sim.world.reactor import Reactor


@dataclass(frozen=True)
class Exposed:
    """Light, pose and timing of one exposure, for the renderer."""

    seconds_of_led: dict[int, float]
    """Seconds of light at the tabulated flux, by LED number. An LED with 10 % more flux counts 10 % longer."""
    panels: list[int]
    exposure_s: float
    gain: float
    number: int
    """Counts exposures from power-on."""
    base_from_flange: Transform
    arm_mm: Capsules = field(default_factory=lambda: NONE)
    """Parts of arm and tool that block light, in the base frame."""
    disturbance: Disturbance = CALM


_RENDER_PATIENCE_S = 30.0

Render = Callable[[NDArray[np.uint16], Exposed], None]
"""Fills a frame [h, w] with the image of an exposure."""


class Settings(BaseModel):
    """Properties of the simulated camera, apart from its wire."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    render_every: Annotated[int, Field(ge=0)] = 1
    """Every n-th frame is rendered; the others stay unchanged. 0: no frame is rendered (dry runs)."""
    render_once: bool = False
    """True: each slot is rendered only when it is first used, and keeps that picture. This is for tests of
    speed."""
    samples_per_side: Annotated[int, Field(ge=1, le=8)] = 1
    """Rays through each pixel, k x k. Use several for targets whose corners are located to a fraction of a
    pixel."""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3 of the true lens (Brown-Conrady, OpenCV's order). A calibration has to find them."""
    blur: bool | None = None
    """True if defocus and diffraction blur pictures. None: only if each pixel is shaded."""
    rim_radius: Annotated[float, Field(gt=0)] = 3.0
    rim_shift: Annotated[float, Field(ge=0)] = 4.0
    """Mechanical vignetting, as in `sim.optics.objective.Objective`."""
    lateral_colour: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Relative change of magnification in red, green and blue. It is used only with `blur`."""
    sensor: SensorModel = SensorModel()
    """The sensor's properties; Bayer pattern, bit depth and black level come from the rig."""
    sensor_temperature_c: float = 25.0
    clock_offset_ns: int = 7_777_000_000
    clock_ppm: float = -23.0
    timestamp_jitter_us: float = 2.0
    first_frame_id: Annotated[int, Field(ge=1, le=65535)] = 1
    id_modulus: Annotated[int, Field(ge=0)] = 65535
    """Last frame id, followed by 1 (GigE Vision 1)."""
    seed: int = 11


@dataclass
class Shot:
    """A frame between sensor and wire."""

    slot: int
    """Index of its frame memory in the wire."""
    frame_id: int
    timestamp_ns: int
    deliver_ns: int
    """World time at which its readout ends."""
    is_rendered: bool
    ready: bool = False


class Wire(Protocol):
    """Transport of frames to the host. All calls run on the reactor's thread, and may pause the world."""

    def claim(self) -> int | None:
        """A free slot of frame memory, or None if the host has released none."""
        ...

    def pixels(self, slot: int) -> NDArray[np.uint16]:
        """Return the slot's frame memory [h, w]."""
        ...

    def send(self, shot: Shot) -> bool:
        """Send a frame. Return False if this is not possible yet; `CameraBody.deliver` must then be called
        later."""
        ...


@dataclass(frozen=True)
class Surroundings:
    """The surroundings of a camera, which the world provides: sensor timing, light, pose, scene."""

    readout_us: float
    exposure_gap_us: float
    lighting: Lighting
    pose: Callable[[], Transform]
    """Present `base_from_flange` of the arm that carries the camera."""
    render: Render
    arm: Callable[[], Capsules] = lambda: NONE
    """Parts of the arm that block light at present."""
    disturbance: Callable[[int], Disturbance] = lambda _: CALM
    """Disturbance of an exposure that begins at a world time, ns."""
    on_exposed: Callable[[int, int, int, int, int], None] = lambda *_: None
    """Called for each exposure that has ended: number, frame id, timestamp ns, world times ns of start and end."""


@dataclass(frozen=True)
class Triggering:
    """Settings by which the camera takes triggers. By default each edge starts an exposure."""

    delay_ns: int = 0
    divider: int = 1
    """Number n: only each n-th edge triggers."""
    latches: bool = False
    """True: the camera remembers an early edge, and exposes as soon as the sensor is ready."""
    least_period_ns: int = 0
    """Least time from one exposure's start to the next. 0: the time that the sensor needs."""
    most_frames: int = 0
    """Number of exposures after which the acquisition ends; 0: never."""
    edges_to_start: int = 0
    """Number of first edges of a session that start the acquisition and cause no exposure."""


class CameraBody:
    """One camera without its wire; `edge(t_ns)` is the trigger input."""

    def __init__(
        self,
        reactor: Reactor,
        settings: Settings,
        wire: Wire,
        surroundings: Surroundings,
    ) -> None:
        self._reactor, self._settings, self._wire = reactor, settings, wire
        self._lighting, self._pose = surroundings.lighting, surroundings.pose
        self._render, self._arm = surroundings.render, surroundings.arm
        self._on_exposed, self._disturbance = surroundings.on_exposed, surroundings.disturbance
        self.readout_ns = round(surroundings.readout_us * 1e3)
        self.gap_ns = round(surroundings.exposure_gap_us * 1e3)
        self._random = random.Random(settings.seed)
        self._workers = ThreadPoolExecutor(1, "render")
        self._pending: deque[Shot] = deque()
        self.armed = False
        self.hardware = False
        """True: edges start exposures; False: only `expose` does."""
        self.exposure_ns = 8_000_000
        self.gain = 1.0
        self.triggering = Triggering()
        self._session = 0
        self._ready_ns = self._readout_until_ns = 0
        self._edges_of_session = self._frames_of_session = 0
        self._latched = False
        self._frame_id = settings.first_frame_id
        self._number = self._edge_number = 0
        self.counters = dict.fromkeys(("exposed", "delivered", "lost_transfers", "over_triggers", "overflows"), 0)
        """Counted from power-on."""
        self.lose_frames: set[int] = set()
        """Numbers of frames (counted from power-on) whose transfer is lost."""
        self.ignore_edges: set[int] = set()
        """Numbers of edges (counted from power-on) that the camera does not detect."""
        self.pictured: set[int] = set()
        """Slots that hold a picture; the wire clears the set when it replaces its memory."""

    # -- triggers -----------------------------------------------------------------------------------------

    def edge(self, t_ns: int) -> None:
        """A rising edge on the trigger line at world time `t_ns`."""
        number, self._edge_number = self._edge_number, self._edge_number + 1
        if not self.armed or not self.hardware or number in self.ignore_edges:
            return
        triggering = self.triggering
        self._edges_of_session += 1
        edge_count = self._edges_of_session - triggering.edges_to_start
        if edge_count < 1 or edge_count % triggering.divider:
            return
        if triggering.delay_ns:
            self._expose_at(t_ns + triggering.delay_ns)
        else:
            self.expose(t_ns)

    def _expose_at(self, t_ns: int) -> None:
        """Begin an exposure later, if the session still lasts then."""
        session = self._session

        def begin() -> None:
            self._latched = False
            if session == self._session:
                self.expose(t_ns)

        self._reactor.at(t_ns, begin)

    def ready(self) -> bool:
        """The exposure-ready line: an edge now would start an exposure."""
        return self.armed and self._reactor.now_ns >= self._next_start_ns()

    def _next_start_ns(self) -> int:
        """Return the earliest start of the next exposure. It must not end before the last frame is read out."""
        return max(self._ready_ns, self._readout_until_ns - self.exposure_ns)

    def expose(self, t_ns: int) -> None:
        """Begin an exposure, unless the sensor is not ready yet or the acquisition is over."""
        triggering = self.triggering
        if triggering.most_frames and self._frames_of_session >= triggering.most_frames:
            return
        if t_ns < self._next_start_ns():
            if triggering.latches and not self._latched:
                self._latched = True
                self._expose_at(self._next_start_ns())
            else:
                self.counters["over_triggers"] += 1
            return
        self._frames_of_session += 1
        end_ns = t_ns + self.exposure_ns
        self._ready_ns = max(end_ns + self.gap_ns, t_ns + triggering.least_period_ns)
        self._readout_until_ns = end_ns + self.readout_ns
        self.counters["exposed"] += 1
        frame_id = self._frame_id
        self._frame_id = self._frame_id + 1 if self._frame_id != self._settings.id_modulus else 1
        number, self._number = self._number, self._number + 1
        jitter_ns = self._random.gauss(0.0, self._settings.timestamp_jitter_us * 1e3)
        stamp_ns = self._settings.clock_offset_ns + t_ns * (1 + self._settings.clock_ppm * 1e-6) + jitter_ns
        session = self._session
        self._reactor.at(
            end_ns, lambda: self._end_exposure(session, t_ns, end_ns, frame_id, number, int(stamp_ns))
        )

    # -- frames -------------------------------------------------------------------------------------------

    def _end_exposure(
        self, session: int, start_ns: int, end_ns: int, frame_id: int, number: int, stamp_ns: int
    ) -> None:
        if session != self._session or not self.armed:
            return
        self._on_exposed(number, frame_id, stamp_ns, start_ns, end_ns)
        if number in self.lose_frames:
            self.counters["lost_transfers"] += 1
            return
        slot = self._wire.claim()
        if slot is None:
            self.counters["overflows"] += 1
            return
        every = self._settings.render_every
        is_rendered = every > 0 and number % every == 0
        shot = Shot(slot, frame_id, stamp_ns, end_ns + self.readout_ns, is_rendered)
        self._pending.append(shot)
        if not shot.is_rendered or (self._settings.render_once and slot in self.pictured):
            shot.ready = True
            self._reactor.at(shot.deliver_ns, self.deliver)
            return
        self.pictured.add(slot)
        exposure = Exposed(
            self._lighting.exposure_s(start_ns, end_ns),
            self._lighting.panels(start_ns),
            (end_ns - start_ns) / 1e9,
            self.gain,
            number,
            self._pose(),
            self._arm(),
            self._disturbance(start_ns),
        )
        working = self._workers.submit(self._work, shot, exposure)
        self._reactor.at(shot.deliver_ns, lambda: self._wait_for(working, session))

    def _wait_for(self, working: Future[None], session: int) -> None:
        """Pause world time until a picture that is due is rendered. So this machine's speed has no effect on the
        simulated camera."""
        if session == self._session:
            wait([working], _RENDER_PATIENCE_S)
            self.deliver()

    def _work(self, shot: Shot, exposure: Exposed) -> None:
        self._render(self._wire.pixels(shot.slot), exposure)
        shot.ready = True
        self._reactor.call_threadsafe(self.deliver)

    def deliver(self) -> None:
        """Pass finished frames to the wire in order, each only after its readout has ended."""
        while self._pending and self._pending[0].ready:
            shot = self._pending[0]
            if shot.deliver_ns > self._reactor.now_ns:
                self._reactor.at(shot.deliver_ns, self.deliver)
                return
            if not self._wire.send(shot):
                return
            if self._pending and self._pending[0] is shot:  # sending may have ended the session
                self._pending.popleft()
                self.counters["delivered"] += 1

    # -- sessions -----------------------------------------------------------------------------------------

    def arm(self) -> None:
        """Begin a session: from now on edges or `expose` start exposures."""
        self.disarm()
        self._ready_ns = self._readout_until_ns = 0
        self._edges_of_session = self._frames_of_session = 0
        self.armed = True

    def disarm(self) -> None:
        """End the session. Pending frames are discarded, and rendering has ended on return."""
        self.armed = False
        self._session += 1
        self._workers.submit(lambda: None).result()
        self._pending.clear()

    def close(self) -> None:
        self._workers.shutdown(cancel_futures=True)
