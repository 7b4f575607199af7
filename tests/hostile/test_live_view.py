"""Other web pages and the live view: they can neither open it nor read the scene."""

from __future__ import annotations

import http.client

import pytest

from pipeline.watching.access import checked, refusal
from tests.tools import need_package


@pytest.mark.parametrize(
    ("host", "origin", "allowed"),
    [
        ("localhost:8080", None, ()),
        ("localhost:8080", "http://localhost:8080", ()),
        ("LOCALHOST:9000", "http://localhost:9000", ()),
        ("127.0.0.1:8080", "http://127.0.0.1:8080", ()),
        ("[::1]:8080", "http://[::1]:8080", ()),
        ("192.168.0.7:8080", "http://192.168.0.7:8080", ()),
        ("view.example.org", "https://view.example.org", ("view.example.org",)),
        ("localhost:8080", "https://view.example.org", ("VIEW.example.org",)),
    ],
)
def test_the_pages_own_requests_are_answered(host, origin, allowed):
    assert refusal(host, origin, allowed) is None


@pytest.mark.parametrize(
    ("host", "origin", "expected"),
    [
        ("evil.example:8080", None, "--allow-host evil.example"),
        ("evil.example:8080", "http://evil.example:8080", "--allow-host evil.example"),
        ("localhost.evil.example", None, "is not this machine's"),
        ("127.0.0.1.evil.example", None, "is not this machine's"),
        ("localhost:8080", "http://evil.example", "--allow-host evil.example"),
        ("localhost:8080", "http://localhost:9999", "is another one"),
        ("localhost:8080", "null", "is another one"),
        ("localhost:8080", "http://[", "is another one"),
        ("localhost:8080", "", "is another one"),
        ("evil@localhost:8080", "http://evil.example", "is another one"),
        ("[", None, "is not this machine's"),
        ("", None, "is not this machine's"),
        (None, None, "is not this machine's"),
    ],
)
def test_other_pages_are_refused(host, origin, expected):
    assert expected in str(refusal(host, origin, ()))


def test_a_running_server_refuses_them():
    """Of viser itself: its way to start a server may change with its version."""
    need_package("viser")
    import viser

    with checked(["view.example.org"]):
        server = viser.ViserServer(host="127.0.0.1", port=18180, verbose=False)
    try:
        upgrade = {
            "Upgrade": "websocket",
            "Connection": "Upgrade",
            "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
            "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}",
        }

        def status(headers: dict[str, str]) -> int:
            connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=30)
            connection.putrequest("GET", "/", skip_host=True)
            for name, value in headers.items():
                connection.putheader(name, value)
            connection.endheaders()
            found = connection.getresponse().status
            connection.close()
            return found

        own = {"Host": f"localhost:{server.get_port()}"}
        page = {"Origin": f"http://{own['Host']}"}
        evil = {"Origin": "http://evil.example"}
        assert status(own) == 200
        assert status(own | page | upgrade) == 101
        assert status(own | upgrade) == 101
        assert status(own | evil | upgrade) == 403
        assert status({"Host": "evil.example"}) == 403
        assert status({"Host": "evil.example"} | evil | upgrade) == 403
        assert status({"Host": "view.example.org"}) == 200
    finally:
        server.stop()
