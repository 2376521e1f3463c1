"""Layer between the driver and `harvesters`: opens a camera, translates errors, counts gaps in frame ids."""

from __future__ import annotations

import contextlib
import logging
import signal
import threading
from collections.abc import Iterator
from typing import Any

from coupole.errors import DeviceError, DeviceLost, DeviceRefused
from drivers.camera.gentl.settings import Settings

_LOG = logging.getLogger("harvesters")
"""Logger in place of harvesters' own, whose errors are raised here anyway."""
_LOG.addHandler(logging.NullHandler())


def open_camera(settings: Settings) -> tuple[Any, Any, dict[str, str]]:
    """Return harvester, acquirer and description of the one camera that matches the settings."""
    name = settings.device
    try:
        import genicam.gentl
        from harvesters.core import Harvester
    except ImportError as error:
        raise _loss(
            name, "the packages harvesters and genicam", str(error), "Install the extra `gentl`."
        ) from error
    if not settings.producer.is_file():
        raise _loss(name, f"a GenTL producer {settings.producer}", "there is no such file", "Correct the rig.")
    harvester = Harvester(logger=_LOG)
    handler = signal.getsignal(signal.SIGINT)
    try:
        harvester.add_file(str(settings.producer))
        harvester.update()
        if not harvester.device_info_list:
            harvester.reset()
            _raise_opening_error(str(settings.producer))
        devices = [(device, _describe(device)) for device in harvester.device_info_list]
        criteria = {"serial": settings.serial, "model": settings.model}
        fitting = [
            device
            for device in devices
            if all(not value or device[1][key] == value for key, value in criteria.items())
        ]
        if len(fitting) != 1:
            device_list = ", ".join(f"{device['model']} {device['serial']}" for _, device in devices) or "none"
            raise _loss(
                name,
                "exactly one camera of that model and serial number",
                f"{len(fitting)} of the producer's fit; it finds: {device_list}",
                "Check cable and power, that no other program uses the producer, and `serial` and `model`.",
            )
        acquirer = harvester.create(fitting[0][0])
    except genicam.gentl.GenericException as error:
        harvester.reset()
        raise _opening_failed(name, error) from error
    except BaseException:
        harvester.reset()
        raise
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, handler)  # harvesters would catch Ctrl-C and close the camera
    return harvester, acquirer, fitting[0][1]


def _raise_opening_error(producer: str) -> None:
    """Raise the producer's error if it cannot be opened, because harvesters hides the error and finds no camera.

    A producer can be open only once in a process (GenTL standard, GCInitLib).
    """
    import genicam.gentl

    library = genicam.gentl.GenTLProducer.create_producer()
    library.open(producer)
    try:
        system = library.create_system()
        system.open()
        system.close()
    finally:
        library.close()


def _opening_failed(name: str, error: Exception) -> DeviceError:
    import genicam.gentl

    if isinstance(error, genicam.gentl.ResourceInUseException | genicam.gentl.AccessDeniedException):
        return DeviceRefused(
            name,
            expected="a free camera",
            happened=f"it is in use ({error})",
            remedy="Close the other program.",
        )
    return _loss(name, "the camera to open", str(error))


def _describe(device: Any) -> dict[str, str]:
    """Description of a camera before it is opened; empty strings where the producer gives none."""
    import genicam.gentl

    def text(attribute: str) -> str:
        try:
            return str(getattr(device, attribute) or "")
        except genicam.gentl.GenericException:
            return ""

    names = {"vendor": "vendor", "model": "model", "serial": "serial_number", "version": "version"}
    return {key: text(attribute) for key, attribute in names.items()} | {"tl_type": text("tl_type")}


def _loss(
    name: str, expectation: str, observation: str, remedy: str = "Check cable and power, then resume the run."
) -> DeviceLost:
    return DeviceLost(name, expected=expectation, happened=observation, remedy=remedy)


@contextlib.contextmanager
def reporting(name: str, expectation: str) -> Iterator[None]:
    """Translate errors of the producer or of GenApi to DeviceLost, with their text."""
    import genicam.genapi
    import genicam.gentl

    try:
        yield
    except (genicam.genapi.GenericException, genicam.gentl.GenericException) as error:
        raise _loss(name, expectation, str(error)) from error


def optional_int(module: Any, attribute: str) -> int | None:
    """Value of an optional property; None if the producer does not provide it."""
    import genicam.gentl

    try:
        value = getattr(module, attribute)
    except genicam.gentl.GenericException:
        return None
    return int(value)


def when_incomplete(count: Any) -> Any:
    """Return `count` as a callback of harvesters."""
    from harvesters.core import Callback

    class Counting(Callback):  # type: ignore[misc,unused-ignore]  # harvesters has no types
        def emit(self, context: object | None = None) -> None:
            count()

    return Counting()


class Gaps:
    """Counts complete images and gaps in their frame ids."""

    def __init__(self) -> None:
        self.begin((0, 0))

    def begin(self, id_modulus: tuple[int, int]) -> None:
        """Begin a new acquisition; `id_modulus` as in `coupole.devices.Camera`."""
        self._ids = id_modulus[1] - id_modulus[0] + 1
        self._last_id: int | None = None
        self._skipped = self._incomplete_since = 0
        self.delivered = 0
        """Complete images."""

    def whole(self, frame_id: int) -> None:
        self.delivered += 1
        if self._last_id is None:
            self._skipped += self._incomplete_since
        else:
            self._skipped += (frame_id - self._last_id) % self._ids - 1
        self._last_id, self._incomplete_since = frame_id, 0

    def incomplete(self) -> None:
        """Note that an image arrived incomplete. Its id will be a gap."""
        self._incomplete_since += 1

    @property
    def missing(self) -> int:
        """Number of images that did not arrive complete, from gaps in ids. Losses before the first or after the
        last id are not known."""
        return self._skipped + self._incomplete_since
