"""Results of a study for each combination, and the gain by each varied name.

Runs of a batch share a capture plan, so standard errors are clustered by batch: they use the
squares of the batches' sums of deviations rather than of single runs. Failed runs are counted and
excluded from all other figures.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers, short_repr
from pkmcal.studies.calibrations import JOINT_ESTIMATE_KEY
from pkmcal.studies.engine import StudyResult, batches
from pkmcal.studies.statistics import Summary, covered
from pkmcal.studies.sweep import (
    Cell,
    StudySubject,
    SweptSetting,
    Value,
)
from pkmcal.wording import brief, count, decimals, number

PROMISED_COVERAGE = 0.95
COVERAGE_TOLERANCE = 0.02
"""Accepted deviation of the coverage of 95 % intervals: 93 to 97 %, as required of a
calibration.
"""
COVERAGE_INTERVALS = np.array([0.5, 0.68, 0.8, 0.9, 0.95, 0.99])
"""Nominal coverages for which the actual coverage is reported."""


LEAST_FREEDOM = 3
"""Degrees of freedom from which Student's distribution has a standard deviation."""


@dataclass(frozen=True)
class CellFindings:
    """Summary of the runs of one combination.

    runs : number of runs.
    freedom : degrees of freedom of the standard errors; less than one if fewer than two runs are
        usable.
    failed : share of runs that did not converge or had to be refused.
    position, orientation : root mean square of the tool's error over the workspace, m and rad; with
        ``_95`` its 95th percentile, with ``_sigma`` the mean of the stated standard deviation.
    covered, covered_tool : share of 95 % intervals that contain the truth, for the parameters and
        for the tool's pose.
    held, held_tool : (n,) the same for the intervals of COVERAGE_INTERVALS.
    chi2 : per degree of freedom.
    parameters : (P,) names.
    by_parameter : (P,) coverage of each parameter's 95 % intervals; NaN for those without a
        standard deviation.
    """

    values: Mapping[str, Value]
    runs: int
    freedom: int
    failed: Summary
    position: Summary
    orientation: Summary
    position_95: float
    orientation_95: float
    position_sigma: float
    orientation_sigma: float
    covered: Summary
    covered_tool: Summary
    held: Array
    held_tool: Array
    chi2: float
    parameters: tuple[str, ...]
    by_parameter: Array

    __repr__ = short_repr

    def with_usable_error(self, summary: Summary) -> Summary:
        """Figure of this combination, whose standard error is NaN if it means nothing.

        The deviation over its standard error has Student's distribution, which has no standard
        deviation with fewer than three degrees of freedom.
        """
        error = summary.error if self.freedom >= LEAST_FREEDOM else np.nan
        return Summary(summary.value, error)

    @property
    def honest(self) -> bool | None:
        """Whether the coverage of 95 % intervals is at least 93 %, within its Monte-Carlo error.

        The limit of the error is Student's two-sided 95 % limit. None if fewer than two runs are
        usable.
        """
        from scipy.special import stdtrit

        if self.freedom < 1:
            return None
        few = float(stdtrit(self.freedom, 0.975))
        return all(
            s.value + few * s.error >= PROMISED_COVERAGE - COVERAGE_TOLERANCE
            for s in (self.covered, self.covered_tool)
        )


class Gain(NamedTuple):
    """Effect of a varied name on the tool's position error, from its worst to its best value.

    before, after : root mean squares (m) over all combinations with the worst and the best value.
    sure : whether the difference exceeds chance.
    """

    name: str
    worst: Value
    best: Value
    before: float
    after: float
    sure: bool

    @property
    def times(self) -> float:
        """Ratio of ``before`` to ``after``."""
        return self.before / self.after


@dataclass(frozen=True)
class SweepResult:
    """Result of a study.

    subject : what was studied.
    varied : names with their values.
    cells, results : combinations and their runs.
    found : summaries of the combinations.
    runs : number of runs for each combination.
    """

    subject: StudySubject
    varied: Mapping[str, tuple[Value, ...]]
    cells: tuple[Cell, ...]
    results: tuple[StudyResult[SweptSetting], ...]
    found: tuple[CellFindings, ...]
    runs: int
    seed: int

    __repr__ = short_repr

    def summary(self) -> str:
        """Text that the command prints, one line for each combination: the tool's error over the
        workspace with its standard error, the stated standard deviation, the coverage of 95 %
        intervals, and the share of failed runs.
        """
        lines = [f"{self.subject.name}, {count(self.runs, 'calibration')} a combination"]
        for cell in self.found:
            error = with_error(cell.with_usable_error(cell.position).times(1e3))
            lines.append(
                f"  {self.subject.in_words(cell.values) or 'as it is'}: tool {error} mm,"
                f" stated {brief(1e3 * cell.position_sigma)} mm,"
                f" {number(100 * cell.covered.value, 1)} % of the 95 % intervals hold,"
                f" {number(100 * cell.failed.value, 1)} % failed"
            )
        return "\n".join(lines)

    @property
    def wall(self) -> float:
        """Duration of the study in seconds."""
        return self.results[0].wall

    @property
    def workers(self) -> int:
        """Number of workers."""
        return self.results[0].workers

    @property
    def gains(self) -> list[Gain]:
        """Gains of the names with two usable values or more, largest first."""
        gains = (self._gain(name) for name in self.varied)
        return sorted((gain for gain in gains if gain), key=lambda g: -g.times)

    def _gain(self, name: str) -> Gain | None:
        """Gain by one name; None with fewer than two usable values."""
        means = {value: self.at(name, value) for value in self.varied[name]}
        means = {value: mean for value, mean in means.items() if np.isfinite(mean.value)}
        if len(means) < 2:
            return None
        best, worst = (end(means, key=lambda v: means[v].value) for end in (min, max))
        before, after = means[worst], means[best]
        freedom = min(cell.freedom for cell in self.found if np.isfinite(cell.position.value))
        pairs = len(means) * (len(means) - 1) // 2
        sure = before.value - after.value > _chance_difference(
            before.error, after.error, freedom, pairs
        )
        return Gain(name, worst, best, before.value, after.value, sure)

    def at(self, name: str, value: Value) -> Summary:
        """Tool's position error with one value of a name, root mean square over all other
        combinations.
        """
        own = [cell.position for cell in self.found if cell.values[name] == value]
        square = float(np.mean([s.value**2 for s in own]))
        error = np.sqrt(np.sum([(s.value * s.error) ** 2 for s in own])) / len(own)
        return Summary(float(np.sqrt(square)), float(error / max(np.sqrt(square), 1e-300)))


def findings_of(cell: Cell, result: StudyResult[SweptSetting]) -> CellFindings:
    """Summary of the runs of one combination; NaN where all of them failed."""
    sample = result.samples[JOINT_ESTIMATE_KEY]
    values, sigma = sample.values, sample.sigma
    sizes = [batch.runs for batch in batches(result.setting, result.runs, result.seed)]
    batch = np.repeat(np.arange(len(sizes)), sizes)
    good = values["failed"] == 0
    groups = len(np.unique(batch[good]))

    # Figures of the runs that did not fail.
    def summed(name: str) -> Summary:
        return clustered(values[name][good], batch[good])

    def rooted(name: str) -> Summary:
        square = clustered(values[name][good] ** 2, batch[good])
        root = float(np.sqrt(square.value))
        return Summary(root, square.error / (2 * max(root, 1e-300)))

    # Errors and standard deviations of parameters (e, s) and of the tool (t, st).
    e, s = values["parameters"][good], sigma["parameters"][good]
    t, st = values["tool"][good], sigma["tool"][good]
    parts = t.reshape(*t.shape[:-1], 2, 3)
    size = np.sqrt(np.where(np.isfinite(parts).any(-1), np.nansum(parts**2, axis=-1), np.nan))
    return CellFindings(
        values=cell.values,
        runs=result.runs,
        freedom=(groups if groups > 1 else int(good.sum())) - 1,
        failed=clustered(values["failed"], batch),
        position=rooted("position"),
        orientation=rooted("orientation"),
        position_95=_percentile(size[:, :, 1]),
        orientation_95=_percentile(size[:, :, 0]),
        position_sigma=summed("position_sigma").value,
        orientation_sigma=summed("orientation_sigma").value,
        covered=summed("covered"),
        covered_tool=summed("covered_tool"),
        held=np.array([_mean(covered(e, s, float(share))) for share in COVERAGE_INTERVALS]),
        held_tool=np.array([_mean(covered(t, st, float(share))) for share in COVERAGE_INTERVALS]),
        chi2=_mean(values["chi2"][good]),
        parameters=tuple(name for name, _ in result.setting.parameters),
        by_parameter=np.where(np.isfinite(s).any(axis=0), covered(e.T, s.T), np.nan),
    )


def with_error(summary: Summary) -> str:
    """Value, with its standard error if that is finite, in decimals that show at least one digit of
    each.
    """
    value, error = summary
    if not np.isfinite(error):
        return brief(value)
    places = max(decimals(value), decimals(error) - 1 if error > 0 else 0)
    return f"{number(value, places)} ± {number(error, places)}"


def clustered(values: Array, batch: Integers) -> Summary:
    """Mean of values (B,) and its standard error, clustered by batch (B,).

    With a single batch the standard error is that of independent runs. It is NaN for a single run,
    and the mean is NaN without any.
    """
    if len(values) < 2:
        return Summary(float(values[0]) if len(values) else np.nan, np.nan)
    mean, groups = float(values.mean()), len(np.unique(batch))
    if groups == 1:
        batch, groups = np.arange(len(values)), len(values)
    sums = np.bincount(batch, weights=values - mean)
    spread = float(np.sqrt(np.sum(sums**2))) / len(values)
    return Summary(mean, spread * float(np.sqrt(groups / (groups - 1))))


def _chance_difference(one: float, other: float, freedom: int, pairs: int) -> float:
    """Difference of two means with these standard errors that chance exceeds in 5 % of the cases.

    freedom : degrees of freedom of each standard error. pairs : number of compared pairs, of which
    the largest difference counts (Welch 1947; Bonferroni).
    """
    from scipy.special import stdtrit

    variance = one**2 + other**2
    if not variance > 0:  # NaN if a standard error is that of a single run
        return 0.0 if variance == 0 else np.inf
    dof = freedom * variance**2 / (one**4 + other**4)
    return float(stdtrit(dof, 1 - 0.025 / pairs) * np.sqrt(variance))


def _percentile(values: Array) -> float:
    values = values[np.isfinite(values)]
    return float(np.percentile(values, 95)) if values.size else float("nan")


def _mean(values: Array) -> float:
    return float(values.mean()) if values.size else float("nan")
