"""Page of one machine: its document, and the poses that the page asks for."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array
from pkmcal.cameras import Camera
from pkmcal.errors import InputError
from pkmcal.files import Schema
from pkmcal.geometry.rigid import is_rigid
from pkmcal.mechanisms import Machine
from pkmcal.outcome.blocks.base import Pose
from pkmcal.outcome.blocks.machine import Configuration
from pkmcal.outcome.blocks.machine import Machine as MachineShape
from pkmcal.web import document as shapes
from pkmcal.web import serving
from pkmcal.web.guard import Guard
from pkmcal.web.motion import Postures, home_posture, moved, sweeps
from pkmcal.web.stage import configurations, leg_rows, machine_shape, slider_ranges
from pkmcal.wording import count

SWEEP_CONFIGURATIONS = 41
"""Configurations of each reading's sweep in a page without a program behind it."""
MOTION_TEXTS = {
    "spatial": "spatial",
    "planar": "in the x-y plane with the turn about z",
    "translation": "translation",
    "schoenflies": "translation with the turn about z",
    "planar-translation": "translation in the x-y plane",
}
"""Motions of the platform in the heading."""


def machine_document(
    machine: Machine,
    *,
    origin: str,
    sigma: Array | None = None,
    cameras: Mapping[str, tuple[Camera, Array]] | None = None,
    sweeps: bool = True,
) -> shapes.MachineDocument:
    """Document of a machine with sliders for its readings.

    origin : of the machine's values, for the heading.
    sigma : (P,) standard deviations of a calibration.
    cameras : camera and T_base_camera (4, 4) by name.
    sweeps : whether each reading's sweep is computed; otherwise the page asks for poses.
    Raises InputError or GeometryError for a machine that cannot be assembled.
    """
    shape = machine_shape(machine, leg_rows(machine, sigma), cameras or {})
    redundant = machine.redundancy > 0
    return shapes.MachineDocument(
        program=f"pkmcal {version('pkmcal')}",
        title=machine.name,
        subtitle=f"{origin}. {count(machine.n_legs, 'leg')},"
        f" {count(machine.n_joints, 'reading')},"
        f" {count(machine.n_joints - machine.redundancy, 'degree')} of freedom"
        f" ({MOTION_TEXTS[machine.document.motion]}).",
        notes=_notes(machine, shape, redundant),
        machine=shape,
        sweeps=_sweeps(machine) if sweeps else None,
        redundant=redundant,
    )


def _notes(machine: Machine, shape: MachineShape, redundant: bool) -> tuple[str, ...]:
    """Sentences on what the page assumes."""
    out: list[str] = []
    if shape.home.beyond:
        names = ", ".join(shape.readings[k].name for k in shape.home.beyond)
        out.append(f"At home these readings are outside their ranges: {names}.")
    if not all(reading.stated for reading in shape.readings):
        out.append("The mechanism file gives no range for some readings; their sliders assume one.")
    if redundant:
        out.append(
            f"{count(machine.redundancy, 'reading')} more than the platform has freedoms: the"
            " other readings follow the one that changes."
        )
    return tuple(out)


def _sweeps(machine: Machine) -> tuple[shapes.Sweep, ...]:
    """Sweeps of all readings from home."""
    home = home_posture(machine)
    ranges = slider_ranges(machine, home.readings[0])
    values, postures = sweeps(machine, home, ranges, SWEEP_CONFIGURATIONS)
    closed = postures.closed
    at_closed = Postures(*(part[closed] for part in postures))
    shapes_of = iter(configurations(machine, at_closed))
    each = [next(shapes_of) if is_closed else None for is_closed in closed]
    return tuple(
        shapes.Sweep(
            values=tuple(round(float(v), 9) + 0.0 for v in row),
            configurations=tuple(each[k * row.size : (k + 1) * row.size]),
        )
        for k, row in enumerate(values)
    )


class PoseRequest(Schema):
    """Request of the page: one reading changes from a configuration that it has.

    index, value : of the reading that changes, from 0, and its new value in m or rad.
    readings, T_base_platform : of the present configuration.
    """

    index: int = Field(ge=0)
    value: float
    readings: tuple[float, ...]
    T_base_platform: Pose


class PoseAnswer(Schema):
    """Configuration after the change; null where the way to it has no pose."""

    configuration: Configuration | None


def configuration_at(machine: Machine, request: PoseRequest) -> PoseAnswer:
    """Response to a request.

    Raises InputError for readings or a pose that do not belong to the machine.
    """
    if len(request.readings) != machine.n_joints or request.index >= machine.n_joints:
        raise InputError(
            "the request belongs to another machine",
            where="the page, readings",
            found=count(len(request.readings), "reading"),
            expected=str(machine.n_joints),
        )
    posture = Postures(np.array([request.readings]), np.array([request.T_base_platform]))
    if not is_rigid(posture.T_base_platform[0]):
        raise InputError("the pose is no rotation and translation", where="the page, pose")
    low, high = slider_ranges(machine, home_posture(machine).readings[0])[request.index]
    if not low <= request.value <= high:
        raise InputError(
            "this reading is outside its range",
            where=f"the page, {machine.joint_names[request.index]}",
            found=f"{request.value:g}",
            expected=f"{low:g} to {high:g}",
        )
    after = moved(machine, posture, request.index, request.value, high - low)
    if not after.closed.all():
        return PoseAnswer(configuration=None)
    (shape,) = configurations(machine, after)
    return PoseAnswer(configuration=shape)


def application(machine: Machine, document: shapes.MachineDocument, token: str, port: int) -> Guard:
    """ASGI application: the page at /TOKEN/, its bundle, and the poses that it asks for."""
    from starlette.routing import Route

    def pose(request: PoseRequest) -> PoseAnswer:
        return configuration_at(machine, request)

    routes = [
        *serving.page_routes(lambda: document),
        Route("/pose", serving.json_endpoint(PoseRequest, pose), methods=["POST"]),
    ]
    return serving.application(routes, token, port)
