"""Confirmation of rejections by the other measurements: model averaging over what may be wrong.

An estimate with rejected measurements is one hypothesis. Alternative hypotheses are that one
rejected measurement is right, that all are right, or that one is right and an inlier is wrong; the
parameters differ accordingly. With the cost of a hypothesis a

    Q_a = (sum of squares of the inliers, at their best fit) + (loss of each rejected measurement)

as in the estimate's robust loss, its probability is p_a ~ exp(-Q_a / 2). Under hypothesis a the
tool is displaced by s_a from the estimate, so the tool's variance has to contain ``sum p_a s_a^2``.
Where that exceeds the stated variance, the data do not determine which measurement is wrong: one
that was rejected among seven with seven unknowns is as likely right as any other; one of thirty
that lies twenty standard deviations off is almost certainly wrong.

A rejection has to be confirmed by measurements, not by the nominal model, which the calibration is
to correct. So prior sigmas are multiplied by ``CONTRADICTION_SIGMAS`` here.

Hypotheses are solved to first order about the estimate, with each configuration's own unknowns
eliminated (Schur complement); a hypothesis changes the normal equations of one or two
configurations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.identify.assembly import Assembled
from pkmcal.identify.covariance import Information
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.problem import Problem
from pkmcal.identify.robust import as_pairs
from pkmcal.identify.unknowns import BatchState
from pkmcal.levels import CONTRADICTION_SIGMAS
from pkmcal.measurements import Measurements
from pkmcal.measurements.rows import RowGroups
from pkmcal.solver.kernels import INLIER_WEIGHT, NO_WEIGHT_DISTANCE, final_loss

NORMAL_RIDGE = 1e-12
"""Ridge on a normal matrix with unit diagonal, for directions that are not determined."""
MOST_REJECTED_UNITS = 50
"""Largest number of rejected units that are tested; where more are rejected, their share is itself
the reason not to use the result."""

IMAGE_ROW, LINK_ROW, DROPPED_LINK_ROW = -1, -2, -3
"""Values in place of a configuration, for units that are not poses: images, links, and links that a
hypothesis rejects."""


@dataclass(frozen=True)
class RejectedUnit:
    """A rejected unit of measurement: a height, a board, an image, a distance.

    pose : number among the measured poses, -1 for other units.
    station, configuration : of the unit; for a link -1 and its second configuration.
    right : posterior probability that the unit is not wrong.
    shift : root mean square displacement of the tool over the hypotheses in which it is right, m.
    link : number among the links, -1 for other units.
    """

    pose: int
    station: int
    configuration: int
    right: float = 0.0
    shift: float = 0.0
    link: int = -1

    @property
    def is_image(self) -> bool:
        """Whether the unit is the edges of an image."""
        return self.pose < 0 and self.link < 0


@dataclass(frozen=True)
class Rejections:
    """Rejected units of an estimate.

    shift : root mean square displacement of the tool over all hypotheses, m, to be added to its
        stated standard deviation.
    """

    units: tuple[RejectedUnit, ...] = ()
    shift: float = 0.0


class _Normal(NamedTuple):
    """Reduced normal equations of n configurations or hypotheses.

    matrix, gradient, squares : (n, na, na), (n, na), and sums of squares (n,).
    """

    matrix: Array
    gradient: Array
    squares: Array

    def plus(self, other: _Normal, times: float = 1.0) -> _Normal:
        """Sum with a multiple of other normal equations."""
        return _Normal(*(a + times * b for a, b in zip(self, other, strict=True)))

    def at(self, which: Integers | slice) -> _Normal:
        """Normal equations of some configurations or hypotheses."""
        return _Normal(*(part[which] for part in self))

    def solution(self) -> tuple[Array, Array]:
        """Minimal sums of squares (n,), and the steps (n, na) to the minima."""
        scale = np.sqrt(np.einsum("...ii->...i", self.matrix))
        scale = np.where(scale > 0, scale, 1.0)
        unit = self.matrix / scale[..., None] / scale[..., None, :]
        unit = unit + NORMAL_RIDGE * np.eye(unit.shape[-1])
        step = -np.linalg.solve(unit, (self.gradient / scale)[..., None])[..., 0] / scale
        return self.squares + np.sum(step * self.gradient, axis=-1), step


def rejected_units(measurements: Measurements, estimate: Estimate) -> tuple[RejectedUnit, ...]:
    """Measured poses and links with less than half of their weight, and images with a majority of
    rejected edges.
    """
    poses, edges = measurements.poses, measurements.edges
    lost = np.flatnonzero(estimate.pose_weights < INLIER_WEIGHT).tolist()
    out = [RejectedUnit(k, int(poses.station[k]), int(poses.configuration[k])) for k in lost]
    image = np.stack([edges.station, edges.configuration], axis=1)
    image, own = np.unique(image, axis=0, return_inverse=True)
    rejected = np.bincount(own.ravel(), estimate.edge_weights < INLIER_WEIGHT, len(image))
    every = np.bincount(own.ravel(), minlength=len(image))
    out += [RejectedUnit(-1, int(s), int(c)) for s, c in image[2 * rejected > every]]
    lost = np.flatnonzero(estimate.link_weights < INLIER_WEIGHT).tolist()
    ends = measurements.link_ends
    out += [RejectedUnit(-1, -1, int(ends[k, 1]), link=k) for k in lost]
    return tuple(out)


def rejections_of(measurements: Measurements, estimate: Estimate, tool: Array) -> Rejections:
    """Rejected units of an estimate, each with the probability that it is right.

    tool : (n, P) such that ``norm(tool @ v)`` is the tool's root mean square displacement by a
    change v of the parameters, m.
    """
    units = rejected_units(measurements, estimate)
    if not units:
        return Rejections()
    # problem at the solution, with wider priors
    assembled, info = estimate.linearized
    drawn = np.array(assembled.priors) == "nominal"
    wider = np.where(drawn, 1 / CONTRADICTION_SIGMAS, 1.0)
    problem, state = info.problem, info.state
    problem = replace(
        problem, prior=wider[:, None] * problem.prior, prior_target=wider * problem.prior_target
    )
    cases = _Cases.of(assembled, problem, state, measurements, estimate, units)
    least, step = cases.base.solution()
    rows = tool @ problem.free
    cost, shift, member = list[Array](), list[Array](), list[Integers]()

    def add(case: _Normal, loss: Array, of: Integers) -> None:
        """Append hypotheses.

        loss : (n,) loss relative to the estimate. of : (n,) number of the readmitted unit, -1 for
            all.
        """
        solution, to = case.solution()
        away = (to - step)[:, problem.unknowns.machine] @ rows.T
        cost.append(solution - least + loss)
        shift.append(np.sqrt(np.sum(away**2, axis=1)))
        member.append(of)

    # one rejected unit is right
    each = np.arange(len(cases.readmission.squares))
    single = cases.base.plus(cases.readmission)
    add(single, -cases.loss, each)
    # all of them are right
    if len(each) > 1:
        whole = cases.readmission.at(slice(None))
        total = _Normal(*(part.sum(axis=0, keepdims=True) for part in whole))
        add(cases.base.plus(total), -cases.loss.sum(keepdims=True), np.array([-1]))
    # one of them is right and an inlier is wrong
    for dropped, loss, row in cases.drops(state):
        for k in each:
            other = row != cases.row[k]
            case = single.at(slice(k, k + 1)).plus(dropped.at(other))
            add(case, loss[other] - cases.loss[k], np.full(int(other.sum()), k))
    # posterior probabilities, normalized together with that of the estimate itself
    costs, shifts, of = (np.concatenate(part) for part in (cost, shift, member))
    best = min(float(costs.min(initial=0.0)), 0.0)
    weight = np.exp(-(costs - best) / 2)
    share = weight / (weight.sum() + np.exp(best / 2))
    out: list[RejectedUnit] = []
    for k in each:
        mine = (of == k) | (of < 0)
        shifted = float(np.sqrt(np.sum(share[mine] * shifts[mine] ** 2)))
        out.append(replace(units[k], right=float(share[mine].sum()), shift=shifted))
    elsewhere = float(np.sqrt(np.sum(share * shifts**2)))
    return Rejections((*out, *units[len(out) :]), elsewhere)


class _Cases(NamedTuple):
    """Terms of the normal equations from which hypotheses are composed.

    base : normal equations of the estimate (1).
    readmission : change of the normal equations by each readmitted unit (n).
    loss : (n,) loss of each unit while rejected.
    row : (n,) configuration of each pose in the problem; IMAGE_ROW for images, LINK_ROW for links.
    in_use, losses : (K, G) of poses and of links: whether each is in use, and its loss if rejected.
    """

    problem: Problem
    base: _Normal
    readmission: _Normal
    loss: Array
    row: Integers
    in_use: RowGroups[Booleans]
    losses: RowGroups[Array]

    @classmethod
    def of(
        cls,
        assembled: Assembled,
        problem: Problem,
        state: BatchState,
        measurements: Measurements,
        estimate: Estimate,
        units: tuple[RejectedUnit, ...],
    ) -> _Cases:
        """Terms of an estimate's problem."""
        # normal equations of the estimate
        value, rows = problem.prior_values(state)[0] - problem.prior_target, problem.prior
        base = _Normal((rows.T @ rows)[None], (rows.T @ value)[None], np.sum(value**2)[None])
        for cut in problem.cuts:
            part = _normal_equations(problem.among(cut), problem.state_among(state, cut))
            base = base.plus(_Normal(*(x.sum(axis=0, keepdims=True) for x in part)))
        # weights in use, and losses of rejected measurements
        full = float(final_loss(np.array(NO_WEIGHT_DISTANCE)))
        losses = RowGroups(
            *(full / np.maximum(as_pairs(kind), 1e-9) ** 2 for kind in problem.row_groups)
        )
        edges = measurements.edges
        # weight, loss and configuration of each unit
        changes, loss, rows = list[_Normal](), list[float](), list[int]()
        for unit in units[:MOST_REJECTED_UNITS]:
            weight = RowGroups(*(kind.weight.copy() for kind in problem.row_groups))
            if not unit.is_image:
                of_links = unit.link >= 0
                places = assembled.places.links if of_links else assembled.places.poses
                number = unit.link if of_links else unit.pose
                row, place = int(places.row[number]), int(places.place[number])
                if of_links:
                    weight.links[0, row, place] = 1 / estimate.statistics.link_scale**2
                else:
                    weight.poses[0, row, place] = 1 / estimate.statistics.pose_scale**2
                loss.append(float((losses.links if of_links else losses.poses)[row, place]))
                rows.append(LINK_ROW if of_links else row)
            else:
                own = (edges.station == unit.station) & (edges.configuration == unit.configuration)
                own = np.flatnonzero(own & (estimate.edge_weights < INLIER_WEIGHT))
                places = assembled.places.edges
                row = int(places.row[own[0]])
                weight.edges[0, places.row[own], places.place[own]] = 1.0
                loss.append(full * len(own))
                rows.append(IMAGE_ROW)
            # change of the normal equations of its configuration
            cut = slice(row, row + 1)
            there = problem.state_among(state, cut)
            new = problem.weighted(weight).among(cut)
            changes.append(
                _normal_equations(new, there).plus(
                    _normal_equations(problem.among(cut), there), -1.0
                )
            )
        readmission = _Normal(*(np.concatenate(x) for x in zip(*changes, strict=True)))
        in_use = RowGroups(*(kind.present & (kind.weight[0] > 0) for kind in problem.row_groups))
        return cls(problem, base, readmission, np.array(loss), np.array(rows), in_use, losses)

    def drops(self, state: BatchState) -> Iterator[tuple[_Normal, Array, Integers]]:
        """Changes of the normal equations if one more pose or link is rejected.

        Yields, for groups of n hypotheses, the changes, the losses (n,), and the configurations
        (n,) in the problem, DROPPED_LINK_ROW for links.
        """
        if not (self.row != IMAGE_ROW).any():
            return
        for cut in self.problem.cuts:
            part, there = self.problem.among(cut), self.problem.state_among(state, cut)
            before = _normal_equations(part, there)
            weights = RowGroups(*(kind.weight for kind in part.row_groups))
            for name in ("poses", "links"):
                used, losses = getattr(self.in_use, name), getattr(self.losses, name)
                for place in range(used.shape[1]):
                    in_use = np.flatnonzero(used[cut, place])
                    if not in_use.size:
                        continue
                    weight = getattr(weights, name).copy()
                    weight[:, :, place] = 0.0
                    without = part.weighted(weights._replace(**{name: weight}))
                    change = _normal_equations(without, there).plus(before, -1.0)
                    row = np.arange(len(used))[cut][in_use]
                    # a link's row has no own unknowns, so its change adds to that of any unit
                    of = row if name == "poses" else np.full(len(row), DROPPED_LINK_ROW)
                    yield change.at(in_use), losses[row, place], of


def _normal_equations(problem: Problem, state: BatchState) -> _Normal:
    """Reduced normal equations of each configuration."""
    reduced = Information(problem, state).reduced
    rows, value = reduced.rows[0], reduced.value[0]
    return _Normal(rows.mT @ rows, (rows.mT @ value[..., None])[..., 0], np.sum(value**2, axis=-1))
