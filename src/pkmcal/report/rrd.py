"""Calibration as a recording for rerun's viewer, an extra: ``pip install '.[rerun]'``.

The SDK is imported only when a recording is written.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pkmcal.errors import InputError
from pkmcal.files import check_writable, resolved, staged_file
from pkmcal.report.recording import Logged, recorded
from pkmcal.wording import install_step

if TYPE_CHECKING:
    from pkmcal.calibration.calibrate import Calibration

RERUN_APPLICATION = "pkmcal"
RERUN_TIMELINE = "configuration"
RERUN_FILE_ENDING = ".rrd"
STATIONS_SIDE_BY_SIDE = 4
"""Most stations whose images are side by side; of more they are in tabs."""


def check_rrd(path: Path | str) -> None:
    """Raise InputError if no recording could be written. Call it before the calibration."""
    path = Path(path)
    if path.suffix != RERUN_FILE_ENDING:
        raise InputError(
            "a recording has another ending", where="--rrd", found=path.name, expected="NAME.rrd"
        )
    if path.is_dir():
        raise InputError("a folder stands where the recording should go", where=str(path))
    check_writable(path.parent)
    if find_spec("rerun") is None:
        raise InputError(
            "recordings need rerun, which is not installed",
            where="--rrd",
            next_step=install_step("rerun"),
        )


def write_rrd(calibration: Calibration, path: Path | str) -> None:
    """Write a recording that ``rerun PATH`` opens, whole or not at all.

    Raises InputError if rerun is not installed, if the file cannot be written, and if an image can
    no longer be read.
    """
    check_rrd(path)
    rr: Any = import_module("rerun")
    session = calibration.session
    stream = rr.RecordingStream(RERUN_APPLICATION)
    with staged_file(path) as part:
        stream.save(part, default_blueprint=_blueprint(session.station_names))
        stream.send_recording_name(resolved(session.folder).name)
        for one in recorded(calibration):
            what = _archetype(rr, one)
            if one.at is not None:
                stream.set_time(RERUN_TIMELINE, sequence=one.at)
            stream.log(list(one.path), what, static=one.at is None)
        stream.disconnect()  # waits for the file


def _archetype(rr: Any, one: Logged) -> Any:
    """Archetype of rerun for a record."""
    v = one.values
    match one.kind:
        case "world":
            return rr.ViewCoordinates.RIGHT_HAND_Z_UP
        case "transform":
            return rr.Transform3D(translation=v["T"][:3, 3], mat3x3=v["T"][:3, :3])
        case "pinhole":
            return rr.Pinhole(
                image_from_camera=v["k"], resolution=v["size"], camera_xyz=rr.ViewCoordinates.RDF
            )
        case "photograph":
            return rr.EncodedImage(contents=v["jpeg"], media_type="image/jpeg")
        case "lines2d":
            return rr.LineStrips2D(
                v["strips"], colors=v["colours"], labels=v["labels"], show_labels=False
            )
        case "lines3d":
            return rr.LineStrips3D(
                v["strips"],
                radii=v["radii"],
                colors=v["colours"],
                labels=v["labels"],
                show_labels=False,
            )
        case "points3d":
            return rr.Points3D(
                v["points"], labels=v["labels"], colors=v["colour"], show_labels=False
            )
        case "numbers":
            return rr.Scalars(v["value"])
        case "text":
            return rr.TextDocument(v["text"], media_type="text/markdown")
        case "clear":
            return rr.Clear(recursive=True)


def _blueprint(stations: tuple[str, ...]) -> Any:
    """Layout: the machine in space beside the images, with residuals and texts below these."""
    rr: Any = import_module("rerun")
    rrb: Any = import_module("rerun.blueprint")
    images = [
        rrb.Spatial2DView(
            origin=rr.new_entity_path(["machine", "cameras", name, "image"]), name=name
        )
        for name in stations
    ]
    beside = rrb.Grid if len(stations) <= STATIONS_SIDE_BY_SIDE else rrb.Tabs
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="/machine", name="Machine"),
            rrb.Vertical(
                beside(*images) if images else rrb.TextDocumentView(),
                rrb.TimeSeriesView(origin="/residuals", name="Residuals, standard deviations"),
                rrb.Tabs(
                    rrb.TextDocumentView(origin="/result/summary", name="Result"),
                    rrb.TextDocumentView(origin="/result/parameters", name="Parameters"),
                    rrb.TextDocumentView(origin="/result/configuration", name="Configuration"),
                    rrb.TimeSeriesView(origin="/readings", name="Readings"),
                ),
            ),
        ),
        rrb.TimePanel(timeline=RERUN_TIMELINE),
        collapse_panels=True,
    )
