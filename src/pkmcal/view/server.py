"""Requests of the page: images, and the overlays that it asks for."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from importlib import resources
from string import Template
from typing import TYPE_CHECKING, Any

from pkmcal.errors import legible
from pkmcal.files import resolved
from pkmcal.view.content import Viewed
from pkmcal.view.overlay import overlay_after_gesture, placed_by_hand
from pkmcal.view.pose_file import PoseFile
from pkmcal.view.requests import ViewRequest
from pkmcal.web import serving
from pkmcal.web.guard import Guard
from pkmcal.web.page import script_json

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

LEG_COLOURS = 8
"""Colours of legs in the style sheet; machines with more legs repeat them."""
MACHINE_CHOICE = """\
    <div class="choice" role="group" aria-label="Machine laid over">
      <button type="button" data-shown="nominal" aria-pressed="true">Nominal</button><button
       type="button" data-shown="calibration" aria-pressed="false">Calibrated</button>
    </div>"""


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
        return Response(_template("view.css"), media_type="text/css")

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
    session = viewed.session
    stations = [
        {
            "name": legible(station.name),
            "size": station.camera.image_size,
            "legs": "legs" in station.observe,
            "handheld": station.handheld,
            "posed": station.T_camera_base is not None,
            "images": [
                legible(
                    " ".join([session.configurations[p.configuration], *filter(None, [p.repeat])])
                )
                for p in station.images
            ],
        }
        for station in session.stations
    ]
    calibrated = viewed.calibration is not None
    return Template(_template("view.html")).substitute(
        name=escape(legible(resolved(session.folder).name)),
        stations="\n".join(_station_list(s, one) for s, one in enumerate(stations)),
        choice=MACHINE_CHOICE if calibrated else "",
        legs="".join(
            f'<li><span class="chip photo leg-{leg % LEG_COLOURS + 1}">{leg + 1}</span>'
            f' <span class="small" data-leg="{leg + 1}"></span></li>'
            for leg in range(session.machine.n_legs)
        ),
        state=script_json({"stations": stations, "calibrated": calibrated}),
    )


def _station_list(s: int, station: Mapping[str, Any]) -> str:
    """List of a station's images, whose buttons carry their indices."""
    hand = ' <span class="small">by hand</span>' if station["handheld"] else ""
    items = "".join(
        f'<li><button type="button" data-station="{s}" data-image="{k}">{escape(image)}</button>'
        "</li>"
        for k, image in enumerate(station["images"])
    )
    return f"  <h2>{escape(station['name'])}{hand}</h2>\n  <ol>{items}</ol>"


def _template(name: str) -> str:
    return (resources.files("pkmcal.view") / "templates" / name).read_text("utf-8")
