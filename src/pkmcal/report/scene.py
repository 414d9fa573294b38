"""Report section on the machine in space: its cameras, poses, joint centres and their change."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.calibration.toolmap import ToolMap
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import inverse
from pkmcal.identify.centres import Centres
from pkmcal.identify.estimate import Estimate
from pkmcal.outcome import Part
from pkmcal.outcome.blocks.base import configuration_key
from pkmcal.outcome.blocks.space import Space, SpaceArrows, SpacePoints
from pkmcal.outcome.blocks.text import Hint
from pkmcal.report.space import (
    ELLIPSOID_SIGMAS,
    changes,
    chosen,
    ellipsoids,
    small_vector,
    space_points,
    space_poses,
    start_enlargements,
)
from pkmcal.session.load import Session
from pkmcal.web.motion import Postures
from pkmcal.web.stage import extent_of, leg_rows, line, machine_shape
from pkmcal.wording import brief, count

MOST_SLIDER_POSES = 90
"""Poses of the slider; more would make the page large and the slider too fine for a finger."""


def section(
    session: Session,
    estimate: Estimate,
    centres: tuple[Centres, ...],
    targets: tuple[Array, Integers],
    tool_map: ToolMap | str | None,
    most: int = MOST_SLIDER_POSES,
) -> Part | None:
    """Section of the report; None if no pose was estimated.

    targets : measured targets (N, 3), base frame, m, and their configurations (N,).
    most : largest number of poses of the slider.
    """
    machine, state, names = estimate.machine, estimate.state, session.configurations
    used = np.flatnonzero(estimate.configurations)
    if not len(used):
        return None
    some = used[chosen(len(used), most)]
    postures = Postures(session.joints[some], state.T_base_platform[some])
    first = Postures(*(part[:1] for part in postures))
    sigma = np.sqrt(np.diag(estimate.covariance))
    arrows = () if tool_map is None or isinstance(tool_map, str) else (tool_arrows(tool_map),)
    change, spread = start_enlargements(extent_of(machine, first), centres)
    block = Space(
        title="",
        caption="True to scale, except for the change of the joint centres from the nominal model"
        f" (blue) and their {ELLIPSOID_SIGMAS:g}σ ellipsoids, which are enlarged.",
        alt="The calibrated machine in three dimensions with"
        + (" its tubes, the fields of view of its cameras," if session.stations else "")
        + " the measured poses, and the joint centres of the nominal model.",
        machine=machine_shape(
            machine,
            leg_rows(machine, sigma),
            station_cameras(session, estimate),
            first,
        ),
        poses=space_poses(machine, postures, [names[k] for k in some], configuration_key),
        names=("Nominal model", "Calibrated"),
        changes=changes(session.machine, machine, postures, centres),
        ellipsoids=ellipsoids(centres),
        sigmas=ELLIPSOID_SIGMAS,
        enlargement=change,
        ellipsoid_enlargement=spread,
        points=_points(session, estimate, targets),
        arrows=arrows,
    )
    fewer = f" of {len(used)}, evenly chosen" if len(some) < len(used) else ""
    hint = Hint(
        text=f"The slider takes the machine through {count(len(some), 'pose')}{fewer};"
        + (" a click on a pose's point leads to its images, and" if session.stations else "")
        + " the space bar changes between nominal model and result."
    )
    return Part("geometry", "The machine in space", blocks=(block, hint), menu="Geometry")


def station_cameras(session: Session, estimate: Estimate) -> dict[str, tuple[Camera, Array]]:
    """Camera and T_base_camera (4, 4) of each station, by its name."""
    T_camera_base = estimate.state.T_camera_base[: len(session.stations)]
    return {
        station.name: (station.camera, inverse(T))
        for station, T in zip(session.stations, T_camera_base, strict=True)
    }


def tool_arrows(tool_map: ToolMap) -> SpaceArrows:
    """Error of the nominal model at poses spread evenly over the workspace."""
    _, after = tool_map.evenly
    finite = np.flatnonzero(np.isfinite(after.off_position))
    off = after.off_position[finite] * 1e3
    return SpaceArrows(
        name="Nominal model's error",
        colour="--drawing",
        points=line(after.T_base_platform[finite, :3, 3], 4),
        vectors=tuple(small_vector(v) for v in after.off[finite, 3:]),
        tips=tuple(f"Nominal model's position {brief(x)} mm off" for x in off.tolist()),
        visible=False,
    )


def _points(
    session: Session, estimate: Estimate, targets: tuple[Array, Integers]
) -> tuple[SpacePoints, ...]:
    """Measured poses, and targets measured by trackers or boards."""
    used = np.flatnonzero(estimate.configurations)
    places = estimate.state.T_base_platform[used, :3, 3]
    every: list[tuple[str, str, Array, Integers]] = [
        ("Measured poses", "--calibrated", places, used)
    ]
    if len(targets[0]):
        every.append(("Measured targets", "--accent", *targets))
    out: list[SpacePoints] = []
    for name, colour, at, configuration in every:
        names = [session.configurations[k] for k in configuration]
        keys, tips = map(configuration_key, names), [f"configuration {one}" for one in names]
        out.append(space_points(name, colour, at, tuple(keys), tips))
    return tuple(out)
