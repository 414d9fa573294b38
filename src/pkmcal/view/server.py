"""Requests of the page: images, and the overlays that it asks for."""

from __future__ import annotations

from importlib import resources
from typing import TYPE_CHECKING, Any

from pkmcal.files import resolved
from pkmcal.view.content import Viewed
from pkmcal.view.overlay import overlay_after_gesture, placed_by_hand
from pkmcal.view.pose_file import PoseFile
from pkmcal.view.requests import ViewRequest
from pkmcal.web import serving
from pkmcal.web.guard import Guard

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response


def application(viewed: Viewed, token: str, port: int) -> Guard:
    """ASGI application: the page at /TOKEN/ and the paths of its requests."""
    from starlette.responses import HTMLResponse, Response
    from starlette.routing import Route

    pose_file = PoseFile(viewed.session.folder)

    def overlay(request: ViewRequest) -> dict[str, Any]:
        return overlay_after_gesture(viewed, request)

    def edges(request: ViewRequest) -> dict[str, Any]:
        from pkmcal.view.edge_search import edge_search

        return edge_search(viewed, request)

    def fit(request: ViewRequest) -> dict[str, Any]:
        from pkmcal.view.fit import localized_overlay

        return localized_overlay(viewed, request)

    def save(request: ViewRequest) -> dict[str, Any]:
        pose = placed_by_hand(viewed, request).T_camera_base
        return {"said": pose_file.write(viewed.station(request.station), pose)}

    # files and images by GET
    async def picture(request: Request) -> Response:
        s, k = request.path_params["s"], request.path_params["k"]
        return await serving.response_of(
            lambda: Response(viewed.jpeg(s, k), media_type="image/jpeg")
        )

    async def page(_request: Request) -> Response:
        return await serving.response_of(lambda: HTMLResponse(view_page_html(viewed)))

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
            Route(f"/{name}", serving.json_endpoint(ViewRequest, answer), methods=["POST"])
            for name, answer in (
                ("overlay", overlay), ("found", edges), ("fit", fit), ("save", save),
            )
        ),
    ]  # fmt: skip
    return serving.application(routes, token, port)


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
