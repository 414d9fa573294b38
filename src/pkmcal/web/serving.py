"""Server of pages on the loopback interface: sockets, requests as JSON, and errors as JSON."""

from __future__ import annotations

import json
import secrets
import socket
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pkmcal.errors import InputError, PkmcalError
from pkmcal.files import Document, Schema, refused_by_system, validated_document
from pkmcal.web.bundle_files import SCRIPT_FILE, STYLE_FILE, bundle_file
from pkmcal.web.guard import Guard
from pkmcal.web.page import served_page

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.routing import BaseRoute

    from pkmcal.web.document import AnyDocument

TOKEN_BYTES = 24
LOOPBACK_ADDRESS = "127.0.0.1"
CONNECTIONS_WAITING = 64
ANSWER_TIME_AT_CLOSING = 2
"""Seconds for requests in progress when the program is interrupted."""

SomeRequest = TypeVar("SomeRequest", bound=Schema)


def listening_socket(port: int) -> socket.socket:
    """Listening socket on the loopback interface.

    port : 0 for any free port. Raises InputError if the port is taken.
    """
    # asyncio sets TCP_NODELAY only if the protocol is given by number; without it the second part
    # of every answer waits 40 ms for the acknowledgement of the first
    socket_ = socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    socket_.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        socket_.bind((LOOPBACK_ADDRESS, port))
    except OSError as error:
        socket_.close()
        raise InputError(
            f"the page cannot be served on port {port} ({error.strerror or error})",
            where="--port",
            next_step="Name another port, or leave --port out for a free one",
        ) from None
    socket_.listen(CONNECTIONS_WAITING)
    return socket_


def new_token() -> str:
    """Unguessable token for the page's address."""
    return secrets.token_urlsafe(TOKEN_BYTES)


def application(routes: Sequence[BaseRoute], token: str, port: int) -> Guard:
    """ASGI application with its routes below /TOKEN/."""
    from starlette.applications import Starlette
    from starlette.routing import Mount

    return Guard(Starlette(routes=[Mount(f"/{token}", routes=routes)]), token, port)


def page_routes(document: Callable[[], AnyDocument]) -> list[BaseRoute]:
    """Routes of a page: its present document in its shell, and the viewer's bundle."""
    from starlette.concurrency import run_in_threadpool
    from starlette.responses import HTMLResponse, Response
    from starlette.routing import Route

    async def page(_request: Request) -> Response:
        return HTMLResponse(await run_in_threadpool(lambda: served_page(document())))

    async def script(_request: Request) -> Response:
        return Response(bundle_file(SCRIPT_FILE), media_type="text/javascript")

    async def style(_request: Request) -> Response:
        return Response(bundle_file(STYLE_FILE), media_type="text/css")

    return [
        Route("/", page),
        Route(f"/{SCRIPT_FILE}", script),
        Route(f"/{STYLE_FILE}", style),
    ]


def json_endpoint(
    schema: type[SomeRequest], respond: Callable[[SomeRequest], Schema]
) -> Callable[[Request], Any]:
    """Endpoint of requests by POST, each a JSON document that is validated as files are, because
    a page may be older than the program.
    """

    async def endpoint(request: Request) -> Response:
        body = await request.body()

        return await response_of(lambda: respond(checked_request(body, schema)))

    return endpoint


def checked_request(body: bytes, schema: type[SomeRequest]) -> SomeRequest:
    """Request of a page. Raises InputError for anything that is not one."""
    try:
        data = json.loads(body)
    except ValueError:
        raise InputError("the request is not valid JSON", where="the page") from None
    if not isinstance(data, dict):
        raise InputError("the request is no JSON object", where="the page")
    return validated_document(Document(Path("the page"), "the page", data, {}), schema)


async def response_of(work: Callable[[], Response | Schema]) -> Response:
    """Response of the work, or with its result or its error as JSON; never a traceback."""
    from starlette.concurrency import run_in_threadpool
    from starlette.responses import JSONResponse, Response

    try:
        done = await run_in_threadpool(work)
    except PkmcalError as error:
        return JSONResponse(error.as_dict(), 422)
    except OSError as error:
        return JSONResponse(refused_by_system(error).as_dict(), 422)
    except Exception as error:  # noqa: BLE001 - the last resort, as at the command line
        message = PkmcalError(
            f"this is a defect of pkmcal, not of your session: {type(error).__name__}: {error}",
            next_step="Report it",
        )
        return JSONResponse(message.as_dict(), 500)
    if isinstance(done, Schema):
        return Response(done.model_dump_json(), media_type="application/json")
    return done


def serve(
    application: Callable[[str, int], Guard], port: int, announce: Callable[[str], object]
) -> None:
    """Serve a page until the program is interrupted.

    application : from the page's token and port. port : 0 for a free one. announce : called with
    the address. Raises InputError if the port is taken.
    """
    token = new_token()
    with listening_socket(port) as socket_:
        port = socket_.getsockname()[1]
        app = application(token, port)
        announce(f"http://{LOOPBACK_ADDRESS}:{port}/{token}/")
        serve_until_interrupted(app, socket_)


def serve_until_interrupted(app: Guard, socket_: socket.socket) -> None:
    """Serve until the program is interrupted."""
    from contextlib import suppress

    import uvicorn

    config = uvicorn.Config(
        app, log_config=None, log_level="critical", access_log=False, lifespan="off", ws="none",
        timeout_graceful_shutdown=ANSWER_TIME_AT_CLOSING, server_header=False,
    )  # fmt: skip
    with suppress(KeyboardInterrupt):  # Ctrl-C is how this ends
        uvicorn.Server(config).run(sockets=[socket_])
