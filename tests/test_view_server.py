"""The server of the viewer refuses addresses that it cannot listen at, and pages of other sites."""

from urllib.parse import urlsplit

import pytest

from torch_mpm.cli import main
from torch_mpm.render.viewer_server import is_own_page, page_address, viser_server


@pytest.mark.parametrize(
    ("origin", "requested", "host", "own"),
    [
        (None, "127.0.0.1:8080", "127.0.0.1", True),
        ("http://127.0.0.1:8080", "127.0.0.1:8080", "127.0.0.1", True),
        ("http://localhost:8080", "localhost:8080", "127.0.0.1", True),
        ("http://[::1]:8080", "[::1]:8080", "::1", True),
        ("http://evil.example", "127.0.0.1:8080", "127.0.0.1", False),
        ("http://127.0.0.1:9000", "127.0.0.1:8080", "127.0.0.1", False),  # another server of this machine
        ("http://evil.example:8080", "evil.example:8080", "127.0.0.1", False),  # a name that leads here
        ("null", "127.0.0.1:8080", "127.0.0.1", False),
        ("http://[", "127.0.0.1:8080", "127.0.0.1", False),
        ("file://", "127.0.0.1:8080", "127.0.0.1", False),
        ("http://machine.example:8080", "machine.example:8080", "0.0.0.0", True),
        ("http://evil.example", "machine.example:8080", "0.0.0.0", False),
    ],
)
def test_pages_of_the_server(origin, requested, host, own):
    assert is_own_page(origin, requested, host) == own


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::1", "fe80::1%eth0"])
def test_the_address_of_the_page(host):
    page = urlsplit(page_address(host, 8080))
    assert page.hostname == host and page.port == 8080


def test_pages_of_other_sites_cannot_connect():
    pytest.importorskip("viser")
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    server = viser_server("127.0.0.1", 18_180)
    address = f"127.0.0.1:{server.get_port()}"
    try:
        for origin in (None, f"http://{address}"):
            connect(f"ws://{address}", origin=origin).close()
        for origin in ("http://evil.example", "http://127.0.0.1:1", "null"):
            with pytest.raises(InvalidStatus, match="403"):
                connect(f"ws://{address}", origin=origin)
    finally:
        server.stop()


@pytest.mark.parametrize("host", ["no.such.host.invalid", "192.0.2.7", "a" * 300, "a b"])
def test_addresses_that_cannot_be_listened_at(host):
    pytest.importorskip("viser")
    with pytest.raises(OSError, match="cannot listen at"):
        viser_server(host, 18_280)


@pytest.mark.parametrize("port", [-1, 65536, 10**9])
def test_ports_that_are_none(port):
    pytest.importorskip("viser")
    with pytest.raises(ValueError, match="port must be within 0 and 65535"):
        viser_server("127.0.0.1", port)


@pytest.mark.parametrize("port", ["-1", "65536", "9" * 4000, "x", "1.5", ""])
def test_the_command_refuses_them(port, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["view", "out", "--port", port])
    assert ended.value.code == 2 and "takes a port within 0 and 65535" in capsys.readouterr().err
