"""Server of the viewer: checks of its address, and access for its own pages only."""

from __future__ import annotations

import errno
import http
import ipaddress
import socket
from collections.abc import Callable
from typing import Any
from unittest import mock
from urllib.parse import urlsplit

from .. import optional

MOST_PORT = 65535


def viser_server(host: str, port: int) -> Any:
    """A viser server that rejects pages of other sites.

    Args:
        host: address to listen at.
        port: port to listen at; the next free one where it is in use.

    Raises:
        ValueError: for an invalid port.
        OSError: for an address that is not of this machine, or a port that may not be listened at.
        ImportError: when viser is missing (extra ``view``).
    """
    viser = optional.load("viser", "the viewer", "view")
    sockets = optional.load("websockets.asyncio.server", "the viewer", "view")
    _check_address(host, port)
    # viser has no argument for a check of requests, so the `serve` of websockets is replaced while viser calls it.
    with mock.patch.object(sockets, "serve", _guarded(sockets.serve, host)):
        return viser.ViserServer(host=host, port=port, verbose=False)


def _check_address(host: str, port: int) -> None:
    """Raise instead of waiting for a server that cannot start, as viser does without limit."""
    if not 0 <= port <= MOST_PORT:
        raise ValueError(f"port must be within 0 and {MOST_PORT}, got {port}")
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        if getattr(error, "errno", None) != errno.EADDRINUSE:
            raise OSError(f"host: cannot listen at {host!r}, port {port}: {error}") from None


def page_address(host: str, port: int) -> str:
    """Address of the page of a server; an IPv6 address is in brackets."""
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def _guarded(serve: Callable[..., Any], host: str) -> Callable[..., Any]:
    """`serve` of websockets that rejects connections from pages of other sites."""

    def guarded(handler: Any, *arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            upgrade = request.headers.get("Upgrade", "").lower() == "websocket"
            if upgrade and not is_own_page(request.headers.get("Origin"), request.headers.get("Host"), host):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "pages of other sites may not connect\n")
            return None if process_request is None else process_request(connection, request)

        return serve(handler, *arguments, process_request=checked, **options)

    return guarded


def is_own_page(origin: str | None, requested: str | None, host: str) -> bool:
    """Whether a connection comes from a page of the server, or from a program other than a browser.

    Args:
        origin: header of the request: the site of the page; None for a program.
        requested: header of the request: host and port of the connection.
        host: address that the server listens at. Names of other sites may resolve to a loopback address, so only the
            names of this machine are accepted there.
    """
    if origin is None:
        return True
    try:
        page = urlsplit(origin)
    except ValueError:  # Such as a bracket that is not closed.
        return False
    if page.scheme not in ("http", "https") or page.netloc != requested:
        return False
    return not _is_loopback(host) or _is_loopback(page.hostname or "")


def _is_loopback(name: str) -> bool:
    try:
        return name == "localhost" or ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False
