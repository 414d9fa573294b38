"""Model discrepancy: errors of the model, as random effects with estimated scales.

A *component* is a family of functions that could be missing from the model, for example errors of
the readings that vary smoothly over the workspace. Each function is a column G of derivatives of
all rows, in standard deviations, and its coefficient is random, ``w ~ N(0, s^2 L L^T)`` with a
known L.

Evidence
--------
With J the Jacobian at the solution, r its residuals, ``H = (I - J J^+) G`` the columns projected
orthogonally to the unknowns, ``h = H^T r`` and ``M = H^T H``,

    h ~ N(0, M + s^2 M L L^T M)

so s has a restricted likelihood (REML; Patterson and Thompson 1971). A component is accepted if its
likelihood ratio exceeds the threshold of a level that all components share. Under the model the
ratio has the distribution of half a chi-square variable of one degree of freedom, since s cannot be
negative (Self and Liang 1987). Components are selected forward: the one with the largest ratio is
added first, and each further one is tested beside those before it. Named model violations take
part, each as a component of its own: a violation that explains more than the smooth functions is
selected before them; otherwise nothing remains for it to explain.

Where the estimate has enlarged the noise of readings or poses, the reason may be the discrepancy.
The two explanations are compared by the restricted likelihood of both, and components of the
readings, or poses, then need no further evidence, because the enlarged noise has established that
the model is incomplete: the covariance contains them. They are reported as a discrepancy (``sure``)
only if they explain the data better than noise alone, at the same level.

A height is one number per configuration, and a smooth surface can reproduce almost any effect of a
violation on heights. So a violation takes part only if the data are significantly better explained
with it than by smooth functions and noise. The stated noise of a probe is often a guess, and too
large a value hides the surface: smaller values are tried too, and then the whole discrepancy has to
be significant.

Covariance
----------
The discrepancy has changed the unknowns by ``J^+ G w``. With m and C the posterior mean and
covariance of w, the mean square of that change is

    J^+ G (m m^T + C) (J^+ G)^T

and is added to the unknowns' covariance. For functions that the data determine, this is the effect
of their estimates. Functions that the unknowns absorb keep their prior variance, with the scale
estimated from the other functions of their component (Kennedy and O'Hagan 2001).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.assembly import Assembled
from pkmcal.identify.covariance import Information
from pkmcal.identify.false_alarm import SESSION_FALSE_ALARM, FalseAlarm, Search
from pkmcal.identify.row_sums import POSE_ROWS, READING_ROWS
from pkmcal.identify.score import (
    columns_of,
    eliminate_beside,
    shared_basis,
)
from pkmcal.levels import RELEVANT_FACTOR
from pkmcal.measurements import Column
from pkmcal.solver.elimination import divisions

NAMED = "named."
"""Prefix of the codes of named violations."""
COLUMNS_BY_UNKNOWNS = 4
"""Columns of all components, over those of the unknowns: the rows are processed in pieces smaller
by this factor, in the same memory."""


@dataclass(frozen=True)
class DiscrepancyOptions:
    """Constants of the search."""

    # level of the session; components share the part of Search.DISCREPANCY
    false_alarm: FalseAlarm = SESSION_FALSE_ALARM
    # factor on a stated noise from which a discrepancy is considered as its cause
    enlarged: float = RELEVANT_FACTOR
    # number of noise levels tried then, from the stated noise to the noise in use
    noise_factors: int = 5
    # smallest factor on a probe's stated noise, and number of noise levels: new sessions state
    # 20 um, and good probes repeat to 2 um
    least_probe_noise: float = 0.1
    probe_noise_factors: int = 9
    # largest number of components of a session
    most: int = 4
    # number of scales s tried for each component, on a geometric grid from an effect far below the
    # noise to one far above it
    scales: int = 121
    # squared length of a column's projection relative to the column, below which it is rounding
    rank: float = 1e-10

    def least_ratio(self, components: int) -> float:
        """Threshold of twice the log likelihood ratio of one among ``components`` components."""
        from scipy.special import chdtri

        return float(chdtri(1.0, 2 * self.false_alarm.of_test(Search.DISCREPANCY, components)))


@dataclass(frozen=True)
class Component:
    """A family of k functions with one scale.

    column : derivatives of the measurements by the k coefficients.
    roots : candidate roots L (k, l) of the coefficients' covariance; the functions have a mean
        square of one over the session's configurations.
    inflates : kinds of rows whose noise such an error enlarges, such as READING_ROWS.
    lengths : correlation length of each root, m; empty for a component without one.
    """

    column: Column
    roots: tuple[Array, ...]
    inflates: tuple[int, ...] = ()
    lengths: tuple[float, ...] = ()

    @property
    def code(self) -> str:
        """Code of the component's column."""
        return self.column.code


@dataclass(frozen=True)
class ComponentScale:
    """A detected component.

    scale : s, in the unit of its functions.
    ratio : twice the log likelihood ratio against a model without the component.
    root : (k, l) the most likely of its roots L.
    length : correlation length of that root, m; None for a component without one.
    """

    code: str
    scale: float
    ratio: float
    root: Array
    length: float | None = None


@dataclass(frozen=True)
class Discrepancy:
    """Estimated model discrepancy.

    scales : detected components, in the order of their selection.
    shared : (na, na) addition to the covariance of the shared unknowns.
    columns : of the components, with their estimated priors.
    mean, covariance : (l,) and (l, l), posterior of the coefficients in prior standard deviations.
    sure : whether the components explain the data significantly better than larger noise does.
    """

    scales: tuple[ComponentScale, ...]
    shared: Array
    columns: tuple[Column, ...]
    mean: Array
    covariance: Array
    sure: bool = False


@dataclass(frozen=True)
class _Products:
    """Products of the columns G and of their projections H, c columns in all.

    squared : (c, c) M = H^T H.
    value : (c,) h = H^T r.
    gain : (na, c) J^+ G of the shared unknowns.
    whole : (c, c) G^T G, with the own unknowns eliminated.
    likelihood : log restricted likelihood without any component.
    """

    squared: Array
    value: Array
    gain: Array
    whole: Array
    likelihood: float


def no_discrepancy(info: Information) -> Discrepancy:
    """Discrepancy without components."""
    na = info.problem.unknowns.count
    return Discrepancy((), np.zeros((na, na)), (), np.zeros(0), np.zeros((0, 0)))


def discrepancy_of(
    assembled: Assembled,
    info: Information,
    components: Sequence[Component],
    named: Sequence[Column] = (),
    enlarged: tuple[float, float] = (1.0, 1.0),
    heights: bool = False,
    options: DiscrepancyOptions = DiscrepancyOptions(),
) -> Discrepancy:
    """Estimate the discrepancy at a solution, for the problem's first run.

    named : columns of the detected model violations. They compete as components of their own, and
        the part of the data that they explain is not in the result.
    enlarged : factors in use on the stated noise of the readings and of the poses.
    heights : whether only heights were measured.
    """
    # violations compete with the smooth components, with one scale each
    rivals = [
        Component(replace(column, code=f"{NAMED}{k}"), (np.eye(column.count),))
        for k, column in enumerate(named)
    ]
    every = [*components, *rivals]
    columns = [one.column for one in every]
    ends = np.cumsum([0, *(column.count for column in columns)]).tolist()
    parts = [slice(*ends[k : k + 2]) for k in range(len(every))]
    at_solution = _products(assembled, info, columns)
    # products at the noise in use, and at the other noise levels
    kind = (READING_ROWS, POSE_ROWS)[int(np.argmax(enlarged))]
    inflated = kind if max(enlarged) > options.enlarged else None
    noises = [at_solution]
    for of_readings, of_poses in _noise_shares(enlarged, heights, options):
        # the problem with the noise of readings, and of poses, multiplied by a factor each
        problem = assembled.problem
        poses = replace(problem.pose_data, weight=problem.pose_data.weight / of_poses**2)
        noise = problem.joint_noise * of_readings
        problem = replace(problem, joint_noise=noise, pose_data=poses)
        other = replace(assembled, problem=problem)
        noises.append(_products(other, Information(problem, info.state), columns))
    # selection from all components, smooth ones, violations, none; each at its most likely noise
    smooth_end = len(components)
    best, smooth, named_only, noise_alone = (
        max(
            (_Search(products, *which, options, inflated) for products in noises),
            key=lambda one: one.likelihood,
        )
        for which in (
            (every, parts),
            (components, parts[:smooth_end]),
            (rivals, parts[smooth_end:]),
            ((), ()),
        )
    )
    # evidence against noise alone, without the part of the violations
    beyond = options.least_ratio(len(every))
    # ratio against noise alone, without the part of the violations
    named_ratios = [one.ratio for one in best.scales if one.code.startswith(NAMED)]
    log_likelihood_ratio = 2 * (best.likelihood - noise_alone.likelihood) - sum(named_ratios)
    if heights:
        # heights: violations take part only if needed beside the smooth functions
        needless = 2 * (best.likelihood - smooth.likelihood) <= beyond
        best, against = (smooth, noise_alone) if needless else (best, named_only)
        log_likelihood_ratio = 2 * (best.likelihood - against.likelihood)
    sure = log_likelihood_ratio > beyond
    scales = tuple(one for one in best.scales if not one.code.startswith(NAMED))
    if not scales or (heights and inflated is None and not sure):
        return no_discrepancy(info)
    # scales by the most likely noise, gains by the weights of the estimate; without the violations
    unnamed = ~np.any(best.root[ends[smooth_end] :], axis=0)
    root = best.root[: ends[smooth_end], unnamed]
    gain = at_solution.gain[:, : ends[smooth_end]] @ root
    mean, covariance = best.coefficients
    mean, covariance = mean[unnamed], covariance[np.ix_(unnamed, unnamed)]
    spread = gain @ (np.outer(mean, mean) + covariance) @ gain.T
    by_code = {one.code: one.column for one in components}
    columns = tuple(replace(by_code[one.code], prior=one.scale * one.root) for one in scales)
    return Discrepancy(scales, spread, columns, mean, covariance, sure)


class _Search:
    """Forward selection of components.

    root : (c, l) prior root of the coefficients of all columns, for the selected components.
    gain : increase of the log likelihood.
    """

    def __init__(
        self,
        products: _Products,
        components: Sequence[Component],
        parts: Sequence[slice],
        options: DiscrepancyOptions,
        enlarged: int | None,
    ) -> None:
        """Select components.

        enlarged : kind of rows whose noise is enlarged, None if there is none.
        """
        self.products, self.components, self.parts = products, components, parts
        self.options = options
        self.scales: list[ComponentScale] = []
        self.gain = 0.0
        self.root = np.zeros((len(products.value), 0))
        beyond = self.options.least_ratio(len(self.components))
        named = sum(one.code.startswith(NAMED) for one in self.components)
        while len(self.scales) < self.options.most + named:
            # scale and likelihood ratio of each remaining component, with each of its roots
            squared, value = self._remainder()
            codes = {one.code for one in self.scales}
            best: ComponentScale | None = None
            for one, part in zip(self.components, self.parts, strict=True):
                if one.code in codes:
                    continue
                for k, root in enumerate(one.roots):
                    scale, ratio = self._scale(
                        root.T @ squared[part, part] @ root,
                        root.T @ value[part],
                        root.T @ self.products.whole[part, part] @ root,
                    )
                    least = 0.0 if enlarged in one.inflates else beyond
                    if ratio > least and (best is None or ratio > best.ratio):
                        length = one.lengths[k] if one.lengths else None
                        best = ComponentScale(one.code, scale, ratio, root, length)
            if best is None:
                return
            # the most likely one becomes part of the noise
            self.scales.append(best)
            self.gain += best.ratio / 2
            (k,) = (k for k, one in enumerate(self.components) if one.code == best.code)
            more = np.zeros((len(self.root), best.root.shape[1]))
            more[self.parts[k]] = best.scale * best.root
            self.root = np.concatenate([self.root, more], axis=1)

    def _remainder(self) -> tuple[Array, Array]:
        """M and h of all columns, with the selected components as part of the noise."""
        n = len(self.root)
        squared, value = self.products.squared[:n, :n], self.products.value[:n]
        across = squared @ self.root
        inverse = self._posterior
        return squared - across @ inverse @ across.T, value - across @ (
            inverse @ (self.root.T @ value)
        )

    @property
    def _posterior(self) -> Array:
        """Posterior covariance (l, l) of the selected coefficients, in prior standard
        deviations.
        """
        n = len(self.root)
        information = self.root.T @ self.products.squared[:n, :n] @ self.root
        return np.linalg.inv(np.eye(len(information)) + information)

    @property
    def likelihood(self) -> float:
        """Logarithm of the restricted likelihood with the selected components."""
        return self.products.likelihood + self.gain

    @property
    def coefficients(self) -> tuple[Array, Array]:
        """Posterior mean (l,) and covariance (l, l) of the selected coefficients, in prior standard
        deviations.
        """
        covariance = self._posterior
        return -covariance @ (self.root.T @ self.products.value[: len(self.root)]), covariance

    def _scale(self, squared: Array, value: Array, whole: Array) -> tuple[float, float]:
        """Maximum-likelihood scale, 0 for none, and twice its log likelihood ratio."""
        m, vectors = np.linalg.eigh((squared + squared.T) / 2)
        visible = m > self.options.rank * float(np.trace(whole))
        m, z = m[visible], vectors[:, visible].T @ value
        if not m.size:
            return 0.0, 0.0
        # grid of s^2: from a negligible effect of the best observable function to a dominant
        # effect of the worst one
        square = np.geomspace(1e-3 / m[-1], max(1e3 / m[0], 1e-2 / m[-1]), self.options.scales)
        load = square[:, None] * m
        ratio = np.sum(z**2 / m * load / (1 + load) - np.log1p(load), axis=1)
        best = int(np.argmax(ratio))
        return (float(np.sqrt(square[best])), float(ratio[best])) if ratio[best] > 0 else (0.0, 0.0)


def _noise_shares(
    enlarged: tuple[float, float], heights: bool, options: DiscrepancyOptions
) -> list[tuple[float, float]]:
    """Factors on the noise in use, of readings and of poses, to try beside (1, 1).

    They reach down to the stated noise of the kind that is enlarged most; for heights of both
    kinds, and of the probe further.
    """
    count = options.noise_factors
    if heights:
        low = 1 / enlarged[0], options.least_probe_noise / enlarged[1]
        count = options.probe_noise_factors
    elif max(enlarged) > options.enlarged:
        most = int(np.argmax(enlarged))
        low = tuple(1 / enlarged[k] if k == most else 1.0 for k in range(2))
    else:
        return []
    readings, poses = (np.geomspace(end, 1, count)[:-1].tolist() for end in low)
    return list(zip(readings, poses, strict=True))


def _products(assembled: Assembled, info: Information, listed: Sequence[Column]) -> _Products:
    """Products of the columns, and the restricted likelihood without them."""
    problem, basis = assembled.problem, shared_basis(info)
    columns = columns_of(assembled, info.state, [_as_motion(assembled, one) for one in listed])
    n, count = sum(one.count for one in listed), problem.unknowns.count
    squared, by_basis, value = np.zeros((n, n)), np.zeros((n, basis.shape[1])), np.zeros(n)
    in_basis, remainder, own_scale = np.zeros(basis.shape[1]), 0.0, 0.0
    configurations, n_rows = problem.extent
    # sums over the configurations, own unknowns eliminated
    for cut in divisions(configurations, n_rows * COLUMNS_BY_UNKNOWNS, problem.rows_at_once):
        piece = Information(problem.among(cut), problem.state_among(info.state, cut))
        linear = piece.linear
        rows, residuals = eliminate_beside(linear, columns(cut, linear))
        own, extra = rows[..., :count] @ basis, rows[..., count:].reshape(-1, n)
        own, residuals = own.reshape(-1, basis.shape[1]), residuals.ravel()
        if not cut.start:
            own = np.concatenate([own, linear.shared_by @ basis])
            extra = np.pad(extra, ((0, len(linear.shared_by)), (0, 0)))
            residuals = np.append(residuals, linear.shared_value[0])
        squared += extra.T @ extra
        by_basis += extra.T @ own
        value += extra.T @ residuals
        in_basis += own.T @ residuals
        remainder += float(residuals @ residuals)
        diagonal = np.einsum("bkii->bki", piece.reduced.r)
        own_scale += float(np.sum(np.log(np.maximum(np.abs(diagonal), 1e-300))))
    # terms of the log restricted likelihood: determinants of own and shared unknowns, noise,
    # residuals
    scale = own_scale + _log_scale(info) + _log_noise(assembled)
    return _Products(
        squared - by_basis @ by_basis.T,
        value - by_basis @ in_basis,
        basis @ by_basis.T,
        squared,
        -scale - (remainder - float(in_basis @ in_basis)) / 2,
    )


def _log_scale(info: Information) -> float:
    """Half of the log determinant of the shared unknowns' information, over identifiable
    directions.
    """
    rows = info.rows[0][0]
    length = np.linalg.norm(rows, axis=0)
    used = length > 0
    s = np.linalg.svd(rows[:, used] / length[used], compute_uv=False)
    s = s[s > 1e-12 * s[0]]
    return float(np.sum(np.log(s)) + np.sum(np.log(length[used])))


def _log_noise(assembled: Assembled) -> float:
    """Sum of the log standard deviations of all readings and poses, up to a constant."""
    problem = assembled.problem
    readings = problem.blocks.present.shape[0] * problem.layout.n_readings
    out = readings * float(np.log(problem.joint_noise[0]))
    kind = problem.row_groups.poses
    used = kind.present & (kind.weight[0] > 0)
    return out - float(np.sum(0.5 * kind.count[used] * np.log(kind.weight[0][used])))


def _as_motion(assembled: Assembled, column: Column) -> Column:
    """Column of a moved station as a motion of each configuration."""
    if column.station is None:
        return column
    unknowns = assembled.problem.unknowns
    motion = np.zeros((unknowns.n_stations, len(assembled.observed), 6, 6))
    motion[column.station, column.since :] = np.eye(6)
    return Column(column.code, motion=motion)
