"""Report sections on how the result was made: stations, settings, solver, and rejected data."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.results import base_camera_covariance
from pkmcal.files import versions
from pkmcal.geometry.rigid import inverse, pose_difference
from pkmcal.identify.edge_noise import EDGE_NOISE
from pkmcal.identify.estimate import Estimate, GroupStatistics
from pkmcal.identify.unidentified import identified
from pkmcal.levels import INSEPARABLE_CORRELATION
from pkmcal.measurements import Observation, Rejection
from pkmcal.measurements.effects import EDGE_SHIFT
from pkmcal.observe.overlays import EDGE_SIDE_NAMES
from pkmcal.outcome import Part, Row, Table
from pkmcal.outcome.blocks.base import station_key
from pkmcal.outcome.blocks.text import Fact, Facts, Listing, Paragraph
from pkmcal.report import parameters
from pkmcal.session.load import Session
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.wording import amount, brief, capital, count, decimals, number

if TYPE_CHECKING:
    from pkmcal.calibration.calibrate import Calibration
    from pkmcal.mechanisms.document import NominalTolerance

TOLERANCES_NAME = "Nominal model's tolerances, 1σ"
READING_NOISE_NAME = "Noise of a joint reading"
SIGMA_MEANING_TEXT = (
    "What σ means here: the standard deviations are those with which the result"
    " would scatter if the same measurements were taken again. They contain the noise of the"
    " measurement, and of what the model leaves out (legs that bend, joints with play, a lens that"
    " its file does not describe, an uneven bed) what these data show. Measurements that the"
    " calibration has not used are the test for the rest."
)
MOST_CASES = 400
"""Cases listed for one reason; calibration.json has all of them."""


def used_images(session: Session, observation: Observation, estimate: Estimate) -> tuple[int, ...]:
    """Number of images of each station that are in use.

    An image is in use if its board's pose is an inlier, or at least half of its edges are.
    Held-out images are not.
    """
    in_use = set[tuple[int, int]]()
    for item, weights in (
        (observation.edges, estimate.edge_weights),
        (observation.poses, estimate.pose_weights),
    ):
        pairs = np.stack([item.station, item.configuration], axis=1)
        # inliers among the measurements of each station and configuration
        pairs, own = np.unique(pairs, axis=0, return_inverse=True)
        inliers = np.bincount(own.ravel(), weights >= INLIER_WEIGHT, len(pairs))
        most = 2 * inliers >= np.bincount(own.ravel(), minlength=len(pairs))
        in_use |= {(s, c) for s, c in pairs[most].tolist()}
    return tuple(
        sum((s, photo.configuration) in in_use for photo in station.images)
        for s, station in enumerate(session.stations)
    )


def stations(session: Session, observation: Observation, estimate: Estimate) -> Part | None:
    """Section with a row for each station that has a pose; None without any."""
    camera = session.camera_of_station
    edges = len(estimate.edge_weights) > 0
    rows: list[Row] = []
    used = used_images(session, observation, estimate)
    for s, station in enumerate(session.stations):
        taken = len(station.images)
        images = count(taken, "image")
        if used[s] < taken:
            images = f"{used[s]} of {images} in use"
        # edge shifts are estimated in binned pixels
        pixels = int(observation.binning[s])
        shift = float(estimate.state.columns[EDGE_SHIFT][camera[s]]) * pixels
        sigma = float(estimate.column_sigma(EDGE_SHIFT)[camera[s]]) * pixels
        if pixels > 1:
            images += f", {pixels} × {pixels} pixels as one"
        places = decimals(sigma)
        cells = (
            *_pose_cells(estimate, s),
            *([f"{number(shift, places, signed=True)} ± {number(sigma, places)}"] if edges else []),
            _distance_cell(station.T_camera_base, estimate.state.T_camera_base[s]),
            f"{station.camera_file}, {station.camera.model}, {images}",
        )
        rows.append(Row(station.name, cells, key=station_key(station.name)))
    # trackers come after the cameras' stations
    for s, table in enumerate(session.trackers, start=len(session.stations)):
        if table.kind == "heights":  # a probe is on the tool
            continue
        what = f"{table.label}, tracker, {table.kind}, {count(len(table.configuration), 'row')}"
        rows.append(
            Row(
                table.name,
                (*_pose_cells(estimate, s), *(["–"] if edges else []), "–", what),
                key=station_key(table.name),
            )
        )
    if not rows:
        return None
    columns = ("Station", "x, mm", "y, mm", "z, mm", "σ of orientation")
    columns += ("Edge shift, px",) if edges else ()
    what = "Camera" if session.stations else "Tracker"
    columns += ("From the pose by hand", what)
    title = f"Where the {what.lower()}s stood"
    table = Table(title, columns, tuple(rows), brief=False, words=(len(columns) - 1,))
    return Part("stations", f"{what}s", tables=(table,))


def _pose_cells(estimate: Estimate, s: int) -> tuple[str, str, str, str]:
    """Position of a station with standard deviations (mm), and that of its orientation (degrees).

    Open where the data do not determine them.
    """
    T_camera_base, covariance = estimate.state.T_camera_base[s], estimate.station_covariance[s]
    place = inverse(T_camera_base)[:3, 3] * 1e3
    covariance = base_camera_covariance(T_camera_base, covariance)
    determined = identified(estimate.machine, covariance)
    # rounding may leave a negative variance
    sigma = 1e3 * np.sqrt(np.maximum(np.diag(covariance)[3:], 0.0))
    turn = float(np.sqrt(np.trace(covariance[:3, :3]) / 3))
    x, y, z = (
        f"{number(v, decimals(d))} ± {brief(d)}" if sure else "open"
        for v, d, sure in zip(place.tolist(), sigma.tolist(), determined[3:], strict=True)
    )
    return x, y, z, amount(turn, "rad") if determined[:3].all() else "open"


def _distance_cell(rough: Array | None, estimated: Array) -> str:
    """Distance and angle of the estimated pose from the one by hand."""
    if rough is None:
        return "–"
    turn = np.rad2deg(np.linalg.norm(pose_difference(estimated, rough)[:3]))
    distance = np.linalg.norm(inverse(estimated)[:3, 3] - inverse(rough)[:3, 3]) * 1e3
    return f"{number(float(distance), 0)} mm, {number(float(turn), 1)}°"


def how(session: Session, estimate: Estimate, timings: Mapping[str, float]) -> Part:
    """Section on settings, solver and versions.

    timings : seconds by step.
    """
    lists = (
        ("Settings and solver", _settings(session, estimate)),
        ("Time", [(name, f"{seconds:.2f} s") for name, seconds in timings.items()]),
        ("Versions", versions().items()),
    )
    blocks = tuple(
        Facts(title=title, facts=tuple(Fact(name=name, value=value) for name, value in pairs))
        for title, pairs in lists
        if pairs
    )
    return Part("how", "How it was computed", (SIGMA_MEANING_TEXT,), blocks=blocks)


def certificate(calibration: Calibration, digest: str) -> tuple[tuple[str, str], ...]:
    """Pairs (name, value) for the first printed page: machine, data, tolerances, instruments."""
    session, tolerance = calibration.session, calibration.session.machine.document.tolerance
    cameras = tuple(
        (
            f"Camera, station {station.name}",
            f"{station.camera_file}, {station.camera.model}, {count(len(station.images), 'image')}",
        )
        for station in session.stations
    )
    trackers = tuple(
        (f"Tracker {table.name}", f"{table.kind}, {count(len(table.configuration), 'row')}")
        for table in session.trackers
    )
    every = (
        ("Machine", f"{session.machine.name}, {count(session.machine.n_legs, 'leg')}"),
        ("Session", session.folder.name),
        ("Digest of the session", digest),
        ("Method", calibration.method),
        ("Configurations", str(int(np.sum(calibration.estimate.configurations)))),
        (TOLERANCES_NAME, _tolerances(tolerance)),
        (READING_NOISE_NAME, _reading_noise(session)),
        *cameras,
        *trackers,
    )
    return tuple((name, value) for name, value in every if value)


def _settings(session: Session, estimate: Estimate) -> tuple[tuple[str, str], ...]:
    """Pairs (name, value) of all that the result depends on besides the images."""
    s = estimate.statistics
    tolerance = session.machine.document.tolerance
    noise = estimate.edge_noise
    tubes = zip(noise.scale, noise.shading, noise.dof, strict=True)
    groups = [one._replace(name=group_label(session, one.name)) for one in s.groups]
    nominal = GroupStatistics("nominal model", 1.0, s.chi2_drawing, s.n_drawing, 0.0, None, None)
    return (
        ("Session", session.folder.name),
        ("Machine", f"{session.machine.name}, {count(session.machine.n_legs, 'leg')}"),
        ("Frames", estimate.gauge),
        (READING_NOISE_NAME, _reading_noise(session)),
        (TOLERANCES_NAME, _tolerances(tolerance)),
        ("Solver", f"{count(s.steps, 'step')}; {s.stopped}"),
        *(
            (
                f"χ² of the {one.name}",
                f"{number(one.chi2, 0)} over {number(one.n, 0)} numbers"
                # redundancy of the kind, where it was counted
                + (f", {count(round(one.dof), 'degree')} of freedom" if one.dof >= 0.5 else ""),
            )
            for one in (*groups, nominal)
            if one.n
        ),
        *(
            (f"Factor on the {one.name}' stated noise", number(one.scale, 2))
            for one in groups
            if one.n
        ),
        *(
            (
                f"Edges of tube {k}",
                f"{number(scale, 2)} times the stated noise, and {number(shading, 3)} px by shading"
                + (
                    f"; tails as of {tails:g} degrees of freedom"
                    if tails < EDGE_NOISE.tails[-1]
                    else ""
                ),
            )
            for k, (scale, shading, tails) in enumerate(tubes, start=1)
            if s.n_edges
        ),
        *(
            (
                f"What the data allow of the {one.name}' stated noise",
                f"{brief(low) if low else '0'} to {'any' if high is None else brief(high)} times",
            )
            for one in groups
            if one.n and one.noise_range
            for low, high in [one.noise_range]
        ),
    )


def _reading_noise(session: Session) -> str:
    """Standard deviation of a reading, once for each unit of the joints."""
    units = dict.fromkeys(session.machine.joint_units)
    return " or ".join(amount(session.joint_noise, unit) for unit in units)


def _tolerances(tolerance: NominalTolerance) -> str:
    """Prior sigmas of the nominal model in words."""
    return (
        f"centres {tolerance.center * 1e3:g} mm, offsets {tolerance.offset * 1e3:g} mm, "
        f"radii {tolerance.radius * 1e3:g} mm"
    )


def group_label(session: Session, rows: str) -> str:
    """Kinds of measurements in a group of rows, in the plural; the group's name for readings."""
    return " and ".join(session.labels.get(rows, [rows]))


@dataclass(frozen=True)
class Reason:
    """Reason of rejections.

    count : number of rejections.
    images : number of images concerned.
    cases : (image, rejected part) of the first of them.
    """

    text: str
    count: int
    images: int
    cases: tuple[tuple[str, str], ...]

    @property
    def unlisted(self) -> int:
        """Number of rejections that the list leaves out."""
        return self.count - len(self.cases)


def left_out(session: Session, rejected: tuple[Rejection, ...], estimate: Estimate) -> Part:
    """Section on rejections, and on tightly correlated parameters."""
    lists = tuple(
        Listing(
            title=f"{capital(reason.text)}: {reason.count}, in {count(reason.images, 'image')}",
            items=(
                *(f"{image}: {what}" for image, what in reason.cases),
                *(
                    (f"and {reason.unlisted} more, all of them in calibration.json",)
                    if reason.unlisted
                    else ()
                ),
            ),
            folded=True,
        )
        for reason in reasons(session, rejected)
    )
    pairs = parameters.bound_together(estimate)
    together = (
        Listing(title="Correlated values", items=pairs)
        if pairs
        else Paragraph(
            text="No two values have a correlation of more than"
            f" {INSEPARABLE_CORRELATION:.2f}, so the data distinguish all of them."
        )
    )
    text = () if lists else ("Nothing was rejected.",)
    title = "Rejected measurements and correlated values"
    return Part("rejected", title, text, blocks=(*lists, together), menu="Rejected")


def reasons(session: Session, rejected: tuple[Rejection, ...]) -> tuple[Reason, ...]:
    """Rejections grouped by reason, the most frequent first.

    Reasons that differ in numbers are one.
    """
    groups: dict[str, list[Rejection]] = {}
    for item in rejected:
        kind = re.sub(r"[-+−]?\d+(\.\d+)?([eE][-+]?\d+)?", "…", item.reason)
        groups.setdefault(kind, []).append(item)
    ordered = sorted(groups.items(), key=lambda pair: -len(pair[1]))
    return tuple(_reason(session, text, items) for text, items in ordered)


def _reason(session: Session, text: str, items: list[Rejection]) -> Reason:
    """Group of rejections."""
    same = len({item.reason for item in items}) == 1
    stations, configurations = session.station_names, session.configurations
    return Reason(
        text=items[0].reason if same else text,
        count=len(items),
        images=len({(i.station, i.configuration) for i in items}),
        cases=tuple(
            (
                f"{stations[i.station]} / {configurations[i.configuration]}",
                _rejected_part(i) if same else f"{_rejected_part(i)}: {i.reason}",
            )
            for number, i in enumerate(items)
            if number < MOST_CASES or i.leg < 0  # whole images and boards are always listed
        ),
    )


def _rejected_part(item: Rejection) -> str:
    """Rejected part in words; -1 stands for all."""
    if item.leg < 0:
        return "board" if item.reason.startswith("the board") else "whole image"
    words = [f"leg {item.leg + 1}"]
    if item.tube >= 0:
        words.append(f"tube {item.tube + 1}")
    if item.side >= 0:
        words.append(EDGE_SIDE_NAMES[item.side])
    return " ".join(words)
