"""Rules for the sender that a waiting driver accepts as its controller."""

from __future__ import annotations

from ipaddress import ip_address

LOOPBACK_NAMES = ("localhost",)


def only_here(address: str) -> bool:
    """True for a `host:port` that no other machine can reach."""
    host = address.rsplit(":", 1)[0]
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host in LOOPBACK_NAMES


def refuse_anybody(address: str, controller: object, any_controller_by: str) -> None:
    """Raises ValueError if other machines can reach `address`, no controller is named, and nobody has taken
    responsibility for this."""
    if not (only_here(address) or controller or any_controller_by):
        raise ValueError(
            f"expected `controller`, the address of the arm's controller: at {address} the first sender would be "
            "taken for it. Or a person writes `any_controller_by: NAME` beside it"
        )
    if controller and any_controller_by:
        raise ValueError("expected `controller` or `any_controller_by`, found both")
