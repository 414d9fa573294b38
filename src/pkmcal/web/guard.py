"""Access control: only the page that was opened with the token, on this computer, is served.

The port is on the loopback interface, which every local program can reach and, through a browser,
every web page. Other pages do not know the token, and a page whose host name was made to resolve
to this address (DNS rebinding) is recognised by its Host or Origin header.
"""

from __future__ import annotations

from secrets import compare_digest
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK_HOST_NAMES = ("127.0.0.1", "localhost")
REFUSED_REQUEST_TEXT = (
    "This page opens with the whole address that pkmcal printed, token included.\n"
)
RESPONSE_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; img-src 'self' data: blob:; style-src 'self';"
    " script-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none';"
    " frame-ancestors 'none'",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class Guard:
    """ASGI application in front of another one; unauthorized requests get 403 for every path."""

    def __init__(self, app: ASGIApp, token: str, port: int) -> None:
        self._app = app
        self._token = token.encode("ascii")
        self._hosts = {f"{name}:{port}".encode("ascii") for name in LOOPBACK_HOST_NAMES}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI entry point."""
        from starlette.datastructures import MutableHeaders
        from starlette.responses import PlainTextResponse

        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http" or not self._allowed(scope):
            response = PlainTextResponse(REFUSED_REQUEST_TEXT, 403, RESPONSE_HEADERS)
            await response(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(RESPONSE_HEADERS)
            await send(message)

        await self._app(scope, receive, with_headers)

    def _allowed(self, scope: Scope) -> bool:
        """Whether Host and Origin of a request are loopback and its path begins with the token."""
        headers: dict[bytes, bytes] = dict(scope["headers"])
        origins = {b"http://" + host for host in self._hosts}
        first = scope["path"].encode("utf-8").split(b"/")[1:2]
        return (
            headers.get(b"host") in self._hosts
            and headers.get(b"origin", min(origins)) in origins
            and bool(first)
            and compare_digest(first[0], self._token)
        )
