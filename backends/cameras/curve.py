"""Where a stream may go: beyond this machine only encrypted, and only to those whose keys are known."""

from __future__ import annotations

import re
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path

from dualcal_hal.errors import UsageError

_ENDPOINT = re.compile(r"tcp://(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.*-]+):(\d{1,5}|\*)")


@dataclass(frozen=True)
class ServerKeys:
    """secret: the server's own file, as ``zmq.auth.create_certificates`` writes it (``*.key_secret``);
    clients: folder of the public key files (``*.key``) of all who may listen."""

    secret: Path
    clients: Path


@dataclass(frozen=True)
class ClientKeys:
    """server: file of the server's public key (``*.key``); secret: the client's own file (``*.key_secret``)."""

    server: Path
    secret: Path


def host_of(endpoint: str) -> str:
    """The host of ``tcp://HOST:PORT``; UsageError for any other endpoint."""
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or (match[2] != "*" and int(match[2]) > 65535):
        raise UsageError(f"'{endpoint}' is no endpoint: it must be like tcp://127.0.0.1:5555")
    return match[1].strip("[]")


def is_loopback(endpoint: str) -> bool:
    """Whether nobody outside this machine can be there; UsageError for what is no endpoint."""
    host = host_of(endpoint)
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:  # a name, or an interface's: it may be anybody
        return False


def public_key(file: Path) -> bytes:
    """UsageError if the file has none."""
    return _keys(file)[0]


def secret_key(file: Path) -> tuple[bytes, bytes]:
    """Public and secret key; UsageError if the file has not both."""
    public, secret = _keys(file)
    if secret is None:
        raise UsageError(f"{file}: has no secret key: name the file that ends in .key_secret")
    return public, secret


def _keys(file: Path) -> tuple[bytes, bytes | None]:
    from zmq.auth import load_certificate

    try:
        return load_certificate(file)
    except (OSError, ValueError) as error:
        raise UsageError(f"{file}: no key can be read from it: {error}") from error
