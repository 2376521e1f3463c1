"""The simulated cell: one process, one reactor, and the stand-ins that share its state.

`python -m sim.world.world` reads its configuration as one JSON line from standard input, and prints its endpoints
as one JSON line. It serves until standard input closes (because its parent has ended), a signal comes, or a client
tells it to stop.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any, assert_never

import numpy as np
from pydantic import BaseModel, ValidationError

from sim.devices import camera_stand_in, gige_camera, kuka_controller, ledbox_stand_in, robot
from sim.devices.arm_bodies import NONE, Capsules, arm_capsules, tool_capsules, ur_capsules
from sim.devices.camera_body import Exposed, Surroundings
from sim.devices.ledbox_firmware import LedBoxFirmware
from sim.devices.refusals import untold
from sim.devices.text_box import TextBox
from sim.optics.disturbances import OF_EACH_KIND, Disturber, Disturbing
from sim.optics.led_light import Flashes
from sim.optics.photographer import Photographer
from sim.world import faults as script
from sim.world.clock import ClockWriter
from sim.world.config import CameraConfig, Config
from sim.world.exposure_log import ExposureLog
from sim.world.lighting import Lighting
from sim.world.reactor import Reactor
from sim.world.ruler import Ruler
from sim.world.scratch import world_folder

_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class World:
    """The stand-ins and the connections between them: the trigger cable, the light, and the arm that carries the
    camera.
    """

    def __init__(self, config: Config, folder: Path) -> None:
        settings = config.settings
        self.clock = ClockWriter(
            folder / "clock", settings.speed, hurry_only_when_told=settings.hurry_only_when_told
        )
        self.reactor = Reactor(self.clock)
        self.lighting = Lighting()
        self._exposures = ExposureLog(self.lighting, settings.exposures_remembered)
        self._photographer = Photographer(config.scene, config.rendered_camera, settings)
        self._flashes, self._disturber = Flashes(settings.leds), Disturber()
        self._robot_settings, self._camera_settings = settings.robot, settings.camera
        self._ledbox_settings = settings.ledbox
        self._tool, self._arm_shadows = config.scene.tool, settings.arm_shadows
        self._ruler = Ruler(config.scene, settings.things, self._photographer.leds.positions_mm)
        self._cables = tool_capsules(np.array(config.scene.base_from_support), settings.cables)
        tell = _tell if config.tells_refusals else untold
        self.robot, robot_endpoint = robot.build(self.reactor, settings.robot, tell, settings.strangers.arm)
        self.camera, camera_endpoint = self._build_camera(config.camera, folder)
        self.box = ledbox_stand_in.build(
            self.reactor,
            settings.ledbox,
            camera=self.camera,
            lighting=self.lighting,
            on_light=self._light,
            on_edge_counted=self._edge_counted,
        )
        self._control = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._control.bind(str(folder / "control"))
        self._control.listen(4)
        self._control.setblocking(False)
        self.reactor.add_reader(self._control, self._accept)
        self._faults_at_edge: dict[int, list[script.Fault]] = {}
        self._settings_faults = settings.faults
        for fault in settings.faults:
            self._schedule(fault)
        self._warm_up(config.camera)
        self.endpoints = {
            "ledbox": {"port": self.box.port},
            "robot": {"kind": settings.robot.kind, **robot_endpoint},
            "camera": {
                "kind": settings.camera.kind,
                **camera_endpoint,
                "scaling": f"white at the support's centre reaches {config.camera.white_share:.0%} of full scale "
                f"in {config.camera.nominal_exposure_us} us under the median LED",
            },
            "clock": {"path": str(folder / "clock"), "speed": settings.speed},
            "control": {"address": str(folder / "control")},
            "pid": os.getpid(),
        }

    def _build_camera(
        self, camera: CameraConfig, folder: Path
    ) -> tuple[camera_stand_in.CameraStandIn, dict[str, Any]]:
        names = ("height_px", "width_px", "bit_depth", "bayer_pattern", "black_dn")
        frame_format = {name: getattr(camera, name) for name in names}
        return camera_stand_in.build(
            self.reactor,
            self._camera_settings,
            folder,
            frame_format={**frame_format, "white_dn": self._photographer.sensor.white_dn},
            surroundings=Surroundings(
                readout_us=1e6 / camera.max_frames_per_s,
                exposure_gap_us=camera.exposure_gap_us,
                lighting=self.lighting,
                pose=self.robot.true_base_from_flange,
                render=self._photographer.render,
                arm=self._in_the_light,
                disturbance=self._disturber.at,
                on_exposed=self._exposures.note,
            ),
        )

    def _warm_up(self, camera: CameraConfig) -> None:
        """Compile the renderer and fill its caches, before the first frame is due."""
        led = int(self._photographer.leds.ids[0])
        lit = Exposed({led: 1e-3}, [1], 1e-3, 1.0, 0, self.robot.true_base_from_flange())
        pixels = np.zeros((camera.height_px, camera.width_px), np.uint16)
        self._photographer.render(pixels, lit)
        if any(isinstance(fault, Disturbing) for fault in self._settings_faults):
            self._photographer.render(pixels, replace(lit, disturbance=OF_EACH_KIND))

    # -- the cables ---------------------------------------------------------------------------------------

    def _in_the_light(self) -> Capsules:
        """Return the parts of arm and tool that block light, and cables that hang in the cell."""
        return np.concatenate([self._arm(), self._cables])

    def _arm(self) -> Capsules:
        if not self._arm_shadows:
            return NONE
        tool = tool_capsules(self.robot.true_base_from_flange(), self._tool)
        settings, joints_deg = self._robot_settings, self.robot.joints_deg
        match settings.kind:
            case "ur":
                return np.concatenate([ur_capsules(settings.model, joints_deg), tool])
            case "rsi" | "eki":
                return np.concatenate([arm_capsules(joints_deg), tool])
            case kind:
                assert_never(kind)

    def _light(self, led: int, t_on_ns: int, t_off_ns: int) -> None:
        """Note that the box switches an LED on; it is lit with its present flux."""
        flux = self._flashes.flux(led, self.box.temperature_of_led_c(led)) * self._disturber.flux(led, t_on_ns)
        self.lighting.light(led, t_on_ns, t_off_ns, flux)

    def _edge_counted(self, number: int) -> None:
        """Let faults happen that are scheduled for edge `number`, which the box has sent or dropped."""
        for fault in self._faults_at_edge.pop(number, ()):
            self._happen(fault)

    # -- faults -------------------------------------------------------------------------------------------

    def _schedule(self, fault: script.Fault) -> None:
        if isinstance(fault, script.When) and fault.at_edge is not None:
            self._faults_at_edge.setdefault(fault.at_edge, []).append(fault)
        elif isinstance(fault, script.When) and fault.at_s is not None:
            self.reactor.at(round(fault.at_s * 1e9), lambda: self._happen(fault))
        else:
            self._happen(fault)

    def _happen(self, fault: script.Fault) -> None:  # noqa: PLR0912
        match fault:
            case script.DropTrigger():
                self._scpi_box.drop_edge(fault.edge)
            case script.DoubleTrigger():
                self._scpi_box.double_edge(fault.edge, fault.delay_us)
            case script.LostTransfer():
                self.camera.lose_frames.add(fault.frame)
            case script.MuteBox():
                self.box.mute(fault.seconds)
            case script.CutWire():
                self.box.unplug()
            case script.UnplugCamera():
                self.camera.unplug()
            case script.CameraControlLoss():
                assert isinstance(self.camera, gige_camera.GigeCamera)  # `impossible` refuses the fault for others
                self.camera.lose_control()
            case script.OverTemperature():
                self._scpi_box.over_temperature(fault.board)
            case script.DeadLed():
                self.box.dead_leds.add(fault.led)
                if fault.seconds is not None:
                    self.reactor.after(fault.seconds, lambda: self.box.dead_leds.discard(fault.led))
            case script.StuckLed():
                assert isinstance(self.box, TextBox)  # `impossible` refuses the fault for others
                self.box.stick_led(fault.led)
            case script.FlickeringLed():
                self._flashes.unsteady[fault.led] = fault.rms
            case (
                script.DimLed()
                | script.Warming()
                | script.RoomLamp()
                | script.Bump()
                | script.Smudge()
                | script.ExposureStep()
                | script.Hand()
            ):
                self._disturber.happen(fault, self.reactor.now_ns)
            case script.EmergencyStop():
                self.robot.estop()
            case script.EnablingSwitch():
                self._scpi_box.enabling_switch = "held" if fault.held else "released"
            case script.LateRsi():
                assert isinstance(self.robot, kuka_controller.KukaController)  # `impossible` refuses others
                self.robot.late(fault.cycles)
            case script.RsiLinkLoss():
                self.robot.lose_link(fault.seconds)
            case script.NudgeArm():
                self.robot.nudge([fault.deg] * 6, fault.seconds)
            case _:
                assert_never(fault)

    @property
    def _scpi_box(self) -> LedBoxFirmware:
        """The SCPI box, for faults that only it can have; `impossible` refuses them for others."""
        assert isinstance(self.box, LedBoxFirmware)
        return self.box

    # -- control ------------------------------------------------------------------------------------------

    def _accept(self) -> None:
        try:
            client, _ = self._control.accept()
        except OSError:  # it has left already
            return
        client.setblocking(False)
        self.reactor.add_reader(client, lambda: self._on_command(client))

    def _on_command(self, client: socket.socket) -> None:
        try:
            data = client.recv(4096)
            if data:
                client.send(json.dumps(self._answer(data)).encode())
                return
        except OSError:  # killed before it read the answer, or it reads none
            pass
        self.reactor.remove_reader(client)
        client.close()

    def _answer(self, data: bytes) -> dict[str, Any]:
        """Obey a client's command. Data that are not a command are answered with an error."""
        try:
            command = json.loads(data)
        except (ValueError, RecursionError):
            return {"error": "a command is a JSON object"}
        if not isinstance(command, dict):
            return {"error": "a command is a JSON object"}
        return self._do(command)

    def _do(self, command: dict[str, Any]) -> dict[str, Any]:
        match command.get("do"):
            case "state":
                now_ns = self.reactor.now_ns
                return {
                    "t_s": now_ns / 1e9,
                    "shining": self.lighting.shining(now_ns),
                    "panels": self.lighting.panels(now_ns),
                    "arm_moving": self.robot.moving,
                    "joints_deg": list(self.robot.joints_deg),
                    "camera_armed": self.camera.is_armed,
                }
            case "ruler":
                return self._ruler.lengths_mm(self.robot.true_base_from_flange())
            case "light":
                leds_s, panels_s = self.lighting.given_s(self.reactor.now_ns)
                return {"leds_s": leds_s, "panels_s": panels_s}
            case "fault":
                try:
                    fault = OneFault.model_validate({"fault": command.get("fault")}).fault
                except ValidationError as error:
                    return {"error": str(error)}
                if why := (
                    robot.impossible(fault, self._robot_settings)
                    or camera_stand_in.impossible(fault, self._camera_settings)
                    or ledbox_stand_in.impossible(fault, self._ledbox_settings)
                ):
                    return {"error": why}
                self._schedule(fault)
                return {}
            case "exposures":
                first, count = command.get("first"), command.get("count")
                if type(first) is not int or type(count) is not int or first < 0 or count < 0:
                    return {"error": "exposures: expected `first` and `count`, whole numbers of 0 or more"}
                exposures = self._exposures.since(first, count)
                return {"next": self._exposures.next_number, "exposures": exposures}
            case "edges" if isinstance(self.box, LedBoxFirmware):
                return {"next": self.box.edge_count}
            case "reset_robot":
                self.robot.reset()
                return {}
            case "stop":
                self.reactor.stop()
                return {}
            case other:
                return {"error": f"unknown command {other!r:.40}"}

    def close(self) -> None:
        self.camera.close()
        self.box.close()
        self.robot.close()
        self._control.close()


class OneFault(BaseModel):
    """One fault, for the control connection."""

    fault: script.Fault


def _tell(message: str) -> None:
    """Print a message on the terminal of the user who serves this world. Standard output is for the endpoints."""
    print(message, file=sys.stderr, flush=True)


def main() -> int:
    """Serve one world; see the module's text."""
    config = Config.model_validate_json(sys.stdin.readline())
    for number in _ENDING:
        signal.signal(number, lambda *_: sys.exit(0))  # until there is a world to stop
    threading.Thread(target=_end_when_parent_is_gone, daemon=True).start()
    with world_folder() as folder:
        world = World(config, folder)
        for number in _ENDING:
            signal.signal(number, lambda *_: world.reactor.stop())
        print(json.dumps(world.endpoints), flush=True)
        try:
            world.reactor.run()
        finally:
            world.close()
    return 0


def _end_when_parent_is_gone() -> None:
    """End this process by a signal when the parent is gone. So a world that is being started ends too; its code
    may be compiled for minutes."""
    with contextlib.suppress(OSError):
        while os.read(sys.stdin.fileno(), 4096):
            pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
