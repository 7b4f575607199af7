"""Which web pages may use the page: without these checks, any page that is open in a browser on
this machine could read the scene (DNS rebinding, and WebSockets, to which browsers apply no
same-origin policy)."""

from __future__ import annotations

import http
import ipaddress
import socket
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit


def refusal(host: str | None, origin: str | None, allowed: Collection[str]) -> str | None:
    """Why a request must be refused; None if it may be answered.

    A page's own requests have its address as Host, and none or the same as Origin. Addresses in
    numbers are accepted as Host: no other page can have them as its own name.

    Args:
        host, origin: The request's headers; None for one that it lacks.
        allowed: Further host names, without port.
    """
    name = _host_name(f"//{host}") if host is not None else None
    names = {"localhost", socket.gethostname().casefold(), *(a.casefold() for a in allowed)}
    if name is None or not (name in names or _is_address(name)):
        return f"the host {str(host)[:100]!r} is not this machine's (--allow-host {name or 'NAME'})"
    if origin is None:
        return None
    from_name = _host_name(origin)
    same = _place(origin) == _place(f"//{host}")
    if same or (from_name is not None and from_name in {a.casefold() for a in allowed}):
        return None
    return f"the page {origin[:100]!r} is another one (--allow-host {from_name or 'NAME'})"


@contextmanager
def checked(allowed: Collection[str]) -> Iterator[None]:
    """Servers that are started inside check their requests by ``refusal``.

    viser has no option for it, so that the function that it starts its server with is replaced.
    """
    from websockets.asyncio import server
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    serve = server.serve

    def checked_serve(*args: Any, process_request: Any = None, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            # Several values of a header would be joined by an exception.
            values = [request.headers.get_all(name) for name in ("Host", "Origin")]
            host, origin = (v[0] if v else None for v in values)
            why = refusal(host, origin, allowed)
            if why is None and max(map(len, values)) <= 1:
                return process_request(connection, request) if process_request else None
            text = f"refused: {why or 'repeated headers'}\n".encode()
            headers = Headers({"Content-Type": "text/plain", "Content-Length": str(len(text))})
            status = http.HTTPStatus.FORBIDDEN
            return Response(status.value, status.phrase, headers, text)

        return serve(*args, process_request=process, **options)

    server.serve = checked_serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc]


def _place(url: str) -> str | None:
    """Host and port of a URL, in lower case."""
    try:
        return urlsplit(url).netloc.casefold() or None
    except ValueError:
        return None


def _host_name(url: str) -> str | None:
    try:
        return urlsplit(url).hostname
    except ValueError:
        return None


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
