"""Report section on a measurement plan in space: configurations by station, and the cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import inverse
from pkmcal.outcome import Part
from pkmcal.outcome.blocks.base import configuration_key
from pkmcal.outcome.blocks.space import Space, SpacePoints
from pkmcal.outcome.blocks.text import Hint
from pkmcal.planning.plan import MeasurementPlan, TriedStation
from pkmcal.report.space import space_points, space_poses
from pkmcal.web.motion import Postures
from pkmcal.web.stage import leg_rows, machine_shape
from pkmcal.wording import brief, listed

STATION_COLOURS = ("--calibrated", "--drawing", "--good", "--warn", "--ink", "--accent")
SMALLEST_CANDIDATE = 0.5
"""Size of the point of the worst candidate, relative to the best."""


def stage_part(plan: MeasurementPlan, cameras: Sequence[tuple[str, Camera, Array]]) -> Part:
    """Section with the machine at each configuration of the plan, in its order.

    cameras : name of the station, camera, and T_camera_base.
    """
    machine = plan.subject.rig.machine
    postures = Postures(plan.joints, plan.T_base_platform)
    points = _by_station(plan)
    if plan.tried:
        points.append(_candidates(plan.tried))
    block = Space(
        title="",
        caption="The machine at a configuration; points are the platform's positions"
        + ("." if plan.subject.handheld else ", by the stations that measure them.")
        + (" The larger a camera's place, the better it is alone." if plan.tried else ""),
        alt="The machine in three dimensions at the configurations of the plan, with the cameras.",
        machine=machine_shape(
            machine,
            leg_rows(machine, None),
            {name: (camera, inverse(T)) for name, camera, T in cameras},
            Postures(*(part[:1] for part in postures)),
        ),
        poses=space_poses(machine, postures, plan.names, configuration_key),
        points=tuple(points),
    )
    hint = Hint(text="The slider takes the machine through the configurations in their order.")
    return Part("where", "In space", blocks=(block, hint))


def _by_station(plan: MeasurementPlan) -> list[SpacePoints]:
    """Platform positions, one set for each group of stations that measure together."""
    where = [f"From {listed(names, 3)}" for names in plan.stations]
    if plan.subject.handheld:  # each has its own
        where = ["In two images each"] * len(where)
    out: list[SpacePoints] = []
    for n, words in enumerate(dict.fromkeys(where)):
        rows = [k for k, own in enumerate(where) if own == words]
        names = [plan.names[k] for k in rows]
        out.append(
            space_points(
                words,
                STATION_COLOURS[n % len(STATION_COLOURS)],
                plan.T_base_platform[rows, :3, 3],
                [configuration_key(name) for name in names],
                [f"{name} ({words[0].lower()}{words[1:]})" for name in names],
            )
        )
    return out


def _candidates(tried: tuple[TriedStation, ...]) -> SpacePoints:
    """Candidate places of the camera, the larger the better alone."""
    level = np.log([one.alone for one in tried])
    worse = (level - level.min()) / (np.ptp(level) or 1.0)
    state = [", chosen" if one.chosen else "" for one in tried]
    return space_points(
        "Places tried",
        "--quiet",
        np.array([one.place.position for one in tried]),
        [""] * len(tried),
        [
            f"alone {brief(one.alone * 1e3)} mm{text}"
            for one, text in zip(tried, state, strict=True)
        ],
        np.round(1 - (1 - SMALLEST_CANDIDATE) * worse, 2).tolist(),
    )
