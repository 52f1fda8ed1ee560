"""The address that the page of `bokehguide view` listens on."""

from __future__ import annotations

import os
import socket
from ipaddress import ip_address

from bokehguide.errors import BokehguideError


def is_loopback(host: str) -> bool:
    """Whether a host name or address is this machine's own."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def require_address(host: str, port: int) -> None:
    """Raise BokehguideError for an address that cannot be listened on; port 0 is any free port."""
    try:
        for family, kind, protocol, _, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
            with socket.socket(family, kind, protocol) as trial:
                if os.name == "posix":  # elsewhere the option would take a used port
                    trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                trial.bind(address)
    except OSError as error:
        raise unusable(host, port, error) from None


def unusable(host: str, port: int, error: OSError) -> BokehguideError:
    """The error for an address that cannot be listened on.

    The text of asyncio repeats the address, and the error numbers of the name service are negative.
    """
    number = error.errno or 0
    reason = os.strerror(number) if number > 0 else error.strerror or str(error)
    return BokehguideError(f"view: cannot listen on {host}:{port} ({reason}); give another --port or --host")
