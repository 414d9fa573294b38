"""Calibration as a sequence of records for a viewer, configuration after configuration.

Independent of the viewer; :mod:`pkmcal.report.rrd` writes the records for rerun.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import apply, inverse
from pkmcal.identify.centres import Centres
from pkmcal.identify.tool import centres_and_tool
from pkmcal.mechanisms import Machine
from pkmcal.observe.images import decode
from pkmcal.pages.jpegs import coded
from pkmcal.pages.overlays import INLIER_WEIGHT, edge_name, machine_laid_over, residual_words
from pkmcal.report import poses
from pkmcal.report.parameters import PARAMETER_SOURCES
from pkmcal.report.pictures import edge_curves
from pkmcal.report.residuals import weighted_edge_rms
from pkmcal.session.image_files import label_of

if TYPE_CHECKING:
    from pkmcal.calibration.calibrate import Calibration

LoggedKind = Literal[
    "world", "transform", "pinhole", "photograph", "lines2d", "lines3d", "points3d",
    "numbers", "text", "clear",
]  # fmt: skip
VIEWER_PIXEL_CORNER = 0.5
"""Offset of viewers' pixels, px: pixel centres are integers here, first pixels' corners there."""
RECORDING_JPEG_QUALITY = 85
RECORDED_LEG_COLOURS = (
    (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66),
    (0, 114, 178), (213, 94, 0), (204, 121, 167), (140, 140, 140),
)  # fmt: skip
"""Colours of legs that are distinct with any colour vision (Okabe and Ito)."""
RECORDED_GREY, RECORDED_WHITE = (150, 150, 150), (255, 255, 255)
TUBELESS_LEG_RADIUS = 0.002
"""Radius of legs without tubes, m."""


class Logged(NamedTuple):
    """Record.

    path : names from the root.
    values : by the kind's own names; lengths in m, pixels counted from the image's corner.
    at : configuration, from 1; None for all.
    """

    path: tuple[str, ...]
    kind: LoggedKind
    values: dict[str, Any]
    at: int | None = None


def recorded(calibration: Calibration) -> Iterator[Logged]:
    """Records of a calibration, in the order of time.

    Raises InputError if an image can no longer be read.
    """
    centres, _ = centres_and_tool(
        calibration.session.machine, calibration.estimate, calibration.session.joints
    )
    yield Logged(("machine",), "world", {})
    yield from _result(calibration)
    yield from _stations(calibration)
    for k in range(len(calibration.session.configurations)):
        yield from _configuration(calibration, centres, k)


def _result(c: Calibration) -> Iterator[Logged]:
    """Records of verdict and parameters."""
    yield Logged(("result", "summary"), "text", {"text": f"```\n{c.summary()}\n```"})
    rows = [
        "| parameter | unit | nominal model | value | σ | decided by |",
        "|---|---|---|---|---|---|",
    ]
    rows += [
        f"| {p.name} | {p.unit} | {p.drawing:.7g} | {p.value:.7g} | {p.sigma:.2g}"
        f" | {PARAMETER_SOURCES[p.decided_by][0]} |"
        for p in c.parameters
    ]
    yield Logged(("result", "parameters"), "text", {"text": "\n".join(rows)})


def _stations(c: Calibration) -> Iterator[Logged]:
    """Records of the cameras' poses, and of pinhole intrinsics."""
    for s, station in enumerate(c.session.stations):
        T_base_camera = inverse(c.estimate.state.T_camera_base[s])
        at = ("machine", "cameras", station.name)
        yield Logged(at, "transform", {"T": T_base_camera})
        camera = station.camera
        if camera.model == "pinhole":
            fx, fy, cx, cy = camera.parameters[:4]
            k = np.array(
                [[fx, 0, cx + VIEWER_PIXEL_CORNER], [0, fy, cy + VIEWER_PIXEL_CORNER], [0, 0, 1]]
            )
            yield Logged((*at, "image"), "pinhole", {"k": k, "size": camera.image_size})


def _configuration(c: Calibration, centres: tuple[Centres, ...], k: int) -> Iterator[Logged]:
    """Records of one configuration; what it lacks is cleared, or the previous one's would stay."""
    at, session, estimate = k + 1, c.session, c.estimate
    name = session.configurations[k]
    yield Logged(("result", "configuration"), "text", {"text": f"## {name}"}, at)
    for j, reading in enumerate(session.joints[k].tolist()):
        yield Logged(("readings", f"joint{j + 1}"), "numbers", {"value": reading}, at)
    if estimate.configurations[k]:
        yield from _machine(c, centres, k)
        for j, off in enumerate(estimate.joint_residuals[k].tolist()):
            path = ("residuals", "readings", f"joint{j + 1}")
            yield Logged(path, "numbers", {"value": off}, at)
    else:
        for part in ("platform", "calibrated", "drawing", "measured"):
            yield Logged(("machine", part), "clear", {}, at)
    for s in range(len(session.stations)):
        yield from _image(c, s, k)


def _machine(c: Calibration, centres: tuple[Centres, ...], k: int) -> Iterator[Logged]:
    """Records of the calibrated machine, the nominal one aligned with it, and measured targets.

    The alignment is that of all joint centres.
    """
    at, state, joints = k + 1, c.estimate.state, c.session.joints[k]
    pose = state.T_base_platform[k]
    yield Logged(("machine", "platform"), "transform", {"T": pose}, at)
    machine = c.estimate.machine
    # nominal machine in its own frames, then moved to the calibrated base frame
    base, platform = (side.T_calibrated_nominal for side in centres)
    old = inverse(base) @ pose @ platform
    for name, of, T, move in (
        ("calibrated", machine, pose, np.eye(4)),
        ("drawing", c.session.machine, old, base),
    ):
        strips, radii, legs = _tubes(of, joints, T)
        strips = [apply(move, strip) for strip in strips]
        colours = [
            RECORDED_LEG_COLOURS[j % len(RECORDED_LEG_COLOURS)]
            if name == "calibrated"
            else RECORDED_GREY
            for j in legs
        ]
        lines = {"strips": strips, "radii": radii, "colours": colours}
        labels = [f"leg {j + 1}" for j in legs]
        yield Logged(("machine", name), "lines3d", {**lines, "labels": labels}, at)
    ends = machine.ends_at(joints, pose)
    points = np.concatenate([ends.a, ends.b])
    labels = [f"leg {j + 1}, {e}" for e in ("base", "platform") for j in range(machine.n_legs)]
    path = ("machine", "calibrated", "centres")
    yield Logged(
        path, "points3d", {"points": points, "labels": labels, "colour": RECORDED_WHITE}, at
    )
    if len(c.observation.poses):
        points, configuration = poses.target_places(c.observation, c.estimate)
        points = points[configuration == k]
        targets = {"points": points, "labels": list[str](), "colour": RECORDED_LEG_COLOURS[0]}
        yield Logged(("machine", "measured"), "points3d", targets, at)


def _tubes(
    machine: Machine, joints: Array, T_base_platform: Array
) -> tuple[list[Array], list[float], list[int]]:
    """Axes (2, 3), m, radii, and legs (from 0) of all tubes; thin lines for legs without tubes."""
    ends = machine.ends_at(joints, T_base_platform)
    strips, radii, legs = list[Array](), list[float](), list[int]()
    for j, reference in enumerate(machine.radii()):
        line = ends.b[j] - ends.a[j]
        length = float(np.linalg.norm(line))
        for radius, tube in zip(reference, machine.document.legs[j].tubes, strict=True):
            share = np.array([tube.start, min(tube.stop, length)]) / length
            strips.append(ends.a[j] + share[:, None] * line)
            radii.append(float(radius))
            legs.append(j)
        if not len(reference):
            strips.append(np.stack([ends.a[j], ends.b[j]]))
            radii.append(TUBELESS_LEG_RADIUS)
            legs.append(j)
    return strips, radii, legs


def _image(c: Calibration, s: int, k: int) -> Iterator[Logged]:
    """Records of a station's image with its edges, and of the calibrated machine's contour."""
    at, session, estimate = k + 1, c.session, c.estimate
    station = session.stations[s]
    path = ("machine", "cameras", station.name, "image")
    photo = next((p for p in station.images if p.configuration == k), None)
    if photo is None:
        # a black image, because rerun's viewer still shows an encoded image after it was cleared
        # (its issue 12793)
        width, height = station.camera.image_size
        black = coded(np.zeros((height, width)), RECORDING_JPEG_QUALITY)
        yield Logged((*path, "photograph"), "photograph", {"jpeg": black}, at)
        for part in ("edges", "aside", "contour"):
            yield Logged((*path, part), "clear", {}, at)
        return
    label = label_of(session.folder, photo.path)
    grey = decode(photo.path, station.camera.image_size, label)
    yield Logged(
        (*path, "photograph"), "photograph", {"jpeg": coded(grey, RECORDING_JPEG_QUALITY)}, at
    )
    edges = c.observation.edges
    mine = np.flatnonzero((edges.station == s) & (edges.configuration == k))
    curves = edge_curves(c, mine, s)
    used = estimate.edge_weights[mine] >= INLIER_WEIGHT
    for part, chosen in (("edges", used), ("aside", ~used)):
        rows = np.flatnonzero(chosen)
        strips = [
            curves[n][np.isfinite(curves[n]).all(axis=-1)] + VIEWER_PIXEL_CORNER for n in rows
        ]
        own = edges.select(mine[rows])
        logged = {
            "strips": strips,
            "colours": [
                RECORDED_LEG_COLOURS[j % len(RECORDED_LEG_COLOURS)]
                if part == "edges"
                else RECORDED_GREY
                for j in own.leg
            ],
            "labels": [_tip(c, int(n)) for n in mine[rows]],
        }
        yield Logged((*path, part), "lines2d", logged, at)
    if estimate.configurations[k]:
        contour, _ = machine_laid_over(
            estimate.machine,
            station.camera,
            estimate.state.T_camera_base[s],
            session.joints[k],
            estimate.state.T_base_platform[k],
        )
        strips = [np.array(edge.points) + VIEWER_PIXEL_CORNER for edge in contour]
        labels = [edge.tip for edge in contour]
        logged = {"strips": strips, "colours": [RECORDED_WHITE] * len(strips), "labels": labels}
        yield Logged((*path, "contour"), "lines2d", logged, at)
    if len(mine):
        level = weighted_edge_rms(estimate.edge_residuals[mine], estimate.edge_weights[mine])
        yield Logged(("residuals", "edges", station.name), "numbers", {"value": level}, at)


def _tip(c: Calibration, n: int) -> str:
    """Edge with its residuals, in words."""
    edges, estimate = c.observation.edges, c.estimate
    name = edge_name(int(edges.leg[n]), int(edges.tube[n]), int(edges.side[n]))
    shift, tilt = estimate.edge_residuals[n].tolist()
    return f"{name}: {residual_words(shift, tilt, float(estimate.edge_weights[n]))}"
