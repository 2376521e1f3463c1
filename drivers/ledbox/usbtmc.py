"""Messages to and from a device of the USB Test and Measurement Class, over pyusb.

Source: USB-IF, "USB Test and Measurement Class Specification (USBTMC)", revision 1.0, 2003; the table numbers
below are from it. The subclass USB488 is not needed for program messages and responses.
"""

from __future__ import annotations

import contextlib
import struct
import threading
from typing import Any

from coupole.clock import Clock, Deadline
from drivers.ledbox.link import Cleared

_HEADER = struct.Struct("<BBBxIB3x")
"""Tables 1, 3, 4 and 9: MsgID, bTag, its complement, TransferSize, bmTransferAttributes."""
_DEV_DEP_MSG_OUT, _REQUEST_DEV_DEP_MSG_IN, _DEV_DEP_MSG_IN = 1, 2, 2
_EOM = 1
_INITIATE_CLEAR, _CHECK_CLEAR_STATUS = 5, 6  # table 15
_STATUS_SUCCESS, _STATUS_PENDING = 1, 2  # table 16
_CLASS_INTERFACE_IN = 0xA1
_USBTMC_CLASS, _USBTMC_SUBCLASS = 0xFE, 3

_MAX_OUT_BYTES = 4096
"""Payload of one Bulk-OUT transfer; longer messages are sent in several."""
_MAX_IN_BYTES = 16384
"""Payload requested in one Bulk-IN transfer; longer responses come in several."""
_LOOK_MS = 50
"""Machine time between two readings of the rig's clock."""
_CLEAR_TRIES = 50


class UsbtmcLink:
    """An open USBTMC interface: a `drivers.ledbox.link.Link`."""

    bytes_per_s = 1e6
    """Least rate of full-speed USB."""

    def __init__(self, vendor: int, product: int, serial: str | None, clock: Clock) -> None:
        import usb.core
        import usb.util

        self._usb_error, self._usb_timeout = usb.core.USBError, usb.core.USBTimeoutError
        self._dispose = usb.util.dispose_resources
        self._clock = clock
        self._tag = 0
        self._requested_tag: int | None = None
        self.clears = 0
        self._counting = threading.Lock()
        try:
            self._device: Any = _find(vendor, product, serial)
            interface = _claim(self._device)
        except (usb.core.USBError, usb.core.NoBackendError, ValueError) as error:
            # ValueError: pyusb could not read a string descriptor, for lack of permission
            raise ConnectionError(str(error)) from error
        self._interface = interface.bInterfaceNumber
        bulk = [endpoint for endpoint in interface if usb.util.endpoint_type(endpoint.bmAttributes) == 2]
        self._out, self._in = sorted(
            (endpoint.bEndpointAddress for endpoint in bulk), key=lambda address: address & 0x80
        )

    def write(self, data: bytes, deadline: Deadline, clears: int) -> None:
        """Send `data` as one message: DEV_DEP_MSG_OUT transfers, EOM on the last. During a device clear the device
        halts the endpoint, so that late data are refused."""
        for start in range(0, len(data), _MAX_OUT_BYTES):
            self._refuse_cleared(clears)
            piece = data[start : start + _MAX_OUT_BYTES]
            last = start + len(piece) == len(data)
            header = self._header(_DEV_DEP_MSG_OUT, len(piece), _EOM if last else 0)
            padding = bytes(-len(piece) % 4)
            timeout_ms = max(1000, round(deadline.remaining_s * 1000))
            try:
                self._device.write(self._out, header + piece + padding, timeout_ms)
            except self._usb_timeout as error:
                raise self._failure(TimeoutError("a Bulk-OUT transfer was not taken"), clears) from error
            except self._usb_error as error:
                raise self._failure(ConnectionError(str(error)), clears) from error

    def read_bytes(self, deadline: Deadline, clears: int) -> bytes:
        """Return the payload of one DEV_DEP_MSG_IN transfer. A response may need several transfers."""
        self._refuse_cleared(clears)
        if self._requested_tag is None:
            request = self._header(_REQUEST_DEV_DEP_MSG_IN, _MAX_IN_BYTES, 0)
            try:
                self._device.write(self._out, request, 1000)
            except self._usb_timeout as error:
                raise self._failure(TimeoutError("the request for a response was not taken"), clears) from error
            except self._usb_error as error:
                raise self._failure(ConnectionError(str(error)), clears) from error
            self._requested_tag = self._tag
        transfer = self._read_bulk(deadline, clears)
        if len(transfer) < _HEADER.size:
            raise ConnectionError(f"a Bulk-IN transfer of {len(transfer)} bytes has no header")
        kind, tag, complement, size, _ = _HEADER.unpack_from(transfer)
        if (kind, tag, complement) != (
            _DEV_DEP_MSG_IN,
            self._requested_tag,
            tag ^ 0xFF,
        ) or size > _MAX_IN_BYTES:
            raise ConnectionError(f"Bulk-IN header {transfer[:12].hex(' ')} does not answer the request")
        self._requested_tag = None
        while len(transfer) < _HEADER.size + size:
            transfer += self._read_bulk(deadline, clears)
        return transfer[_HEADER.size : _HEADER.size + size]

    def device_clear(self) -> None:
        """Send INITIATE_CLEAR on the control endpoint, which waits for no bulk transfer (section 4.2.1.6)."""
        with self._counting:
            self.clears += 1
        self._initiate_clear()

    def clear(self) -> None:
        """Discard pending messages in both directions (section 4.2.1.6)."""
        self._requested_tag = None
        self._initiate_clear()
        try:
            for _ in range(_CLEAR_TRIES):
                status, pending_in = self._class_request(_CHECK_CLEAR_STATUS, 2)
                if status == _STATUS_SUCCESS:
                    self._device.clear_halt(self._out)
                    return
                if status != _STATUS_PENDING:
                    raise ConnectionError(f"CHECK_CLEAR_STATUS answers {status}")
                if pending_in & 1:
                    with contextlib.suppress(self._usb_timeout):
                        self._device.read(self._in, _MAX_IN_BYTES, _LOOK_MS)
                self._clock.sleep(0.01)
        except self._usb_error as error:
            raise ConnectionError(str(error)) from error
        raise ConnectionError("the device's buffers do not clear")

    def close(self) -> None:
        with contextlib.suppress(self._usb_error):
            self._dispose(self._device)

    def _header(self, kind: int, size: int, attributes: int) -> bytes:
        self._tag = self._tag % 255 + 1
        return _HEADER.pack(kind, self._tag, self._tag ^ 0xFF, size, attributes)

    def _initiate_clear(self) -> None:
        try:
            if self._class_request(_INITIATE_CLEAR, 1) != (_STATUS_SUCCESS,):
                raise ConnectionError("the device refuses INITIATE_CLEAR")
        except self._usb_error as error:
            raise ConnectionError(str(error)) from error

    def _read_bulk(self, deadline: Deadline, clears: int) -> bytes:
        while True:
            self._refuse_cleared(clears)
            late = deadline.has_expired
            try:
                return bytes(self._device.read(self._in, _HEADER.size + _MAX_IN_BYTES + 4, _LOOK_MS))
            except self._usb_timeout as error:
                if late:
                    raise TimeoutError("nothing came") from error
            except self._usb_error as error:
                raise self._failure(ConnectionError(str(error)), clears) from error

    def _refuse_cleared(self, clears: int) -> None:
        if self.clears != clears:
            raise Cleared

    def _failure(self, error: Exception, clears: int) -> Exception:
        """Return the exception to raise for an error of a transfer: a device clear may have ended it."""
        return Cleared() if self.clears != clears else error

    def _class_request(self, request: int, length: int) -> tuple[int, ...]:
        reply = self._device.ctrl_transfer(_CLASS_INTERFACE_IN, request, 0, self._interface, length, 1000)
        if len(reply) != length:
            raise ConnectionError(f"control request {request} answers {len(reply)} bytes, not {length}")
        return tuple(reply)


def _find(vendor: int, product: int, serial: str | None) -> Any:
    import usb.core

    candidates = list(usb.core.find(find_all=True, idVendor=vendor, idProduct=product))
    devices = [device for device in candidates if serial is None or device.serial_number == serial]
    if len(devices) != 1:
        device_text = f"{vendor:04x}:{product:04x}" + (f" with serial {serial}" if serial else "")
        raise ConnectionError(f"{len(devices)} USB devices {device_text} are connected")
    return devices[0]


def _claim(device: Any) -> Any:
    """The device's USBTMC interface, claimed."""
    import usb.util

    with contextlib.suppress(NotImplementedError):  # only Linux binds a kernel driver to the interface
        for interface in device[0]:
            if device.is_kernel_driver_active(interface.bInterfaceNumber):
                device.detach_kernel_driver(interface.bInterfaceNumber)
    device.set_configuration()
    interface = usb.util.find_descriptor(
        device.get_active_configuration(), bInterfaceClass=_USBTMC_CLASS, bInterfaceSubClass=_USBTMC_SUBCLASS
    )
    if interface is None:
        raise ConnectionError("the USB device has no USBTMC interface")
    usb.util.claim_interface(device, interface.bInterfaceNumber)
    return interface
