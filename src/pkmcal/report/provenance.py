"""How the result was made: settings, solver, versions, times, and where the cameras stood."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import inverse, pose_difference, skew
from pkmcal.identify.problem import Estimate
from pkmcal.session.load import Session
from pkmcal.wording import brief, count, decimals, number

OPEN = 1e3
"""mm; a place that is known no better is not told by the data."""
PACKAGES = ("numpy", "scipy", "opencv-contrib-python-headless")


@dataclass(frozen=True)
class StationRow:
    """A camera's pose. position, sigma : three texts each (mm, base frame). turn_sigma : degrees.

    moved : distance and angle from the pose that was given by hand, empty without one.
    edge_shift : px outward with its standard deviation.
    """

    name: str
    camera_file: str
    model: str
    photographs: int
    position: tuple[str, str, str]
    sigma: tuple[str, str, str]
    turn_sigma: str
    moved: str
    edge_shift: str


def station_rows(session: Session, estimate: Estimate, camera: Integers) -> tuple[StationRow, ...]:
    """One row a station; camera (S,) is the number of its camera file."""
    cameras = [_station(session, estimate, s, int(camera[s])) for s in range(len(session.stations))]
    first = len(cameras)
    trackers = [_tracker(session, estimate, first + t) for t in range(len(session.trackers))]
    return tuple(cameras + trackers)


def _tracker(session: Session, estimate: Estimate, s: int) -> StationRow:
    table = session.trackers[s - len(session.stations)]
    position, sigma, turn = _place(estimate, s)
    rows = len(table.configuration)
    return StationRow(
        table.name, table.label, f"tracker, {table.kind}", rows, position, sigma, turn, "", "–"
    )


def _place(estimate: Estimate, s: int) -> tuple[tuple[str, str, str], tuple[str, str, str], str]:
    """A station's place and deviations (mm), and the deviation of its turn (degrees)."""
    found, covariance = estimate.state.T_camera_base[s], estimate.station_covariance[s]
    place = inverse(found)[:3, 3] * 1e3
    sigma = np.sqrt(np.diag(camera_position_covariance(found, covariance))) * 1e3
    turn = np.rad2deg(np.sqrt(np.trace(covariance[:3, :3]) / 3))
    known = sigma < OPEN
    x, y, z = (number(v, decimals(float(d))) for v, d in zip(place, sigma, strict=True))
    sx, sy, sz = (brief(float(d)) if k else "open" for d, k in zip(sigma, known, strict=True))
    return (x, y, z), (sx, sy, sz), brief(float(turn)) if turn < 90 else "open"


def camera_position_covariance(T_camera_base: Array, covariance: Array) -> Array:
    """Covariance (3, 3) of the camera's place in the base frame, m^2.

    covariance : (6, 6) of (omega, tau), left perturbation of T_camera_base. With c = -R^T t,
    dc = -R^T [t]x omega - R^T tau.
    """
    rot_t, t = T_camera_base[:3, :3].T, T_camera_base[:3, 3]
    jacobian = np.concatenate([-rot_t @ skew(t), -rot_t], axis=-1)
    return jacobian @ covariance @ jacobian.T


def _station(session: Session, estimate: Estimate, s: int, camera: int) -> StationRow:
    station = session.stations[s]
    found = estimate.state.T_camera_base[s]
    position, sigma, turn = _place(estimate, s)
    shift, shift_sigma = estimate.state.edge_shift[camera], estimate.edge_shift_sigma[camera]
    places = decimals(float(shift_sigma))
    return StationRow(
        name=station.name,
        camera_file=station.camera_file,
        model=station.camera.model,
        photographs=len(station.photographs),
        position=position,
        sigma=sigma,
        turn_sigma=turn,
        moved=_moved(station.T_camera_base, found),
        edge_shift=f"{number(shift, places, signed=True)} ± {number(shift_sigma, places)}",
    )


def _moved(rough: Array | None, found: Array) -> str:
    if rough is None:
        return ""
    turn = np.rad2deg(np.linalg.norm(pose_difference(found, rough)[:3]))
    way = np.linalg.norm(inverse(found)[:3, 3] - inverse(rough)[:3, 3]) * 1e3
    return f"{number(float(way), 0)} mm, {number(float(turn), 1)}°"


def settings(session: Session, estimate: Estimate) -> tuple[tuple[str, str], ...]:
    """(what, value) of everything that the result depends on besides the photographs."""
    s = estimate.statistics
    tolerance = session.machine.document.tolerance
    return (
        ("Session", session.folder.name),
        ("Machine", f"{session.machine.name}, {count(session.machine.n_legs, 'leg')}"),
        ("Frames", estimate.gauge),
        ("Noise of a joint reading", f"{session.joint_noise:.3g} m or rad"),
        (
            "Drawing's tolerances, 1σ",
            f"centres {tolerance.center * 1e3:g} mm, offsets {tolerance.offset * 1e3:g} mm, "
            f"radii {tolerance.radius * 1e3:g} mm",
        ),
        ("Solver", f"{count(s.steps, 'step')}; {s.stopped}"),
        *(
            (f"χ² of the {name}", f"{number(chi2, 0)} over {number(n, 0)} numbers{_left(freedom)}")
            for name, chi2, n, freedom in (
                ("edges", s.chi2_edges, s.n_edges, s.dof_edges),
                ("poses", s.chi2_poses, s.n_poses, s.dof_poses),
                ("readings", s.chi2_joints, s.n_joints, s.dof_joints),
                ("drawing", s.chi2_drawing, s.n_drawing, 0.0),
            )
            if n
        ),
        *(
            (f"Factor on the {name}' stated noise", number(scale, 2))
            for name, scale, n in (
                ("edges", s.noise_scale, s.n_edges),
                ("poses", s.pose_scale, s.n_poses),
            )
            if n
        ),
    )


def _left(freedom: float) -> str:
    """Degrees of freedom that the numbers leave, where they were counted."""
    return f", {number(freedom, 0)} degrees of freedom" if freedom >= 0.5 else ""


def versions() -> tuple[tuple[str, str], ...]:
    """(package, version); a package that is there without metadata has none."""
    from pkmcal import __version__

    found = [("pkmcal", __version__), ("Python", platform.python_version())]
    for name in PACKAGES:
        try:
            found.append((name, metadata.version(name)))
        except metadata.PackageNotFoundError:
            continue
    return tuple(found)


def durations(timings: Mapping[str, float] | None) -> tuple[tuple[str, str], ...]:
    """(step, seconds) in the given order."""
    return tuple((name, f"{value:.2f} s") for name, value in (timings or {}).items())
