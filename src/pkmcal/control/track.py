"""Tracking of the legs from image to image: edges, lines with covariances, the pose.

Each image has one measurement pass about the pose from the readings. The edges give the legs'
lines, which the law needs, and correct the predicted pose for the next image. If the legs are not
detected there, one wide search follows; other assembly modes are tried once, while the machine is
at rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.cameras import Camera
from pkmcal.control.laws import Task
from pkmcal.control.machine_view import MachineView, directions_of, leg_ends_in_view
from pkmcal.errors import InputError
from pkmcal.geometry.cylinders import edge_normal_jacobians, line_through, tangent_basis
from pkmcal.geometry.rigid import apply, cross, dot, perturb, pose_difference, skew
from pkmcal.levels import UNEXPLAINED_SCALE
from pkmcal.measurements import EdgeSet
from pkmcal.mechanisms.closure import Closure, closure
from pkmcal.observe import profiles
from pkmcal.observe.image_batches import StationImages
from pkmcal.observe.legs import (
    StationEdges,
    measure,
    search,
)
from pkmcal.solver.kernels import cauchy_weights

SAME_ASSEMBLY_ANGLE = float(np.deg2rad(5.0))
"""Angle between a measured and a predicted leg, median over the legs, up to which the assembly mode
is the expected one: a hand-measured camera pose is right to a few degrees, other assembly modes
differ by tens of degrees. Not checked within a factor of two."""
SHADING_EDGE_SHIFT = 0.1
"""Shift of a whole edge, in pixels after binning, in addition to its own sigma: shading that the
edge model omits (docs/observation.md measures 0.14 and 0.22 px per sample)."""
LEG_ENDS_LATERAL_SIGMA = 0.1
"""Prior sigma, in metres, of a leg's ends across the leg: uninformative, but it keeps the line of a
leg with a single edge finite until that leg is rejected."""
READINGS_LAG_SIGMA = 0.001
"""Standard deviation, in metres, between a reading and the image: 50 mm/s for 20 ms between the
two. Edges determine some motions of the platform a hundred times worse than others; readings
determine those."""
LEG_EDGE_SIDES = np.array([0, 1])
LOST_EDGE_DISTANCE = 0.7
"""Median distance, in px, of edges from their prediction above which all are rejected: if legs
turned by more than that, the ends that are still within reach would pass for whole edges. Chance
matches, uniform over the profiles' reach of 1.5 px, are not excluded by it: the median of 24 such
edges is below it in 37 of 100 images. Not checked within a factor of two."""
SEARCH_ROUNDS = 3
"""Gauss-Newton steps of the pose after a search: over ten pixels the problem is not linear."""


@dataclass(frozen=True)
class LegLines:
    """Observed legs as two edges each, of the radius that the controller uses; camera frame.

    normal : (L, 2, 3) unit, NaN where the leg was not detected.
    basis : (L, 2, 3, 2) tangent bases, shift first.
    joint : (L, 4, 4) covariance in these bases, rad^2, side 0 before side 1. The edges are
        correlated, because a change of the leg's distance rotates both in opposite directions.
    agrees : (L,) whether the edges fit one leg.
    valid : (L,) whether edges of both sides were measured and agree.
    """

    normal: Array
    basis: Array
    joint: Array
    agrees: Booleans
    valid: Booleans

    @classmethod
    def nothing(cls, count: int) -> LegLines:
        """Lines of ``count`` legs that were not found."""
        normal, basis, joint = (
            np.full((count, *shape), np.nan) for shape in ((2, 3), (2, 3, 2), (4, 4))
        )
        agrees, valid = np.ones(count, dtype=bool), np.zeros(count, dtype=bool)
        return cls(normal, basis, joint, agrees, valid)


@dataclass(frozen=True)
class EdgeMisfits:
    """Misfits of an image's edges at the predicted pose; M edges of s observed legs.

    leg : (M,) index of the edge's leg among the observed ones.
    misfit : (M, 2) rotation from the predicted plane to the measured one, in the edge's basis.
    by_a, by_b : (M, 2, 3) derivatives of the predicted plane by the leg's ends, camera frame.
    information : (M, 2, 2).
    side : (M,).
    closure : closure of the machine at the predicted pose.
    a, b : (s, 3) ends of the observed legs, camera frame.
    """

    leg: Integers
    misfit: Array
    by_a: Array
    by_b: Array
    information: Array
    side: Integers
    closure: Closure
    a: Array
    b: Array

    def of_leg(self, count: int) -> Array:
        """(count, M) incidence matrix: 1 where the edge is the leg's."""
        return (self.leg == np.arange(count)[:, None]).astype(float)


def edge_misfits(
    view: MachineView, readings: Array, T_base_platform: Array, edges: EdgeSet, edge_shift: float
) -> EdgeMisfits:
    """Misfits of the seen legs' edges for the machine at a pose (4, 4) and its readings (m,).

    edge_shift : px by which all edges of the camera are shifted outward.
    """
    machine = view.machine
    c = closure(machine.layout, machine.values, readings, T_base_platform)
    a, b = (apply(view.T_camera_base, p[view.legs]) for p in (c.a, c.b))
    # edges of the seen legs
    own = edges.leg[:, None] == view.legs
    edges = edges.select(own.any(axis=1))
    leg = own[own.any(axis=1)].argmax(axis=1)
    radius = machine.radii_of(edges.leg, edges.tube)
    at = edge_normal_jacobians(a[leg], b[leg], radius, edges.side)
    to_tangent = edges.basis.mT
    # covariance with a common shift of the edge, from shading
    off = SHADING_EDGE_SHIFT * edges.shift
    covariance = edges.covariance + off[:, :, None] * off[:, None, :]
    return EdgeMisfits(
        leg=leg,
        misfit=-(to_tangent @ at.n[..., None])[..., 0] - edge_shift * edges.shift,
        by_a=to_tangent @ at.dn_da,
        by_b=to_tangent @ at.dn_db,
        information=np.linalg.inv(covariance),
        side=edges.side,
        closure=c,
        a=a,
        b=b,
    )


def leg_lines(view: MachineView, rows: EdgeMisfits) -> LegLines:
    """Lines of the seen legs from their edges.

    A leg's line has four degrees of freedom, its two ends across the leg; every edge measures two
    of them, whatever its tube's radius. One Gauss-Newton step suffices: from a prediction within
    1.5 px it leaves 1e-5 rad.
    """
    # normal equations of each leg: edges, and the prior of its ends
    count = len(view.legs)
    pick = rows.of_leg(count)
    d = rows.b - rows.a
    across = tangent_basis(d / np.sqrt(dot(d, d))[:, None], rows.a)
    e = across[rows.leg]
    jac = np.concatenate([rows.by_a @ e, rows.by_b @ e], axis=-1)
    to_right = jac.mT @ rows.information
    covariance = np.linalg.inv(
        np.tensordot(pick, to_right @ jac, 1) + np.eye(4) / LEG_ENDS_LATERAL_SIGMA**2
    )
    right = pick @ (to_right @ rows.misfit[..., None])[..., 0]
    shifted = (covariance @ right[..., None])[..., 0]
    # consistency of the edges with one leg
    residual = rows.misfit - (jac @ shifted[rows.leg][..., None])[..., 0]
    square = pick @ dot(residual, (rows.information @ residual[..., None])[..., 0])
    agrees = square < UNEXPLAINED_SCALE**2 * np.maximum(2 * pick.sum(axis=1) - 4, 1)
    both = np.logical_and(*(pick @ (rows.side == side) > 0 for side in LEG_EDGE_SIDES))
    a, b = (
        p + (across @ m[..., None])[..., 0]
        for p, m in ((rows.a, shifted[:, :2]), (rows.b, shifted[:, 2:]))
    )
    # edges of a cylinder with the controller's radius on the estimated axis
    radius = view.radius[:, None]
    at = edge_normal_jacobians(a[:, None], b[:, None], radius, LEG_EDGE_SIDES)
    middle = (a + b)[:, None] / 2 + radius[..., None] * at.n
    basis = tangent_basis(at.n, middle / np.sqrt(dot(middle, middle))[..., None])
    by_move = np.concatenate([at.dn_da @ across[:, None], at.dn_db @ across[:, None]], axis=-1)
    turn = (basis.mT @ by_move).reshape(-1, 4, 4)
    joint = turn @ covariance @ turn.mT
    lost = ~(both & agrees)[:, None, None]
    normal, joint = (np.where(lost, np.nan, v) for v in (at.n, joint))
    return LegLines(normal, np.where(lost[..., None], np.nan, basis), joint, agrees, both & agrees)


def weighted_task(law: str, task: Task, lines: LegLines, used: Booleans) -> tuple[Task, float]:
    """Task with rows whitened by the image's covariances, and the rows' common sigma in rad.

    used : (s,) legs of the task. Rows are divided by their standard deviations and multiplied by a
    typical one, the geometric mean, so that their magnitude is kept.
    """
    normal, basis, joint = lines.normal[used], lines.basis[used], lines.joint[used]
    # covariance of each leg's error, and the matrix from the error's vectors to its coordinates
    if law == "directions":
        u, spread = _direction_spread(normal, basis, joint)
        tangent = tangent_basis(u, normal[:, 0])
        to_turn = _error_to_turn(tangent)
        covariance = tangent.mT @ spread @ tangent
    else:
        to_turn = np.zeros((len(normal), 4, 6))
        to_turn[:, :2, :3], to_turn[:, 2:, 3:] = np.moveaxis(_error_to_turn(basis), 1, 0)
        covariance = joint
    size = to_turn.shape[-2]
    typical = np.exp(np.mean(np.log(np.linalg.det(covariance))) / (2 * size))
    # whitened rows
    whiten = typical * np.linalg.inv(np.linalg.cholesky(covariance)) @ to_turn
    error = (whiten @ task.error.reshape(len(whiten), -1, 1)).reshape(-1)
    matrix = whiten @ task.matrix.reshape(len(whiten), whiten.shape[-1], -1)
    return replace(task, error=error, matrix=matrix.reshape(error.size, -1)), float(typical)


def _error_to_turn(basis: Array) -> Array:
    """Matrix (..., 2, 3) from e = v x v* to the rotation (x, y) of v in its basis (t, s = v x t).

    A small rotation gives e = -s x + t y, which has no component along v.
    """
    return np.stack([-basis[..., 1], basis[..., 0]], axis=-2)


def _direction_spread(normal: Array, basis: Array, joint: Array) -> tuple[Array, Array]:
    """Directions u = n1 x n0 / |..| (s, 3) and their covariance (s, 3, 3)."""
    across = cross(normal[:, 1], normal[:, 0])
    size = np.sqrt(dot(across, across))[:, None, None]
    u = across / size[..., 0]
    by_turn = np.concatenate(
        [skew(normal[:, 1]) @ basis[:, 0], -skew(normal[:, 0]) @ basis[:, 1]], axis=-1
    )
    by_turn = (by_turn - u[:, :, None] * (u[:, None] @ by_turn)) / size
    return u, by_turn @ joint @ by_turn.mT


def corrected_pose(
    view: MachineView, T_base_platform: Array, rows: EdgeMisfits, valid: Booleans
) -> Array:
    """Pose (4, 4) after one Gauss-Newton step on the edges of the valid legs (s,).

    The step is along the platform's motion. Edges with large misfits have small weights (Cauchy),
    so that edges of another leg have little influence.
    """
    use = valid[rows.leg]
    if not use.any():
        # edges: derivatives by the pose, robust weights
        return T_base_platform
    motion, c, rot = view.machine.layout.motion, rows.closure, view.T_camera_base[:3, :3]
    leg, misfit, information = view.legs[rows.leg[use]], rows.misfit[use], rows.information[use]
    jac = rows.by_b[use] @ (rot @ c.b_by_pose[leg]) @ motion
    square = dot(misfit, (information @ misfit[..., None])[..., 0])
    weight = cauchy_weights(square / max(float(np.median(square)), 2.0))
    to_right = jac.mT @ information * weight[:, None, None]
    # readings: the closure equations with READINGS_LAG_SIGMA
    closing = c.rows.by_pose @ motion / READINGS_LAG_SIGMA
    normal = np.sum(to_right @ jac, axis=0) + closing.T @ closing
    right = (
        np.sum(to_right @ misfit[..., None], axis=0)[:, 0]
        - closing.T @ c.rows.value / READINGS_LAG_SIGMA
    )
    return perturb(T_base_platform, motion @ np.linalg.solve(normal, right))


@dataclass(frozen=True)
class Sight:
    """Controller's model of the machine, and the camera in front of it.

    edge_shift : px by which all edges lie outward, as calibrated. binning : pixels that are
    averaged in each direction before edges are measured.
    """

    view: MachineView
    camera: Camera
    edge_shift: float = 0.0
    binning: int = 1

    def binned(self, image: Integers, readings: Array) -> StationImages:
        """Binned image, as edges are measured in it."""
        station = np.zeros(1, dtype=int)
        one = StationImages(0, self.camera, station, readings[None], [image], binning=self.binning)
        return one.binned()

    def misfits(self, readings: Array, T_base_platform: Array, edges: EdgeSet) -> EdgeMisfits:
        """Misfits of the edges measured in a binned image, see :func:`edge_misfits`."""
        shift = self.edge_shift / self.binning
        return edge_misfits(self.view, readings, T_base_platform, edges, shift)


@dataclass(frozen=True)
class TrackState:
    """State of the tracker between two images.

    T_base_platform : (4, 4) pose from the readings.
    correction : (6,) left perturbation from that pose to the edges'.
    valid : (L,) seen legs that were found.
    blur : px, NaN before any leg was found.
    searched : whether the last image needed a wide search.
    """

    T_base_platform: Array
    correction: Array
    valid: Booleans
    blur: float = float("nan")
    searched: bool = False


@dataclass(frozen=True)
class TrackedLegs:
    """Observed legs in one image; L legs, camera frame.

    lines : normals (L, 2, 3) with tangent bases and covariances, NaN where lost.
    valid : (L,).
    reasons : (L,) why a leg is lost, "" otherwise.
    T_base_platform : (4, 4) pose from the edges, near the pose from the readings.
    closed : False if no pose fits the readings.
    beside : m, largest error of a rod's length at this pose, due to delayed readings or those of
        another image.
    state : for the next image.
    """

    lines: LegLines
    valid: Booleans
    reasons: tuple[str, ...]
    T_base_platform: Array
    closed: bool
    beside: float
    state: TrackState


def first_track_state(view: MachineView, start: Array | None = None) -> TrackState:
    """State before the first image; start : (4, 4) pose near which the machine stands, by default
    home.
    """
    begin = view.machine.home() if start is None else start
    none = np.zeros(len(view.legs), dtype=bool)
    return TrackState(np.asarray(begin, dtype=float), np.zeros(6), none)


def warm_up(blur: float) -> None:
    """Fill the tables of edge profiles for a blur (px), so that no image waits for them."""
    samples = len(profiles.PROFILE_OPTIONS.profile_offsets)
    width = np.repeat(profiles.PROFILE_OPTIONS.half_widths, samples)
    cut = np.tile(np.arange(samples), len(profiles.PROFILE_OPTIONS.half_widths))
    grey = np.zeros((len(width), samples))
    none = np.zeros(len(width), dtype=int)
    some = profiles.Profiles(grey, np.ones(len(width)), width, cut, none, none, none > 0)
    profiles.locate(some, profiles.residual_curves(some, {0: blur}), np.zeros(len(width)))


def track(sight: Sight, state: TrackState, image: Integers, readings: Array) -> TrackedLegs:
    """Edges of the seen legs in one image.

    image : (height, width) uint8 grey levels. readings : (m,) m or rad. Raises InputError for an
    image that is not this camera's.
    """
    check_image(image, sight.camera)
    view = sight.view
    # prediction: pose from the readings, with the last image's correction
    forward = view.machine.forward_result(readings, state.T_base_platform)
    if not bool(forward.converged):
        lines = LegLines.nothing(len(view.legs))
        reasons = ("the readings cannot be the machine's",) * len(view.legs)
        lost = replace(state, valid=lines.valid)
        return TrackedLegs(lines, lines.valid, reasons, state.T_base_platform, False, 0.0, lost)
    closed, first, blur = forward.T_base_platform, np.isnan(state.blur), state.blur
    # measurement pass; for the first image also after a wide search, the better of the two
    station_images = sight.binned(image, readings)
    predicted = perturb(closed, state.correction)
    searched = not first and _poor(state.valid) and not state.searched
    if searched:
        predicted = _searched(sight, station_images, predicted)
    at = _edge_pass(sight, station_images, predicted, blur)
    if first:
        again = _edge_pass(sight, station_images, _searched(sight, station_images, predicted), blur)
        searched = again.quality > at.quality
        at = again if searched else at
    # blur from the first image, and the correction for the next
    value = at.lines.valid
    if value.any() and first:
        blur = at.station_edges.blur
        warm_up(blur)
    T = closed if _poor(value) else corrected_pose(view, at.predicted, at.rows, value)
    correction = pose_difference(T, closed)
    beside = np.abs(at.rows.closure.rows.by_pose @ correction)
    next_state = TrackState(closed, correction, value, blur, searched)
    reasons = _reasons(sight, at)
    return TrackedLegs(at.lines, value, reasons, T, True, float(beside.max()), next_state)


def _poor(valid: Booleans) -> bool:
    """Whether fewer than half of the legs were found, so that the prediction is at fault."""
    return 2 * int(valid.sum()) < len(valid)


@dataclass(frozen=True)
class _EdgePass:
    """One measurement pass about a predicted pose (4, 4), and the legs' lines from it.

    far : the prediction was too far off, so the lines are rejected.
    """

    predicted: Array
    station_edges: StationEdges
    rows: EdgeMisfits
    lines: LegLines
    far: bool

    @property
    def quality(self) -> tuple[int, float]:
        """Order of passes: more edges first, then smaller distances from the prediction."""
        return (0 if self.far else len(self.rows.leg), -self.station_edges.shift)


def _edge_pass(
    sight: Sight, station_images: StationImages, predicted: Array, blur: float
) -> _EdgePass:
    view = sight.view
    reference = None if np.isnan(blur) else blur
    station_edges = measure(
        station_images, view.machine, view.T_camera_base, predicted[None], reference
    )
    rows = sight.misfits(station_images.joints[0], predicted, station_edges.edges)
    far = station_edges.shift > LOST_EDGE_DISTANCE
    lines = LegLines.nothing(len(view.legs)) if far else leg_lines(view, rows)
    return _EdgePass(predicted, station_edges, rows, lines, far)


def _searched(sight: Sight, station_images: StationImages, predicted: Array) -> Array:
    """Pose (4, 4) from the wide search."""
    view, readings = sight.view, station_images.joints[0]
    station_edges = search(station_images, view.machine, view.T_camera_base, predicted[None])
    every = np.ones(len(view.legs), dtype=bool)
    for _ in range(SEARCH_ROUNDS):
        rows = sight.misfits(readings, predicted, station_edges.edges)
        predicted = corrected_pose(view, predicted, rows, every)
    return predicted


def _reasons(sight: Sight, at: _EdgePass) -> tuple[str, ...]:
    if at.far:
        return ("its edges are not where they were predicted",) * len(sight.view.legs)
    out: list[str] = []
    for leg, results, agrees in zip(sight.view.legs, at.lines.valid, at.lines.agrees, strict=True):
        mine = [r for r in at.station_edges.rejected if r.leg == leg]
        in_sight = [r for r in mine if r.code != "edges.out_of_sight"]
        why = ([r.reason for r in in_sight or mine] or ["only one of its sides is seen"])[0]
        out.append("" if results else why if agrees else "its edges do not belong to one leg")
    return tuple(out)


def check_image(image: Integers, camera: Camera) -> None:
    """Raise InputError for an image that is not one grey-level image of this camera."""
    if image.dtype != np.uint8 or image.ndim != 2:
        raise InputError(
            what="the image is not an array of grey levels",
            found=f"{image.dtype} of shape {image.shape}",
            expected="uint8 of shape (height, width)",
            next_step="convert it, for example with cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)",
        )
    size = (image.shape[1], image.shape[0])
    if size != tuple(camera.image_size):
        raise InputError(
            what="the image has another size than its camera",
            found=f"{size[0]}x{size[1]} pixels",
            expected=f"{camera.image_size[0]}x{camera.image_size[1]}, as the camera file states",
            next_step="set the camera to that size; scaled images do not fit its calibration",
        )


def misfit(view: MachineView, normals: Array, T_base_platform: Array, readings: Array) -> float:
    """Median angle, in rad, between the measured legs (s, 2, 3) and the legs at a pose (4, 4)."""
    a, b = leg_ends_in_view(view, T_base_platform, readings)
    finite = np.isfinite(normals).all(axis=(-1, -2))
    cosine = dot(directions_of(normals[finite]), line_through(a[finite], b[finite])[0])
    return float(np.median(np.arccos(np.clip(cosine, -1, 1))))


def nearest_assembly(
    view: MachineView, normals: Array, readings: Array
) -> tuple[Array, float] | None:
    """Pose of the assembly mode at the readings that fits the legs (s, 2, 3) best, with its misfit.

    None without any assembly mode. The search takes a fraction of a second.
    """
    modes = view.machine.assembly_modes(readings, np.random.default_rng(0))
    if not len(modes):
        return None
    angles = [misfit(view, normals, T, readings) for T in modes]
    best = int(np.argmin(angles))
    return modes[best], angles[best]


def assembly_sentence(view: MachineView, normals: Array, expected: Array, readings: Array) -> str:
    """Sentence that compares the measured legs with the expected pose (4, 4)."""
    off = np.rad2deg(misfit(view, normals, expected, readings))
    text = f"the legs point {off:.0f} degrees away from where the start and the readings put them"
    value = nearest_assembly(view, normals, readings)
    if value is None or value[1] > SAME_ASSEMBLY_ANGLE:
        return (
            f"{text}, and no other assembly fits them: check the readings' order and units,"
            " and the camera's place"
        )
    x, y, z = value[0][:3, 3]
    turn = np.rad2deg(np.linalg.norm(pose_difference(value[0], expected)[:3]))
    return (
        f"{text}; they show the assembly with the platform at ({x:.3f}, {y:.3f}, {z:.3f}) m,"
        f" turned by {turn:.0f} degrees against it: give that pose as start, or bring the machine"
        " back to the other assembly"
    )
