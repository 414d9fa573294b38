"""Server of the page on the loopback interface: images, and answers to the page's requests."""

from __future__ import annotations

import secrets
import socket
from collections.abc import Callable
from importlib import resources
from typing import TYPE_CHECKING, Any

from pkmcal.errors import InputError, PkmcalError
from pkmcal.files import json_value, next_step_after, resolved
from pkmcal.view.content import Viewed
from pkmcal.view.guard import Guard
from pkmcal.view.overlay import overlay_after_gesture, placed_by_hand
from pkmcal.view.pose_file import PoseFile
from pkmcal.view.requests import ViewRequest, checked_request

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

TOKEN_BYTES = 24
LOOPBACK_ADDRESS = "127.0.0.1"
CONNECTIONS_WAITING = 64
ANSWER_TIME_AT_CLOSING = 2
"""Seconds for requests in progress when the program is interrupted."""


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


def application(viewed: Viewed, token: str, port: int) -> Guard:
    """ASGI application: the page at /TOKEN/ and the paths of its requests."""
    from starlette.applications import Starlette
    from starlette.responses import HTMLResponse, Response
    from starlette.routing import Mount, Route

    pose_file = PoseFile(viewed.session.folder)

    def edges(viewed: Viewed, request: ViewRequest) -> dict[str, Any]:
        from pkmcal.view.edge_search import edge_search

        return edge_search(viewed, request)

    def fit(viewed: Viewed, request: ViewRequest) -> dict[str, Any]:
        from pkmcal.view.fit import localized_overlay

        return localized_overlay(viewed, request)

    def save(viewed: Viewed, request: ViewRequest) -> dict[str, Any]:
        pose = placed_by_hand(viewed, request).T_camera_base
        return {"said": pose_file.write(viewed.station(request.station), pose)}

    def answering(answer: Callable[[Viewed, ViewRequest], dict[str, Any]]) -> Any:
        async def endpoint(request: Request) -> Response:
            body = await request.body()

            return await _answered(lambda: answer(viewed, checked_request(body)))

        return endpoint

    # files and images by GET
    async def picture(request: Request) -> Response:
        s, k = request.path_params["s"], request.path_params["k"]
        return await _answered(lambda: Response(viewed.jpeg(s, k), media_type="image/jpeg"))

    async def page(_request: Request) -> Response:
        return await _answered(lambda: HTMLResponse(view_page_html(viewed)))

    async def script(_request: Request) -> Response:
        return Response(_template("view.js"), media_type="text/javascript")

    async def style(_request: Request) -> Response:
        report = (resources.files("pkmcal.pages") / "templates" / "style.css").read_text("utf-8")
        return Response(report + _template("view.css"), media_type="text/css")

    # requests by POST, each a validated JSON document
    routes = [
        Route("/", page),
        Route("/view.js", script),
        Route("/view.css", style),
        Route("/image/{s:int}/{k:int}", picture),
        *(
            Route(f"/{name}", answering(answer), methods=["POST"])
            for name, answer in (
                ("overlay", overlay_after_gesture), ("found", edges), ("fit", fit), ("save", save),
            )
        ),
    ]  # fmt: skip
    return Guard(Starlette(routes=[Mount(f"/{token}", routes=routes)]), token, port)


async def _answered(work: Callable[[], Any]) -> Response:
    """Response with the result of the work, or with its error as JSON; never a traceback."""
    from starlette.concurrency import run_in_threadpool
    from starlette.responses import JSONResponse, Response

    try:
        done = await run_in_threadpool(work)
    except PkmcalError as error:
        return JSONResponse(error.as_dict(), 422)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        message = InputError(
            f"the operating system refused: {reason}",
            where=error.filename,
            next_step=next_step_after(error),
        )
        return JSONResponse(message.as_dict(), 422)
    except Exception as error:  # noqa: BLE001 - the last resort, as at the command line
        message = PkmcalError(
            f"this is a defect of pkmcal, not of your session: {type(error).__name__}: {error}",
            next_step="Report it",
        )
        return JSONResponse(message.as_dict(), 500)
    return done if isinstance(done, Response) else JSONResponse(json_value(done))


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


def view_page_html(viewed: Viewed) -> str:
    """HTML of the page; it requests images and overlays itself."""
    from pkmcal.pages.page import environment

    session = viewed.session
    stations = [
        {
            "name": station.name,
            "size": station.camera.image_size,
            "legs": "legs" in station.observe,
            "handheld": station.handheld,
            "posed": station.T_camera_base is not None,
            "images": [
                " ".join([session.configurations[p.configuration], *filter(None, [p.repeat])])
                for p in station.images
            ],
        }
        for station in session.stations
    ]
    template = environment().from_string(_template("view.html.j2"))
    return template.render(
        name=resolved(session.folder).name,
        folder=session.folder,
        n_legs=session.machine.n_legs,
        stations=stations,
        calibrated=viewed.calibration is not None,
        state={"stations": stations, "calibrated": viewed.calibration is not None},
    )


def _template(name: str) -> str:
    return (resources.files("pkmcal.view") / "templates" / name).read_text("utf-8")
