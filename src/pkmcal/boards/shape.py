"""Deviations of a board's corners from its file: bend, gaps between markers, stretch.

Each is a column, a displacement of the corners linear in few amplitudes. At the minimum of a fit of
camera and poses, one Gauss-Newton step of all unknowns together with the amplitudes gives their
values, to first order those of a fit that has them as unknowns; their significance is a score test.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.boards.board import Board
from pkmcal.boards.fit import CameraFit, Views, inverted
from pkmcal.solver.elimination import eliminate


@dataclass(frozen=True)
class BoardColumn:
    """Deviation of a board by k amplitudes.

    code : bend, gap or stretch. displacement : (k, N, 3) of the corners by the amplitudes.
    """

    code: str
    displacement: Array


class BoardDeviation(NamedTuple):
    """Estimated amplitudes of a column.

    value : (k,). covariance : (k, k), widened where the views disagree by more than the corners'
    noise. chance : p-value of as large a value for a board as its file states. focal_shift : (2,)
    px, change of the focal lengths if the amplitudes were unknowns.
    """

    code: str
    value: Array
    covariance: Array
    chance: float
    focal_shift: Array


def bend_of(board: Board) -> BoardColumn:
    """Bend out of the plane, m at the middle relative to the border, along x and along y.

    Parabolas 1 - u^2 with u from -1 to 1 over the board, as in mrcal.
    """
    low, high = board.points.min(axis=0)[:2], board.points.max(axis=0)[:2]
    u = (2 * board.points[:, :2] - low - high) / (high - low)
    out = np.zeros((2, len(board.points), 3))
    out[:, :, 2] = 1 - u.T**2
    return BoardColumn("bend", out)


def board_columns(board: Board) -> tuple[BoardColumn, ...]:
    """Columns of a board: bend, m; stretch of x against y, relative; of a grid of markers also the
    gap, m.
    """
    middle = board.points.mean(axis=0)
    stretch = (board.points - middle) * [0.5, -0.5, 0.0]
    columns = [bend_of(board), BoardColumn("stretch", stretch[None])]
    if board.type == "aruco_grid":
        step = board.document["marker"] + board.document["gap"]
        # the corner's marker, counted in steps; its own corners lie less than a step behind
        steps = np.floor(board.points / step + 1e-9) * [1.0, 1.0, 0.0]
        columns.append(BoardColumn("gap", steps[None]))
    return tuple(columns)


def rows_of(fit: CameraFit, views: Views, column: BoardColumn) -> Array:
    """Derivatives (V, 2 N, k) of the whitened residuals by a column's amplitudes."""
    problem = fit.problem(views)
    rotation = fit.T_camera_board[:, :3, :3]
    in_camera = views.points @ rotation.mT + fit.T_camera_board[:, None, :3, 3]
    by_point = fit.camera.project_jacobians(in_camera)[0]
    moved = np.einsum("vij,knj->vnik", rotation, column.displacement)
    rows = by_point @ moved * problem.scale[0][..., None, None]
    rows = np.where(problem.scale[0][..., None, None] > 0, rows, 0.0)
    return np.nan_to_num(rows).reshape(len(rotation), -1, len(column.displacement))


def deviation(fit: CameraFit, views: Views, column: BoardColumn) -> BoardDeviation:
    """Amplitudes of a column beside all unknowns of a fit, by one step."""
    from scipy.special import chdtrc

    k, n = len(column.displacement), len(fit.free)
    linear = fit.problem(views).linearize(fit.state)
    extra = rows_of(fit, views, column)
    shared = np.concatenate([linear.by_shared[0][..., :n], extra], axis=-1)
    reduced = eliminate(linear._replace(by_shared=shared[None], shared_by=np.zeros((0, n + k))))
    rows, right = reduced.rows[0], linear.value[0]
    products = np.einsum("vrj,vr->vj", rows, right)  # gradient of each view
    inverse = inverted((rows.mT @ rows).sum(axis=0))
    step = -inverse @ products.sum(axis=0)
    # Scatter of the views' gradients after the step, in place of that by the corners' noise.
    after = products + rows.mT @ rows @ step
    scatter = inverse @ (after.T @ after) @ inverse * (len(after) / max(len(after) - 1, 1))
    by_noise, by_views = inverse[n:, n:], scatter[n:, n:]
    ratio = float(np.trace(np.linalg.solve(by_noise, by_views))) / k
    covariance = by_noise * max(ratio, 1.0)
    value = step[n:]
    chi2 = float(value @ np.linalg.solve(covariance, value))
    focal = np.array([step[:n][fit.free == i].sum() for i in (0, 1)])
    return BoardDeviation(column.code, value, covariance, float(chdtrc(k, chi2)), focal)
