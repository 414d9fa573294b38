"""Who may ask: only a page that was opened with the token, on this computer.

The port is on the loopback, which every program and, by way of a browser, every web page may call.
A page elsewhere knows no token; and one whose name was made to point here (DNS rebinding) gives
itself away by its Host or Origin.
"""

from __future__ import annotations

from secrets import compare_digest
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK_HOST_NAMES = ("127.0.0.1", "localhost")
REFUSED_REQUEST_TEXT = (
    "This page opens with the whole address that pkmcal view printed, token included.\n"
)
VIEW_RESPONSE_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; img-src 'self' data:; style-src 'self';"
    " script-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none';"
    " frame-ancestors 'none'",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class Guard:
    """An application in front of another one; refuses with 403, whatever was asked for."""

    def __init__(self, app: ASGIApp, token: str, port: int) -> None:
        self._app = app
        self._token = token.encode("ascii")
        self._hosts = {f"{name}:{port}".encode("ascii") for name in LOOPBACK_HOST_NAMES}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """As ASGI has it."""
        from starlette.datastructures import MutableHeaders
        from starlette.responses import PlainTextResponse

        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http" or not self._allowed(scope):
            response = PlainTextResponse(REFUSED_REQUEST_TEXT, 403, VIEW_RESPONSE_HEADERS)
            await response(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(VIEW_RESPONSE_HEADERS)
            await send(message)

        await self._app(scope, receive, with_headers)

    def _allowed(self, scope: Scope) -> bool:
        headers: dict[bytes, bytes] = dict(scope["headers"])
        origins = {b"http://" + host for host in self._hosts}
        first = scope["path"].encode("utf-8").split(b"/")[1:2]
        return (
            headers.get(b"host") in self._hosts
            and headers.get(b"origin", min(origins)) in origins
            and bool(first)
            and compare_digest(first[0], self._token)
        )
