"""The commanded axes: a jerk-limited motion from rest to rest, computed one cycle at a time."""

from __future__ import annotations

from typing import Any

import ruckig

from drivers.kuka.rsi import shared_state
from drivers.kuka.rsi.shared_state import Six

_LEAST_MOTION_DEG = 1e-6
"""Shorter motions, which are below the resolution of the wire, are not made. The speed limits along such
a short line would be infinite.
"""


class Motion:
    """The commanded axes: at rest, moving to a target or braking, always within the limits.

    Motions are straight in joint space: one jerk-limited profile along the line, as fast as the slowest axis
    allows. (Six axes synchronised by ruckig leave the line by up to 5 degrees in one move of six.) Braking also
    stays on the line. If a target is given during a motion, the arm first comes to rest.
    """

    def __init__(self, cycle_s: float, limits: tuple[Six, Six, Six]) -> None:
        """`limits` are the axes' speeds (deg/s), accelerations (deg/s2) and jerks (deg/s3)."""
        self.phase = shared_state.STANDING
        self.commanded_deg: Six = (0.0,) * 6
        self.velocity_deg_s: Six = (0.0,) * 6
        self._limits = limits
        self._run: Any = ruckig.Ruckig(1, cycle_s)
        self._input: Any = ruckig.InputParameter(1)
        self._output: Any = ruckig.OutputParameter(1)
        self._start_deg: Six = (0.0,) * 6
        self._line_deg: Six = (0.0,) * 6
        """Line from start to target. The profile's position on it goes from 0 to 1."""
        self._next_target_deg: Six | None = None
        self._next_speed = 1.0

    @property
    def pursues(self) -> bool:
        """True while there is a target that is not reached yet."""
        return self.phase == shared_state.MOVING or self._next_target_deg is not None

    def stand_at(self, joints_deg: Six) -> None:
        """Set the commanded axes to `joints_deg`, at rest."""
        self.phase, self.commanded_deg, self.velocity_deg_s = shared_state.STANDING, joints_deg, (0.0,) * 6
        self._next_target_deg = None

    def note_halt(self) -> None:
        """Note that the arm has halted although its axes were commanded to move. The motion continues from
        rest."""
        self.velocity_deg_s = (0.0,) * 6
        self._input.current_velocity = self._input.current_acceleration = [0.0]

    def move_to(self, target_deg: Six, speed: float = 1.0) -> None:
        """Move to a target. `speed` is the share of the axes' highest speeds."""
        if self.phase != shared_state.STANDING:
            self.stop()
            self._next_target_deg, self._next_speed = target_deg, speed
            return
        line_deg = tuple(map(float.__sub__, target_deg, self.commanded_deg))
        if max(map(abs, line_deg)) < _LEAST_MOTION_DEG:
            self.commanded_deg = target_deg
            return
        self._start_deg, self._line_deg = self.commanded_deg, line_deg
        highest = [
            min(limit / abs(turn) for limit, turn in zip(limits, line_deg, strict=True) if turn)
            for limits in self._limits
        ]
        highest[0] *= speed
        self._input.max_velocity, self._input.max_acceleration, self._input.max_jerk = ([h] for h in highest)
        self._input.current_position = self._input.current_velocity = self._input.current_acceleration = [0.0]
        self._input.target_position = [1.0]
        self._go(ruckig.ControlInterface.Position, shared_state.MOVING)

    def stop(self) -> None:
        self._next_target_deg = None
        if self.phase == shared_state.MOVING:
            self._go(ruckig.ControlInterface.Velocity, shared_state.STOPPING)

    def _go(self, control: Any, phase: int) -> None:
        self._input.control_interface = control
        self._input.target_velocity = self._input.target_acceleration = [0.0]
        self.phase = phase

    def step(self) -> bool:
        """Advance one cycle. False if the trajectory could not be computed; the axes are then at rest."""
        if self.phase == shared_state.STANDING:
            return True
        try:
            result = self._run.update(self._input, self._output)
        except ruckig.RuckigError:
            result = None
        if result not in (ruckig.Result.Working, ruckig.Result.Finished):
            self.stand_at(self.commanded_deg)
            return False
        self._output.pass_to_input(self._input)
        share, rate = self._output.new_position[0], self._output.new_velocity[0]
        self.commanded_deg = tuple(
            start + share * turn for start, turn in zip(self._start_deg, self._line_deg, strict=True)
        )
        self.velocity_deg_s = tuple(rate * turn for turn in self._line_deg)
        if result == ruckig.Result.Finished:
            following = self._next_target_deg
            self.stand_at(self.commanded_deg)
            if following is not None:
                self.move_to(following, self._next_speed)
        return True
