"""A camera, and the board's poses, by maximum likelihood from the corners seen in views.

Unknowns: the free intrinsics, and six numbers a view (left perturbation of ``T_camera_board``).
A corner's residual is divided by sqrt(sigma^2 + tau^2): sigma is what its own fit in the picture
says, tau what the model leaves out, estimated so that chi square is what it should be. Corners
far off lose their weight. The poses are eliminated view by view (:mod:`pkmcal.solver`).

With a known camera the poses alone are fitted in the same way (:func:`board_poses`); they start
from a linear solution, and the better of a board's two tilts is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.boards.board import Board, Detection
from pkmcal.cameras.contract import Camera
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import apply, cross, perturb, pose, rotation
from pkmcal.solver.elimination import Linear, eliminate
from pkmcal.solver.kernels import final_weights
from pkmcal.solver.ranks import NORMAL_RANK_TOLERANCE, normal_root
from pkmcal.solver.search import Stop, Values, minimise
from pkmcal.solver.strips import Compact, compact

MEDIAN_LENGTH = float(np.sqrt(2 * np.log(2)))
"""Median length of a vector of two normal numbers, in their standard deviation."""
LEAST_NOISE = 1e-4
"""px; keeps noise-free data finite."""


@dataclass(frozen=True)
class CameraFitOptions:
    """Constants of the fit of a camera and of a board's poses."""

    # views in which a corner has to lie at another one's place before its number is wrong: in one,
    # it is an outlier. Not checked with more
    least_views: int = 2
    # corners that one wrong marker, such as another thing's, puts elsewhere in all views
    marker_corners: int = 4
    # most rounds of reweighting
    rounds: int = 12
    # most steps of a round; a long valley, such as that of xi and f, is followed over several
    steps: int = 20
    # change of the corners' weights and relative change of tau that end the rounds (numerical)
    settled: float = 1e-3
    # factor on the robust scale of the first round, halved down to 1: the start's outliers are
    # unknown
    first_cut: float = 4.0
    # rms of the corners' residuals, as a share of the image's width, from which on the board file
    # or the camera file is wrong, or no camera model explains the images; correct files leave a
    # hundredth of this limit on known cameras, and a tenth on held-out views (measured)
    residual_limit: float = 0.004


CAMERA_FIT_OPTIONS = CameraFitOptions()


class Views(NamedTuple):
    """Corners of V views of one board.

    points : (N, 3) m, board frame. pixels : (V, N, 2), NaN where a corner is not seen.
    sigma : (V, N) px, a corner's own standard deviation, 0 where unknown.
    """

    points: Array
    pixels: Array
    sigma: Array

    @property
    def visible(self) -> Booleans:
        """(V, N) True where a corner is seen."""
        return np.asarray(np.isfinite(self.pixels).all(axis=-1))

    def take(self, views: Integers | Sequence[int]) -> Views:
        """Some of the views."""
        return Views(self.points, self.pixels[views], self.sigma[views])


def views_of(detections: Sequence[Detection], board: Board) -> Views:
    """Detections as arrays."""
    shape = len(detections), len(board.points)
    pixels, sigma = np.full((*shape, 2), np.nan), np.zeros(shape)
    for v, detection in enumerate(detections):
        pixels[v, detection.ids] = detection.pixels
        sigma[v, detection.ids] = detection.sigma
    return Views(board.points, pixels, sigma)


class CameraState(NamedTuple):
    """Free intrinsics (B, k), of one run where there are any, and poses ``T_camera_board``
    (B, K, 4, 4).
    """

    intrinsics: Array
    T_camera_board: Array


@dataclass(frozen=True)
class CameraProblem:
    """Corners as the solver wants them: B runs of K views with one camera.

    camera : model and image size; its parameters where not free.
    free : positions of the free intrinsics; none where only poses are wanted.
    pixels : (B, K, N, 2). scale : (B, K, N) root of weight over sigma; 0 for corners not seen.
    """

    camera: Camera
    free: Integers
    points: Array
    pixels: Array
    scale: Array

    def residuals(self, state: CameraState) -> Values:
        """Whitened residuals, NaN where the camera does not see a corner that was seen."""
        camera = with_free(self.camera, self.free, state)
        there = apply(state.T_camera_board[..., None, :, :], self.points)
        off = (camera.project(there) - self.pixels) * self.scale[..., None]
        off = np.where(self.scale[..., None] > 0, off, 0.0)
        value = off.reshape(*off.shape[:2], -1)
        rows = partial(self._compact, state, value)
        return Values(value, np.zeros((len(off), 0)), rows)

    def linearize(self, state: CameraState) -> Linear:
        """Whitened residuals and their exact derivatives."""
        return self._linear(state, self.residuals(state).value)

    def _compact(self, state: CameraState, value: Array) -> Compact:
        """:meth:`linearize` at a state whose residuals are known, for the normal equations."""
        return compact(self._linear(state, value))

    def _linear(self, state: CameraState, value: Array) -> Linear:
        """:meth:`linearize` at a state with residuals (B, K, 2 N)."""
        camera = with_free(self.camera, self.free, state)
        there = apply(state.T_camera_board[..., None, :, :], self.points)
        turned = there - state.T_camera_board[..., None, :3, 3]
        by_point, by_parameters = camera.project_jacobians(there)
        # -g^T [t]x = (t x g)^T for each row g of the derivative by the point
        by_turn = cross(turned[..., None, :], by_point)
        by_pose = np.concatenate([by_turn, by_point], axis=-1)
        usable = np.isfinite(value)
        shape = value.shape
        scale = self.scale[..., None, None]
        retained = (scale > 0) & usable.reshape(*scale.shape[:3], 2, 1)

        def rows(jacobian: Array) -> Array:
            return np.where(retained, jacobian * scale, 0.0).reshape(*shape, jacobian.shape[-1])

        shared = rows(by_parameters[..., self.free])
        if not len(self.free):
            # The solver wants one shared unknown at least; this one moves nothing.
            shared = np.zeros((*shape, 1))
        return Linear(
            np.where(usable, value, 0.0),
            shared,
            rows(by_pose),
            usable,
            np.zeros((shape[0], 0)),
            np.zeros((0, shared.shape[-1])),
        )

    def retract(self, state: CameraState, shared: Array, own: Array) -> CameraState:
        """The state after a step; the model's own fields stay in their ranges."""
        intrinsics = state.intrinsics
        if len(self.free):
            intrinsics = intrinsics + shared
            shape = (self.free >= 4) & (self.free < 4 + len(self.camera.own))
            low, high = self.camera.own_range()[:, self.free[shape] - 4]
            intrinsics[:, shape] = np.clip(intrinsics[:, shape], low, high)
        return CameraState(intrinsics, perturb(state.T_camera_board, own))

    def select(self, runs: Integers) -> CameraProblem:
        """The problem of some runs."""
        return replace(self, pixels=self.pixels[runs], scale=self.scale[runs])


def with_free(camera: Camera, free: Integers, state: CameraState) -> Camera:
    """The camera with its free intrinsics as the state has them."""
    if not len(free):
        return camera
    parameters = camera.parameters.copy()
    parameters[free] = state.intrinsics[0]
    return replace(camera, parameters=parameters)


@dataclass(frozen=True)
class CameraFit:
    """A camera fitted to views.

    free : positions of the estimated intrinsics. T_camera_board : (V, 4, 4).
    residuals : (V, N, 2) px, predicted minus seen, NaN where not seen. weight : (V, N), 0 to 1.
    tau : px, noise beyond the corners' own. converged : False where the search gave up.
    """

    camera: Camera
    free: Integers
    T_camera_board: Array
    residuals: Array
    weight: Array
    tau: float
    converged: bool

    def problem(self, views: Views) -> CameraProblem:
        """The whitened problem at the fit's weights, as one run."""
        return _problem(self.camera, self.free, views, self.weight, self.tau)

    @property
    def state(self) -> CameraState:
        """The fit as the solver's state."""
        return CameraState(self.camera.parameters[None, self.free], self.T_camera_board[None])


def fit_camera(
    camera: Camera,
    free: Integers,
    views: Views,
    T_camera_board: Array,
    rounds: int | None = None,
    options: CameraFitOptions = CAMERA_FIT_OPTIONS,
) -> CameraFit:
    """Fit intrinsics and poses from a start; weights and noise alternate with the search."""
    in_view = views.visible
    weight = in_view.astype(float)
    state = CameraState(camera.parameters[None, free], T_camera_board[None])
    tau, cut, converged, off = 1.0, options.first_cut, True, views.pixels
    for _ in range(options.rounds if rounds is None else rounds):
        problem = _problem(camera, free, views, weight, tau)
        solution = minimise(problem, state, max_steps=options.steps)
        state, converged = solution.state, solution.stop[0] is Stop.CONVERGED
        off = _off(with_free(camera, free, state), state, views)
        dof = max(2 * weight.sum() - 6 * len(in_view) - len(free), 1.0)
        new_tau = noise_beyond(off, views.sigma, weight, dof)
        # tau from the median of the residuals' lengths
        middle = float(np.median(np.sum(off[in_view] ** 2, axis=-1))) / MEDIAN_LENGTH**2
        beyond_noise = middle - float(np.median(views.sigma[in_view] ** 2))
        robust = float(np.sqrt(max(beyond_noise, LEAST_NOISE**2)))
        distance = np.sum(np.nan_to_num(off) ** 2, axis=-1) / (views.sigma**2 + (robust * cut) ** 2)
        new_weight = np.where(in_view, final_weights(np.sqrt(distance)), 0.0)
        change = np.abs(new_weight - weight).max(initial=0.0)
        done = (
            cut == 1.0
            and change < options.settled
            and abs(new_tau - tau) <= options.settled * max(tau, new_tau)
        )
        weight, tau, cut = new_weight, new_tau, max(cut / 2, 1.0)
        if done:
            break
    return CameraFit(
        with_free(camera, free, state), free, state.T_camera_board[0], off, weight, tau, converged
    )


def refit(fit: CameraFit, views: Views, retained: Integers) -> CameraFit:
    """The camera from some of the views, from the fit to all, with its weights and noise."""
    part = views.take(retained)
    problem = _problem(fit.camera, fit.free, part, fit.weight[retained], fit.tau)
    state = CameraState(fit.camera.parameters[None, fit.free], fit.T_camera_board[retained][None])
    solution = minimise(problem, state, max_steps=15)
    camera = with_free(fit.camera, fit.free, solution.state)
    off = _off(camera, solution.state, part)
    return replace(
        fit, camera=camera, T_camera_board=solution.state.T_camera_board[0], residuals=off,
        weight=fit.weight[retained],
    )  # fmt: skip


def fit_board_poses(
    camera: Camera, views: Views, T_camera_board: Array, scale: Array
) -> tuple[Array, Array]:
    """Poses (V, 4, 4) alone, each view on its own, and their costs (V,). scale : (V, N)."""
    problem = CameraProblem(
        camera, np.zeros(0, dtype=int), views.points, views.pixels[:, None], scale[:, None]
    )
    # to the end: where another tilt was followed half-way, nobody knows whether it is another one
    solution = minimise(problem, CameraState(np.zeros((len(scale), 0)), T_camera_board[:, None]))
    return solution.state.T_camera_board[:, 0], solution.cost


def covariance_of(
    fit: CameraFit, views: Views, beside: Array | None = None
) -> tuple[Array, Array, Array]:
    """Covariances at a fit: intrinsics (n, n), zero where not free; poses (V, 6, 6); and the
    poses' derivative by the intrinsics (V, 6, n).

    beside : (V, 2 N, k) rows of further unknowns of the fit.
    """
    linear = fit.problem(views).linearize(fit.state)
    n, k = len(fit.camera.parameters), 0 if beside is None else beside.shape[-1]
    if beside is not None:
        shared = np.concatenate([linear.by_shared[0], beside], axis=-1)[None]
        linear = linear._replace(by_shared=shared, shared_by=np.zeros((0, shared.shape[-1])))
    reduced = eliminate(linear)
    inner = np.linalg.inv(reduced.r[0] + 1e-150 * np.eye(6))
    whole, by = np.zeros((n + k, n + k)), np.zeros((len(fit.T_camera_board), 6, n + k))
    if len(fit.free):
        rows, free = reduced.rows[0], np.append(fit.free, n + np.arange(k))
        whole[np.ix_(free, free)] = inverted((rows.mT @ rows).sum(axis=0))
        by[..., free] = -inner @ (reduced.q[0].mT @ linear.by_shared[0])
    poses = inner @ inner.mT + by @ whole @ by.mT
    return whole[:n, :n], poses, by[..., :n]


def inverted(normal: Array) -> Array:
    """Inverse of a normal matrix; what is not determined becomes very uncertain, not an error."""
    half = normal_root(normal, NORMAL_RANK_TOLERANCE, loose=True)
    return half @ half.mT


def check_numbering(
    residuals: Array,
    pixels: Array,
    board: Board,
    where: str,
    options: CameraFitOptions = CAMERA_FIT_OPTIONS,
) -> None:
    """Raise `InputError` where corners lie at other ones' places in most of the views that show
    them, by residuals and pixels (V, N, 2), NaN where not seen.

    In single views it is a detection that failed; in most of them the board is another. A robust
    fit gives such corners up, whatever their share, and what is left of them may fit any lens.
    """
    gap = np.linalg.norm(pixels[:, :, None] - pixels[:, None], axis=-1)
    each = np.arange(pixels.shape[1])
    gap[:, each, each] = np.inf
    nearest = np.where(np.isfinite(gap), gap, np.inf).min(axis=-1, initial=np.inf)
    off = np.linalg.norm(residuals, axis=-1)
    finite = np.isfinite(off) & np.isfinite(nearest)
    elsewhere = np.sum(finite & (np.nan_to_num(off) > nearest / 2), axis=0)
    wrong = (elsewhere >= options.least_views) & (2 * elsewhere > finite.sum(axis=0))
    if wrong.sum() <= options.marker_corners or 2 * wrong.sum() > len(wrong):
        return  # where most lie elsewhere there is no board to be numbered
    raise InputError(
        "the board's corners are numbered otherwise than in its file",
        where=where,
        found=f"{int(wrong.sum())} of {len(wrong)} corners at other ones' places",
        expected=board.described,
        next_step="Check the numbers of rows and columns, the first marker's id and the dictionary",
        code="board.numbering",
    )


def noise_beyond(off: Array, sigma: Array, weight: Array, dof: float) -> float:
    """The tau with sum of w |off|^2 / (sigma^2 + tau^2) = dof, LEAST_NOISE at least; px."""
    squares = weight * np.nan_to_num(np.sum(off**2, axis=-1))

    def excess(tau: float) -> float:
        return float(np.sum(squares / (sigma**2 + tau**2))) - dof

    low, high = LEAST_NOISE, float(np.sqrt(squares.sum() / dof)) + 2 * LEAST_NOISE
    if excess(low) <= 0:
        return low
    for _ in range(40):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return float(high)


def _problem(
    camera: Camera, free: Integers, views: Views, weight: Array, tau: float
) -> CameraProblem:
    scale = np.where(views.visible, np.sqrt(weight / (views.sigma**2 + tau**2)), 0.0)
    return CameraProblem(camera, free, views.points, views.pixels[None], scale[None])


def _off(camera: Camera, state: CameraState, views: Views) -> Array:
    """Predicted minus seen, (V, N, 2) px; far away where the camera cannot see the corner."""
    off = camera.project(apply(state.T_camera_board[0][:, None], views.points)) - views.pixels
    lost = views.visible[..., None] & ~np.isfinite(off)
    return np.where(lost, 1e3, off)


class BoardPoses(NamedTuple):
    """Poses of a board in V views.

    T_camera_board : (V, 4, 4).
    covariance : (V, 6, 6) of (omega, tau), left perturbation, by the corners' noise alone.
    by_intrinsics : (V, 6, n) derivative by the camera's parameters; with their covariance C a
        pose's whole covariance is covariance + by_intrinsics C by_intrinsics^T.
    residuals : (V, N, 2) px.
    weight : (V, N).
    noise : px beyond the corners' own.
    """

    T_camera_board: Array
    covariance: Array
    by_intrinsics: Array
    residuals: Array
    weight: Array
    noise: float


def board_poses(
    camera: Camera, views: Views, options: CameraFitOptions = CAMERA_FIT_OPTIONS
) -> BoardPoses:
    """The board's pose in every view, by maximum likelihood with a known camera."""
    n = len(camera.parameters)
    if not len(views.pixels):
        none = np.zeros((0, 4, 4)), np.zeros((0, 6, 6)), np.zeros((0, 6, n))
        return BoardPoses(*none, views.pixels, views.sigma, 0.0)
    start = settled_poses(camera, views)
    fit = fit_camera(camera, np.zeros(0, dtype=int), views, start, options=options)
    # The derivative by all intrinsics, though none of them is estimated here.
    as_if_free = replace(fit, free=np.arange(n))
    return BoardPoses(
        fit.T_camera_board,
        covariance_of(fit, views)[1],
        covariance_of(as_if_free, views)[2],
        fit.residuals,
        fit.weight,
        fit.tau,
    )


def settled_poses(camera: Camera, views: Views, start: Array | None = None) -> Array:
    """Poses (V, 4, 4) by least squares, the better of each view's two tilts."""
    start = linear_poses(camera.ray(views.pixels), views.points) if start is None else start
    scale = views.visible.astype(float)
    first, cost = fit_board_poses(camera, views, start, scale)
    second, other = fit_board_poses(camera, views, tilted_back(first, views.points), scale)
    return np.where((other < cost)[:, None, None], second, first)


def tilted_back(T_camera_board: Array, points: Array) -> Array:
    """Pose of the board tilted the other way, which from far away has almost the same image.

    In the image, half a turn about the line of sight through the board's middle cancels half a turn
    of the board about its own normal.
    """
    middle = points.mean(axis=0)
    rot = T_camera_board[..., :3, :3]
    centre = rot @ middle + T_camera_board[..., :3, 3]
    sight = centre / np.linalg.norm(centre, axis=-1, keepdims=True)
    turned = rotation(np.pi * sight) @ rot @ np.diag([-1.0, -1.0, 1.0])
    return pose(turned, centre - turned @ middle)


def linear_poses(rays: Array, points: Array) -> Array:
    """Poses (..., 4, 4) with rays (..., N, 3) parallel to T points (N, 3), points on a plane z = 0.

    ray x (r1 X + r2 Y + t) = 0 is linear in r1, r2 and t, for rays to all sides; r1 and r2 are
    made orthonormal afterwards. NaN rays are left out; poses that fewer than four rays leave open
    are any.
    """
    finite = np.asarray(np.isfinite(rays).all(axis=-1))
    s = np.where(finite[..., None], rays, 0.0)
    middle, spread = points[:, :2].mean(axis=0), points[:, :2].std() + 1e-12
    plane = np.concatenate([(points[:, :2] - middle) / spread, np.ones((len(points), 1))], axis=-1)
    # sum over corners of kron(X X^T, I - s s^T), the normal matrix of the cross products
    across = finite[..., None, None] * np.eye(3) - s[..., :, None] * s[..., None, :]
    normal = np.einsum("na,nb,...nij->...aibj", plane, plane, across, optimize=True)
    normal = normal.reshape(*rays.shape[:-2], 9, 9)
    vector = np.linalg.eigh(normal)[1][..., 0].reshape(*rays.shape[:-2], 3, 3)
    m1, m2, m0 = vector[..., 0, :] / spread, vector[..., 1, :] / spread, vector[..., 2, :]
    m0 = m0 - m1 * middle[0] - m2 * middle[1]
    size = np.sqrt(np.linalg.norm(m1, axis=-1) * np.linalg.norm(m2, axis=-1))
    # Of a unit vector; where nothing is known it may be zero, and less than rounding means nothing.
    size = np.maximum(size, np.finfo(float).eps)[..., None]
    x, y = points[:, :1], points[:, 1:2]
    there = m1[..., None, :] * x + m2[..., None, :] * y + m0[..., None, :]
    ahead = np.einsum("...ni,...ni->...", s, there)
    size = size * np.where(ahead < 0, -1.0, 1.0)[..., None]
    m1, m2, t = m1 / size, m2 / size, m0 / size
    u, _, vt = np.linalg.svd(np.stack([m1, m2], axis=-1), full_matrices=False)
    r12 = u @ vt
    rot = np.concatenate([r12, np.cross(r12[..., 0], r12[..., 1])[..., None]], axis=-1)
    return pose(rot, t)
