"""Tracking of the legs from photograph to photograph: edges, lines with covariances, the pose.

A photograph is looked at about the pose that the readings give. Its edges become the legs' lines,
which the law needs, and correct the pose for the next look. Where the machine is not seen where
its readings put it, other assemblies are asked: once, while it stands still.
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
from pkmcal.measurements import EdgeSet
from pkmcal.mechanisms.closure import Closure, closure
from pkmcal.observe import profiles
from pkmcal.observe.image_batches import Photographs
from pkmcal.observe.legs import (
    OUT_OF_SIGHT_REASON,
    StationEdges,
    measure,
    search,
)
from pkmcal.solver.kernels import cauchy_weights

SAME_ASSEMBLY_ANGLE = float(np.deg2rad(5.0))
"""Angle between a leg as seen and as predicted, median over the legs, up to which it is the
assembly that was expected: a camera placed by hand is right to a few degrees, other assemblies
lie tens of degrees away."""
SHADING_EDGE_SHIFT = 0.1
"""Pixels, of those in which edges are looked for, by which a whole edge may lie off, whatever its
own sigma: shading that the edge model leaves out (docs/observation.md measures 0.14 and 0.22 px a
place)."""
LEG_ENDS_LATERAL_SIGMA = 0.1
"""Metres by which a leg's ends are believed to lie beside the prediction: no knowledge at all, but
it keeps the line of a leg with one edge finite until that leg is found to be lost."""
READINGS_LAG_SIGMA = 0.001
"""Metres by which a reading may lie beside the photograph: 50 mm/s for 20 ms between the two. Edges
tell some motions of the platform a hundred times worse than others, and there readings decide."""
ONE_LEG_MISFIT = 16.0
"""Mean squared misfit, in variances, beyond which a leg's edges are not one leg's."""
LEG_EDGE_SIDES = np.array([0, 1])
LOST_EDGE_DISTANCE = 0.7
"""Median distance (px) of edges from their prediction from which none is believed: of legs that
turned away more than that, the ends that still lie within reach pass for whole edges."""
SEARCH_ROUNDS = 3
"""Gauss-Newton steps of the pose after a search: ten pixels are far enough to bend the way."""


@dataclass(frozen=True)
class LegLines:
    """Seen legs as two edges each, of the radius that the controller uses; camera frame.

    normal : (L, 2, 3) unit, NaN where the leg was not found. basis : (L, 2, 3, 2) tangent bases,
    shift first. joint : (L, 4, 4) covariance in these, rad^2, side 0 before side 1: how far away a
    leg is turns both against each other. agrees : (L,) its edges fit one leg.
    valid : (L,) an edge of either side was measured, and they agree.
    """

    normal: Array
    basis: Array
    joint: Array
    agrees: Booleans
    valid: Booleans

    @classmethod
    def nothing(cls, count: int) -> LegLines:
        """No leg found of ``count``."""
        normal, basis, joint = (
            np.full((count, *shape), np.nan) for shape in ((2, 3), (2, 3, 2), (4, 4))
        )
        agrees, valid = np.ones(count, dtype=bool), np.zeros(count, dtype=bool)
        return cls(normal, basis, joint, agrees, valid)


@dataclass(frozen=True)
class EdgeMisfits:
    """Edges of one photograph against the pose where they were looked for; M edges of s seen legs.

    leg : (M,) place of the edge's leg among the seen ones. misfit : (M, 2) turn from the predicted
    plane to the measured one, in the edge's basis. by_a, by_b : (M, 2, 3) its derivatives by the
    ends of the leg, camera frame. information : (M, 2, 2). side : (M,). closure : of the machine
    at that pose. a, b : (s, 3) ends of the seen legs, camera frame.
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
        """(count, M): 1 where the edge is the leg's."""
        return (self.leg == np.arange(count)[:, None]).astype(float)


def edge_misfits(
    view: MachineView, readings: Array, T_base_platform: Array, edges: EdgeSet, edge_shift: float
) -> EdgeMisfits:
    """Edges of the seen legs against the machine at a pose (4, 4) and its readings (m,).

    edge_shift : px by which the camera shows all edges outward.
    """
    machine = view.machine
    c = closure(machine.layout, machine.values, readings, T_base_platform)
    a, b = (apply(view.T_camera_base, p[view.legs]) for p in (c.a, c.b))
    own = edges.leg[:, None] == view.legs
    edges = edges.select(own.any(axis=1))
    leg = own[own.any(axis=1)].argmax(axis=1)
    radius = machine.radii_of(edges.leg, edges.tube)
    at = edge_normal_jacobians(a[leg], b[leg], radius, edges.side)
    to_tangent = edges.basis.mT
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

    A leg's line has four freedoms, its two ends across the leg; every edge tells two, whatever its
    tube's radius. One Gauss-Newton step: a prediction right to 1.5 px leaves 1e-5 rad.
    """
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
    residual = rows.misfit - (jac @ shifted[rows.leg][..., None])[..., 0]
    square = pick @ dot(residual, (rows.information @ residual[..., None])[..., 0])
    agrees = square < ONE_LEG_MISFIT * np.maximum(2 * pick.sum(axis=1) - 4, 1)
    both = np.logical_and(*(pick @ (rows.side == side) > 0 for side in LEG_EDGE_SIDES))
    a, b = (
        p + (across @ m[..., None])[..., 0]
        for p, m in ((rows.a, shifted[:, :2]), (rows.b, shifted[:, 2:]))
    )
    # and as the edges that a cylinder of the controller's radius would show
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
    """A task with its rows weighed by what the photograph tells of the legs used, (s,); and the
    standard deviation (rad) that every row then has.

    Divided by their standard deviations and multiplied by a typical one, rows stay about what they
    were.
    """
    normal, basis, joint = lines.normal[used], lines.basis[used], lines.joint[used]
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
    whiten = typical * np.linalg.inv(np.linalg.cholesky(covariance)) @ to_turn
    error = (whiten @ task.error.reshape(len(whiten), -1, 1)).reshape(-1)
    matrix = whiten @ task.matrix.reshape(len(whiten), whiten.shape[-1], -1)
    return replace(task, error=error, matrix=matrix.reshape(error.size, -1)), float(typical)


def _error_to_turn(basis: Array) -> Array:
    """From e = v x v* to the turn (x, y) of v in its tangent basis (t, s = v x t): (..., 2, 3).

    A small turn gives e = -s x + t y, which has no part along v.
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
    """The pose (4, 4) moved so that the edges of the legs found (s,) fit best: one Gauss-Newton
    step, in the directions in which the platform moves.

    Edges far off count less (Cauchy), so that one leg taken for another does not carry the pose.
    """
    use = valid[rows.leg]
    if not use.any():
        return T_base_platform
    motion, c, rot = view.machine.layout.motion, rows.closure, view.T_camera_base[:3, :3]
    leg, misfit, information = view.legs[rows.leg[use]], rows.misfit[use], rows.information[use]
    jac = rows.by_b[use] @ (rot @ c.b_by_pose[leg]) @ motion
    square = dot(misfit, (information @ misfit[..., None])[..., 0])
    weight = cauchy_weights(square / max(float(np.median(square)), 2.0))
    to_right = jac.mT @ information * weight[:, None, None]
    closing = c.rows.by_pose @ motion / READINGS_LAG_SIGMA
    normal = np.sum(to_right @ jac, axis=0) + closing.T @ closing
    right = (
        np.sum(to_right @ misfit[..., None], axis=0)[:, 0]
        - closing.T @ c.rows.value / READINGS_LAG_SIGMA
    )
    return perturb(T_base_platform, motion @ np.linalg.solve(normal, right))


@dataclass(frozen=True)
class Sight:
    """What is looked at: the machine as believed, in the camera that stands before it.

    edge_shift : px by which all edges lie outward of where they should, as calibrated. binning :
    how many pixels across, and down, are one where they are looked for.
    """

    view: MachineView
    camera: Camera
    edge_shift: float = 0.0
    binning: int = 1

    def photograph(self, image: Integers, readings: Array) -> Photographs:
        """A photograph as its edges are looked for."""
        station = np.zeros(1, dtype=int)
        one = Photographs(0, self.camera, station, readings[None], [image], binning=self.binning)
        return one.binned()

    def misfits(self, readings: Array, T_base_platform: Array, edges: EdgeSet) -> EdgeMisfits:
        """The :func:`edge_misfits` of edges found in one."""
        shift = self.edge_shift / self.binning
        return edge_misfits(self.view, readings, T_base_platform, edges, shift)


@dataclass(frozen=True)
class TrackState:
    """What one photograph tells the next.

    T_base_platform : (4, 4) pose that the readings gave. correction : (6,) by which the edges lay
    beside it (left perturbation). valid : (L,) seen legs that were found. blur : px, NaN before
    legs were found for the first time. searched : whether they had to be searched.
    """

    T_base_platform: Array
    correction: Array
    valid: Booleans
    blur: float = float("nan")
    searched: bool = False


@dataclass(frozen=True)
class TrackedLegs:
    """The seen legs in one photograph; L seen legs, camera frame.

    lines : normals (L, 2, 3) with tangent bases and covariances, NaN where lost.
    valid : (L,). reasons : (L,) why a leg is lost, "" where it is not.
    T_base_platform : (4, 4) pose that the edges show, near the one that the readings give.
    closed : False where no pose fits the readings. beside : m, the largest error of a rod's length
    that this pose means: readings that are late, or another photograph's. state : for the next one.
    """

    lines: LegLines
    valid: Booleans
    reasons: tuple[str, ...]
    T_base_platform: Array
    closed: bool
    beside: float
    state: TrackState


def first_track_state(view: MachineView, start: Array | None = None) -> TrackState:
    """Before the first photograph; start : (4, 4) pose near which the machine stands."""
    begin = view.machine.home() if start is None else start
    none = np.zeros(len(view.legs), dtype=bool)
    return TrackState(np.asarray(begin, dtype=float), np.zeros(6), none)


def warm_up(blur: float) -> None:
    """Fill the tables of edge profiles for a blur (px), so that no photograph waits for them."""
    samples = len(profiles.profile_offsets())
    width = np.repeat(profiles.HALF_WIDTHS, samples)
    cut = np.tile(np.arange(samples), len(profiles.HALF_WIDTHS))
    grey = np.zeros((len(width), samples))
    none = np.zeros(len(width), dtype=int)
    some = profiles.Profiles(grey, np.ones(len(width)), width, cut, none, none, none > 0)
    profiles.locate(some, profiles.residual_curves(some, {0: blur}), np.zeros(len(width)))


def track(sight: Sight, state: TrackState, image: Integers, readings: Array) -> TrackedLegs:
    """Edges of the seen legs in one photograph.

    image : (height, width) uint8 grey levels. readings : (m,) m or rad. Raises InputError for an
    image that is not this camera's.
    """
    check_image(image, sight.camera)
    view = sight.view
    forward = view.machine.forward_result(readings, state.T_base_platform)
    if not bool(forward.converged):
        lines = LegLines.nothing(len(view.legs))
        reasons = ("the readings cannot be the machine's",) * len(view.legs)
        lost = replace(state, valid=lines.valid)
        return TrackedLegs(lines, lines.valid, reasons, state.T_base_platform, False, 0.0, lost)
    closed, first, blur = forward.T_base_platform, np.isnan(state.blur), state.blur
    photograph = sight.photograph(image, readings)
    predicted = perturb(closed, state.correction)
    searched = not first and _poor(state.valid) and not state.searched
    if searched:
        predicted = _searched(sight, photograph, predicted)
    at = _edge_pass(sight, photograph, predicted, blur)
    if first:
        again = _edge_pass(sight, photograph, _searched(sight, photograph, predicted), blur)
        searched = again.quality > at.quality
        at = again if searched else at
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
    """Fewer than half of the legs: the prediction is at fault and not what hides them."""
    return 2 * int(valid.sum()) < len(valid)


@dataclass(frozen=True)
class _EdgePass:
    """A sub-pixel look about a predicted pose (4, 4), and the legs' lines from it; far : the
    prediction was so wrong that they are not believed.
    """

    predicted: Array
    station_edges: StationEdges
    rows: EdgeMisfits
    lines: LegLines
    far: bool

    @property
    def quality(self) -> tuple[int, float]:
        """More edges are better, then smaller distances from the prediction."""
        return (0 if self.far else len(self.rows.leg), -self.station_edges.shift)


def _edge_pass(sight: Sight, photograph: Photographs, predicted: Array, blur: float) -> _EdgePass:
    view = sight.view
    reference = None if np.isnan(blur) else blur
    station_edges = measure(
        photograph, view.machine, view.T_camera_base, predicted[None], reference
    )
    rows = sight.misfits(photograph.joints[0], predicted, station_edges.edges)
    far = station_edges.shift > LOST_EDGE_DISTANCE
    lines = LegLines.nothing(len(view.legs)) if far else leg_lines(view, rows)
    return _EdgePass(predicted, station_edges, rows, lines, far)


def _searched(sight: Sight, photograph: Photographs, predicted: Array) -> Array:
    """The pose (4, 4) that the wide search gives."""
    view, readings = sight.view, photograph.joints[0]
    station_edges = search(photograph, view.machine, view.T_camera_base, predicted[None])
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
        mine = [r.reason for r in at.station_edges.rejected if r.leg == leg]
        display = [reason for reason in mine if reason != OUT_OF_SIGHT_REASON]
        why = (display or mine or ["only one of its sides is seen"])[0]
        out.append("" if results else why if agrees else "its edges do not belong to one leg")
    return tuple(out)


def check_image(image: Integers, camera: Camera) -> None:
    """Raise InputError where an image is not one grey-level photograph of this camera."""
    if image.dtype != np.uint8 or image.ndim != 2:
        raise InputError(
            what="the photograph is not an array of grey levels",
            found=f"{image.dtype} of shape {image.shape}",
            expected="uint8 of shape (height, width)",
            next_step="convert it, for example with cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)",
        )
    size = (image.shape[1], image.shape[0])
    if size != tuple(camera.image_size):
        raise InputError(
            what="the photograph has another size than its camera",
            found=f"{size[0]}x{size[1]} pixels",
            expected=f"{camera.image_size[0]}x{camera.image_size[1]}, as the camera file says",
            next_step="set the camera to that size; scaled photographs do not fit its calibration",
        )


def misfit(view: MachineView, normals: Array, T_base_platform: Array, readings: Array) -> float:
    """Median angle (rad) between the legs as seen, (s, 2, 3), and at a pose (4, 4)."""
    a, b = leg_ends_in_view(view, T_base_platform, readings)
    finite = np.isfinite(normals).all(axis=(-1, -2))
    cosine = dot(directions_of(normals[finite]), line_through(a[finite], b[finite])[0])
    return float(np.median(np.arccos(np.clip(cosine, -1, 1))))


def nearest_assembly(
    view: MachineView, normals: Array, readings: Array
) -> tuple[Array, float] | None:
    """Of all assemblies at the readings the one that the legs (s, 2, 3) show best, and its misfit;
    None where there is none. A search: takes a fraction of a second.
    """
    modes = view.machine.assembly_modes(readings, np.random.default_rng(0))
    if not len(modes):
        return None
    angles = [misfit(view, normals, T, readings) for T in modes]
    best = int(np.argmin(angles))
    return modes[best], angles[best]


def assembly_sentence(view: MachineView, normals: Array, expected: Array, readings: Array) -> str:
    """What the legs show instead of the expected pose (4, 4)."""
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
