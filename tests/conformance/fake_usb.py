"""A USB cable in software: a back end of pyusb at whose far end stands the LED box as a USBTMC device."""

from __future__ import annotations

import errno
import struct
import threading
from array import array
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.core

from sim.world.reactor import Reactor

VENDOR, PRODUCT, SERIAL = 0x1209, 0xC0DE, "SIM-0001"
OUT, IN = 0x02, 0x81
MAX_IN_BYTES = 600
"""The device's own bound on a Bulk-IN payload: long responses come in several transfers."""
_HEADER = struct.Struct("<BBBxIB3x")


class UsbLink:
    """The device's end: assembles messages from DEV_DEP_MSG_OUT transfers, keeps the response for Bulk-IN."""

    port = f"usbtmc:{VENDOR:04x}:{PRODUCT:04x}:{SERIAL}"

    def __init__(self, reactor: Reactor) -> None:
        self._reactor = reactor
        self._received: Callable[[bytes], None] = lambda data: None
        self._on_break: Callable[[], None] | None = None
        self._message = b""
        self._response = b""
        self._ready = threading.Condition()
        self._request: tuple[int, int] | None = None
        self._muted = False
        self.halted = False
        """Between INITIATE_CLEAR and CLEAR_FEATURE: the Bulk-OUT endpoint takes nothing."""
        self.busy = False
        """The box takes no transfer until it is cleared."""
        self.refused = 0
        self.gone = False

    def listen(self, on_bytes: Callable[[bytes], None], on_break: Callable[[], None] | None = None) -> None:
        self._received, self._on_break = on_bytes, on_break

    def send(self, data: bytes) -> bool:
        with self._ready:
            if not self._muted:
                self._response += data
                self._ready.notify_all()
        return True

    def drop_output(self) -> None:
        with self._ready:
            self._response = b""

    def mute(self) -> None:
        self._muted = True

    def close(self) -> None:
        self.gone = True

    def await_clear(self, timeout_ms: int) -> bool:
        """Hold a transfer back; False if no INITIATE_CLEAR came in time."""
        with self._ready:
            self.refused += 1
            return self._ready.wait_for(lambda: not self.busy, timeout_ms / 1000)

    def take_out(self, transfer: bytes) -> None:
        """One Bulk-OUT transfer, checked as a device would check it."""
        kind, tag, complement, size, attributes = _HEADER.unpack_from(transfer)
        assert tag
        assert tag ^ complement == 0xFF
        if kind == 2:
            self._request = (tag, size)
            return
        assert kind == 1
        assert len(transfer) == _HEADER.size + -(-size // 4) * 4
        self._message += transfer[_HEADER.size : _HEADER.size + size]
        if attributes & 1:
            message, self._message = self._message, b""
            if not self._muted:
                self._reactor.call_threadsafe(lambda: self._received(message))

    def give_in(self, timeout_ms: int) -> bytes | None:
        """The Bulk-IN transfer that answers the request, or None if there is nothing to answer yet."""
        with self._ready:
            if self._request is None or not self._ready.wait_for(lambda: self._response, timeout_ms / 1000):
                return None
            (tag, size), self._request = self._request, None
            count = min(size, MAX_IN_BYTES, len(self._response))
            payload, self._response = self._response[:count], self._response[count:]
        header = _HEADER.pack(2, tag, tag ^ 0xFF, count, 0 if self._response else 1)
        return header + payload + bytes(-count % 4)

    def clear(self) -> None:
        """INITIATE_CLEAR: both buffers, and what the box makes of it."""
        with self._ready:
            self._message, self._response, self._request, self.halted = b"", b"", None, True
            self.busy = False
            self._ready.notify_all()
        if self._on_break is not None and not self._muted:
            self._reactor.call_threadsafe(self._on_break)


class Backend(usb.backend.IBackend):
    """What libusb is to pyusb, for one device with one USBTMC interface."""

    def __init__(self, link: UsbLink) -> None:
        super().__init__()
        self._link = link
        self._configuration = 0

    def enumerate_devices(self) -> Any:
        return [] if self._link.gone else ["the box"]

    def get_device_descriptor(self, dev: Any) -> Any:
        return SimpleNamespace(
            bLength=18,
            bDescriptorType=1,
            bcdUSB=0x200,
            bDeviceClass=0,
            bDeviceSubClass=0,
            bDeviceProtocol=0,
            bMaxPacketSize0=64,
            idVendor=VENDOR,
            idProduct=PRODUCT,
            bcdDevice=0x100,
            iManufacturer=1,
            iProduct=2,
            iSerialNumber=3,
            bNumConfigurations=1,
            address=1,
            bus=1,
            port_number=1,
            port_numbers=(1,),
            speed=3,
        )

    def get_configuration_descriptor(self, dev: Any, config: int) -> Any:
        if config:
            raise IndexError(config)
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=2,
            wTotalLength=32,
            bNumInterfaces=1,
            bConfigurationValue=1,
            iConfiguration=0,
            bmAttributes=0xC0,
            bMaxPower=50,
            extra_descriptors=b"",
        )

    def get_interface_descriptor(self, dev: Any, intf: int, alt: int, config: int) -> Any:
        if intf or alt:
            raise IndexError(intf)
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=4,
            bInterfaceNumber=0,
            bAlternateSetting=0,
            bNumEndpoints=2,
            bInterfaceClass=0xFE,
            bInterfaceSubClass=3,
            bInterfaceProtocol=1,
            iInterface=0,
            extra_descriptors=b"",
        )

    def get_endpoint_descriptor(self, dev: Any, ep: int, intf: int, alt: int, config: int) -> Any:
        return SimpleNamespace(
            bLength=7,
            bDescriptorType=5,
            bEndpointAddress=(OUT, IN)[ep],
            bmAttributes=2,
            wMaxPacketSize=512,
            bInterval=0,
            bRefresh=0,
            bSynchAddress=0,
            extra_descriptors=b"",
        )

    def open_device(self, dev: Any) -> Any:
        self._check()
        return dev

    def close_device(self, dev_handle: Any) -> None: ...

    def set_configuration(self, dev_handle: Any, config_value: int) -> None:
        self._configuration = config_value

    def get_configuration(self, dev_handle: Any) -> int:
        return self._configuration

    def claim_interface(self, dev_handle: Any, intf: int) -> None: ...

    def release_interface(self, dev_handle: Any, intf: int) -> None: ...

    def is_kernel_driver_active(self, dev_handle: Any, intf: int) -> bool:
        return False

    def clear_halt(self, dev_handle: Any, ep: int) -> None:
        assert ep == OUT
        self._link.halted = False

    def bulk_write(self, dev_handle: Any, ep: int, intf: int, data: Any, timeout: int) -> int:
        self._check()
        assert ep == OUT
        if self._link.busy and not self._link.await_clear(timeout):
            raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
        if self._link.halted:
            raise usb.core.USBError("Pipe error", -9, errno.EPIPE)
        self._link.take_out(bytes(data))
        return len(data)

    def bulk_read(self, dev_handle: Any, ep: int, intf: int, buff: Any, timeout: int) -> int:
        self._check()
        assert ep == IN
        transfer = self._link.give_in(timeout)
        self._check()
        if transfer is None:
            raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
        buff[: len(transfer)] = array("B", transfer)
        return len(transfer)

    def ctrl_transfer(self, dev_handle: Any, *setup: Any) -> int:
        self._check()
        request_type, request, value, _, data, _ = setup
        if (request_type, request) == (0x80, 6):  # GET_DESCRIPTOR, string
            text = "" if value & 0xFF == 0 else SERIAL
            content = text.encode("utf-16-le") if text else b"\x09\x04"
            answer = bytes([2 + len(content), 3]) + content
        elif (request_type, request) == (0xA1, 5):  # INITIATE_CLEAR
            self._link.clear()
            answer = b"\x01"
        else:
            assert (request_type, request) == (0xA1, 6)  # CHECK_CLEAR_STATUS
            answer = b"\x01\x00"
        answer = answer[: len(data)]
        data[: len(answer)] = array("B", answer)
        return len(answer)

    def _check(self) -> None:
        if self._link.gone:
            raise usb.core.USBError("No such device (it may have been disconnected)", -4, errno.ENODEV)
