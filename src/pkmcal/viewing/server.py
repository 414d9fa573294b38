"""Page of a session: its document, images, and the answers to its requests."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import version
from typing import TYPE_CHECKING

from pkmcal.files import Schema, resolved
from pkmcal.observe.images import upright_turns
from pkmcal.observe.predict import tubes_of
from pkmcal.outcome.blocks import images as blocks
from pkmcal.outcome.blocks.base import image_key
from pkmcal.session.load import Station
from pkmcal.viewing.content import SessionContent
from pkmcal.viewing.overlay import overlay_after_gesture, placed_by_hand
from pkmcal.viewing.pose_file import PoseFile
from pkmcal.web import serving
from pkmcal.web.document import SessionDocument
from pkmcal.web.session_document import SavedAnswer, SessionStation, ViewRequest

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.routing import BaseRoute


def session_routes(
    content: SessionContent, document: Callable[[], SessionDocument]
) -> list[BaseRoute]:
    """Routes of a session's page: the page, images by GET, and requests by POST.

    document : present document of the page.
    """
    from starlette.responses import Response
    from starlette.routing import Route

    pose_file = PoseFile(content.session.folder)

    def overlay(request: ViewRequest) -> Schema:
        return overlay_after_gesture(content, request)

    def edges(request: ViewRequest) -> Schema:
        from pkmcal.viewing.edge_search import edge_search

        return edge_search(content, request)

    def localize(request: ViewRequest) -> Schema:
        from pkmcal.viewing.fit import localized_overlay

        return localized_overlay(content, request)

    def save(request: ViewRequest) -> Schema:
        pose = placed_by_hand(content, request).T_camera_base
        text = pose_file.write(content.station(request.station), pose)
        content.set_pose(request.station, pose)  # for a page that is opened again
        return SavedAnswer(text=text)

    def stage() -> Schema:
        from pkmcal.viewing.stage import calibrated_stage

        return calibrated_stage(content)

    async def image(request: Request) -> Response:
        s, k = request.path_params["s"], request.path_params["k"]
        return await serving.response_of(
            lambda: Response(content.jpeg(s, k), media_type="image/jpeg")
        )

    async def thumbnail(request: Request) -> Response:
        s, k = request.path_params["s"], request.path_params["k"]
        return await serving.response_of(
            lambda: Response(content.thumbnail(s, k), media_type="image/jpeg")
        )

    async def stage_block(_request: Request) -> Response:
        return await serving.response_of(stage)

    answers = {"overlay": overlay, "edges": edges, "localize": localize, "save": save}
    return [
        *serving.page_routes(document),
        Route("/image/{s:int}/{k:int}", image),
        Route("/thumbnail/{s:int}/{k:int}", thumbnail),
        Route("/stage", stage_block),
        *(
            Route(f"/{name}", serving.json_endpoint(ViewRequest, answer), methods=["POST"])
            for name, answer in answers.items()
        ),
    ]


def session_document(content: SessionContent, report: str = "") -> SessionDocument:
    """Document of the page; images, overlays and the stage are requested by the page.

    report : address of the calibration's report.
    """
    session = content.session
    return SessionDocument(
        program=f"pkmcal {version('pkmcal')}",
        title=resolved(session.folder).name,
        legs=session.machine.n_legs,
        calibration="" if content.calibration is None else str(content.calibration),
        report=report,
        stations=tuple(_station(content, s, one) for s, one in enumerate(session.stations)),
    )


def _station(content: SessionContent, s: int, station: Station) -> SessionStation:
    """Station with the places of its images."""
    names, (width, height) = content.session.configurations, station.camera.image_size
    images: list[blocks.Image] = []
    for k, one in enumerate(station.images):
        name = names[one.configuration]
        images.append(
            blocks.Image(
                title=f"{station.name} / {name}",
                caption=" ".join(filter(None, [name, one.repeat])),
                group=station.name,
                key=image_key(station.name, name),
                width=width,
                height=height,
                quarter_turns=upright_turns(one.path, (width, height)),
                url=f"image/{s}/{k}",
            )
        )
    return SessionStation(
        name=station.name,
        legs="legs" in station.observe and len(tubes_of(content.session.machine)) > 0,
        handheld=station.handheld,
        posed=station.T_camera_base is not None,
        images=tuple(images),
    )
