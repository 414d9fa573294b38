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
from pkmcal.report.wording import brief, count, decimals, number
from pkmcal.session import Session

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
    return tuple(
        _station(session, estimate, s, int(camera[s])) for s in range(len(session.stations))
    )


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
    covariance = estimate.station_covariance[s]
    place = inverse(found)[:3, 3] * 1e3
    sigma = np.sqrt(np.diag(camera_position_covariance(found, covariance))) * 1e3
    turn = np.rad2deg(np.sqrt(np.trace(covariance[:3, :3]) / 3))
    shift, shift_sigma = estimate.state.edge_shift[camera], estimate.edge_shift_sigma[camera]
    places = decimals(float(shift_sigma))
    x, y, z = (number(v, decimals(float(d))) for v, d in zip(place, sigma, strict=True))
    sx, sy, sz = (brief(float(d)) for d in sigma)
    return StationRow(
        name=station.name,
        camera_file=station.camera_file,
        model=station.camera.model,
        photographs=len(station.photographs),
        position=(x, y, z),
        sigma=(sx, sy, sz),
        turn_sigma=brief(float(turn)),
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
        ("χ² of the edges", f"{number(s.chi2_edges, 0)} over {number(s.n_edges, 0)} numbers"),
        ("χ² of the readings", f"{number(s.chi2_joints, 0)} over {number(s.n_joints, 0)}"),
        ("χ² of the drawing", f"{number(s.chi2_drawing, 0)} over {number(s.n_drawing, 0)}"),
        ("Factor on the edges' stated noise", number(s.noise_scale, 2)),
    )


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
