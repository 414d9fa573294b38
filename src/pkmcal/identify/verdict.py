"""Verdict on an estimate: whether it may be used, with reasons, warnings and advice as findings."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.centres import free_of_gauge, joint_centres
from pkmcal.identify.estimate import Estimate, Purpose
from pkmcal.identify.false_alarm import SESSION_FALSE_ALARM
from pkmcal.identify.gauge import freedoms, generators
from pkmcal.identify.sentences import negligible_shift
from pkmcal.identify.tool import centres_and_tool, platform_sigma
from pkmcal.identify.unidentified import Identification
from pkmcal.levels import (
    CONTRADICTION_SIGMAS,
    FEW,
    MAJORITY,
    NEARLY_ALL,
    NEGLIGIBLE,
    NOISE_EXCESS,
    ROUNDING,
    UNEXPLAINED_SCALE,
)
from pkmcal.measurements import OWN_SHADING, Observation
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.kinematics import NEAR_SINGULAR, on_manifold
from pkmcal.outcome import Verdict
from pkmcal.outcome.finding import Finding, Level, doubtful, finding, note, wrong
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.solver.search import Stop
from pkmcal.wording import amount, in_full, listed

if TYPE_CHECKING:
    from pkmcal.identify.bed import Bed

POLISHED_SHADING = UNEXPLAINED_SCALE * OWN_SHADING
"""Shading of each edge in addition to its line, px, above which tubes look like polished metal, or
are in hard light: 0.07 to 0.26 on path-traced machines of metal, 0.005 to 0.05 on painted
ones."""


@dataclass(frozen=True)
class VerdictOptions:
    """Limits of a result that may be used.

    The platform's standard deviation is :func:`~pkmcal.identify.tool.platform_sigma`, of all its
    joints, and not the mean at its origin that the headline has.
    """

    # noise scale above which the model does not explain the measurements
    too_noisy: float = UNEXPLAINED_SCALE
    # share of rejected measurements beyond which the noise of the others is not known: 0.37. The
    # search begins with the noise by the median of the norms of residuals. With a share e of
    # outliers, however far away, that is the quantile q = 1 / (2 (1 - e)) of the others (the
    # median's maximum bias: P. J. Huber, Robust Statistics, 1981), which relative to their median
    # is the root of -log2(1 - q) for the norm of the two normal errors of an edge: NOISE_EXCESS
    # here. All kinds have this limit of edges; by the same quantile it would be 0.27 for a distance
    # (one number), 0.41 for three numbers, and 0.47 for a board's pose (six)
    too_many_rejected: float = 1 - MAJORITY / (1 - 2 ** -(NOISE_EXCESS**2))
    # limit of the undetermined part of the platform's error by the nominal model. A calibration
    # reduces that error by a factor of twenty to fifty; an undetermined twentieth would be the
    # largest error of the result, and more images of the same kind do not reduce it. With half or
    # twice the limit, refusals with a part between these become warnings or the reverse; how many
    # was not checked
    undetermined_share: float = 0.05
    # share of the platform's variance due to noise above which the undetermined part is accepted:
    # more of the same images then reduce the standard deviation, which the undetermined part
    # increases by a factor of less than the root of three. Not checked within a factor of two
    least_noise_share: float = 1 / 3
    # displacement by one undetermined motion, relative to the platform's standard deviation, that
    # causes a warning: one half increases the standard deviation by an eighth
    worth_reporting: float = 0.5
    # share of configurations near a singular pose above which the estimate is not reliable
    singular_share: float = MAJORITY
    # share of the undetermined displacement above which one motion is a reason of its own: without
    # a smaller one nearly all of its square remains
    large_cause_share: float = (1 - NEARLY_ALL) ** 0.5
    # limit of the result's standard deviation relative to that by the prior sigmas. If the six
    # numbers of a pose have independent normal errors, the squared errors of the nominal model and
    # of the result, each by its variance, have the ratio F(6, 6), whose quantile of the level of
    # reports, one in twenty, is 0.483^2 and its inverse: at this limit the result is farther from
    # the truth than the nominal model in one of twenty cases
    nominal_error_share: float = 0.483
    # residual of a reading, in standard deviations, above which it contradicts the images, and the
    # share of such readings that is a reason
    reading_residual: float = CONTRADICTION_SIGMAS
    contradicted_share: float = NEGLIGIBLE
    # number of a leg's edges, relative to the median of all legs, below which it is seldom in view
    few_edges_share: float = FEW
    # number of configurations below which a note is added; no other decision depends on it
    few_configurations: int = 10
    # number of heights of a bed with which a wrong height is detected before it moves the tool by
    # much more than its standard deviation (benchmarks/heights.py)
    enough_touches: int = 15


VERDICT = VerdictOptions()


@dataclass(frozen=True)
class RicherModel:
    """Another model of the mechanism file that explains the poses.

    scale : noise scale of the poses with it.
    """

    name: str
    scale: float


def assess(
    observation: Observation,
    estimate: Estimate,
    identification: Identification,
    method: str = "bundle",
    *,
    labels: Mapping[str, Sequence[str]] = MappingProxyType({}),
    richer: RicherModel | None = None,
    explained: bool = False,
    others: Sequence[Finding] = (),
    joints: Array | None = None,
    options: VerdictOptions = VERDICT,
) -> Verdict:
    """Verdict on an estimate of a session.

    identification : directions of the machine that the data determine, and those that they do not.
    labels, richer : as of :func:`misfit`.
    explained : whether a significant model discrepancy explains the scatter of heights; the
        standard deviations then contain it.
    others : findings of any level about the session.
    joints : (K, m) readings; by default those at which the calibrated machine takes the poses.
    """
    bed = identification.bed
    # undetermined motions; and, if these are no refusal, whether the result improves on the
    # nominal model
    undetermined = () if bed else tuple(_undetermined(estimate, identification, options))
    refused = any(one.level is Level.WRONG for one in undetermined)
    no_better: tuple[Finding, ...] = ()
    if bed:
        no_better = tuple(_no_gain("bed", bed.sigma, bed.by_drawing, options))
    elif not refused:
        sigma, nominal = platform_sigma(estimate), identification.by_nominal
        no_better = tuple(_no_gain("platform", sigma, nominal, options))
    negligible = negligible_shift(estimate.machine.parameters)
    # edges that another method leaves far off, and heights that the bed explains
    by_method = method != "bundle" and estimate.statistics.noise_scale > options.too_noisy
    without = {"edges"} if by_method else set[str]()
    without |= {"poses"} if explained else set()
    # all findings, in the order of the report
    every = (
        *_poor_estimate(estimate, method, by_method=by_method),
        *misfit(estimate, labels, richer, without, options),
        *(undetermined if refused else no_better),
        *_singular(estimate, options),
        *_readings_misfit(estimate, options),
        *_warnings(observation, estimate, options),
        *(_touch_unnoticed(bed, options) if bed else ()),
        *(_not_by_heights(bed, identification, negligible) if bed else ()),
        *others,
        *(() if refused else undetermined),
        *(() if bed else _harmless(identification)),
    )
    usable = not any(one.level is Level.WRONG for one in every)
    if not usable:
        headline = "This calibration should not be used."
    elif bed:
        headline = (
            f"Calibrated for a flat bed: the tool's height above it to {bed.sigma * 1e3:.2g} mm"
            f" (standard deviation) within {bed.radius * 1e3:.0f} mm of its middle. Along x and y"
            " nothing is promised."
        )
    else:
        headline = _headline(estimate, joints)
    return Verdict(usable, headline, every)


def _headline(estimate: Estimate, joints: Array | None) -> str:
    """Tool error of the nominal and of the calibrated machine, means over the poses in use.

    For the nominal model, the distance of its pose from the calibrated one at the same readings;
    for the calibrated machine, the standard deviation.
    """
    machine = estimate.machine
    nominal = machine.with_values(machine.parameters.nominal)
    tool = centres_and_tool(nominal, estimate, joints)[1]
    if estimate.purpose is Purpose.LENGTHS:
        before = tool.shift(nominal.values - machine.values)
        return f"Legs' lengths at given poses {amount(before, 'm')} → {amount(tool.sigma, 'm')}."
    changes: list[str] = []
    for unit, off, sigma in (
        ("m", tool.off_position, tool.position),
        ("rad", tool.off_orientation, tool.orientation),
    ):
        before, after = (
            float(values.mean()) if values.size else np.nan
            for values in (off[np.isfinite(off)], sigma)
        )
        if not after > ROUNDING:  # a platform that does not turn
            continue
        if not np.isfinite(before):  # the nominal model takes none of the poses
            changes.append(f"{amount(after, unit)} (1σ)")
            continue
        if before < after:  # the data do not distinguish the two machines
            change = f"{amount(after, unit)} (1σ; the nominal model is {amount(before, unit)} off)"
            changes.append(change)
            continue
        times = float(f"{before / after:.2g}")
        gain = f" ({times:g} times)" if times > 1 else ""
        changes.append(f"{amount(before, unit)} → {amount(after, unit)}{'' if changes else gain}")
    return f"Tool error {', '.join(changes)}." if changes else "Calibrated."


def no_gain(sigma: float, nominal_sigma: float, options: VerdictOptions = VERDICT) -> bool:
    """Whether a result is no better than the nominal model.

    sigma : standard deviation of the platform at given readings, or of the tool's height above the
        bed.
    nominal_sigma : the same by the prior sigmas alone, in the same unit.
    """
    return not sigma <= options.nominal_error_share * nominal_sigma


def _no_gain(
    subject: str, sigma: float, nominal_sigma: float, options: VerdictOptions
) -> Iterator[Finding]:
    """Refusal if the measurements do not improve on the nominal model; see :func:`no_gain`."""
    if no_gain(sigma, nominal_sigma, options):
        yield wrong(f"{subject}.no_gain", sigma=sigma, nominal_sigma=nominal_sigma)


def _touch_unnoticed(bed: Bed, options: VerdictOptions) -> Iterator[Finding]:
    """Warning if one undetected wrong height has a large effect.

    No standard deviation contains the effect, since the size of such an error (a crumb, for
    example) is unknown.
    """
    if bed.unnoticed is None or no_gain(bed.unnoticed, bed.by_drawing, options):
        yield doubtful(
            "bed.height_unnoticed",
            touches=bed.touches,
            shift=bed.unnoticed,
            nominal_sigma=bed.by_drawing,
            more=max(options.enough_touches - bed.touches, options.enough_touches // 2),
        )


def _not_by_heights(
    bed: Bed, identification: Identification, negligible: float
) -> Iterator[Finding]:
    """Notes on directions that heights do not determine, and on the largest one.

    negligible : displacement of the platform, m.
    """
    yield note("bed.sideways", sigma=bed.sideways, size_sigma=bed.size)
    sentences = (*identification.unidentified, *identification.weak)
    if sentences and identification.undetermined_shift > negligible:
        first = max(sentences, key=lambda s: s.moves_platform)
        yield note(
            "bed.undetermined",
            ", ".join(first.parameters),
            what=first.text,
            parameters=first.parameters,
            tool_shift=first.moves_platform,
            more=max(sum(s.matters for s in sentences) - 1, 0) or None,
        )


def _poor_estimate(estimate: Estimate, method: str, *, by_method: bool) -> Iterator[Finding]:
    """Findings on an estimate without convergence or redundancy, or by a method whose edges are far
    off.
    """
    s = estimate.statistics
    if by_method:
        yield wrong("estimate.method_misfit", method=method, scale=s.noise_scale)
    if s.dof <= 0:
        yield wrong("estimate.no_redundancy", dof=s.dof)
    if s.stopped == Stop.STEPS.value:
        yield wrong("estimate.not_converged", steps=s.steps)
    if method == "linear":
        yield _base_alone(estimate)


def _readings_misfit(estimate: Estimate, options: VerdictOptions) -> Iterator[Finding]:
    """Readings that the images contradict."""
    bad = np.abs(estimate.joint_residuals) > options.reading_residual
    if np.mean(bad) > options.contradicted_share:
        joint = int(np.argmax(bad.sum(axis=0))) + 1
        yield wrong(
            "readings.misfit",
            f"joint {joint}",
            joint=joint,
            number=int(bad.sum()),
            of=bad.size,
            limit=options.reading_residual,
        )


def _base_alone(estimate: Estimate) -> Finding:
    """Finding on [B]'s linear method, which determines the base only, with its accuracy.

    The variance due to the edges alone follows by removing the prior: in units of the prior's
    principal axes, the posterior variance is v = e / (1 + e) for an edge variance e.
    """
    machine, table = estimate.machine, estimate.machine.parameters
    nominal = machine.with_values(table.nominal)
    root = table.free_matrix() * table.tolerances_free()
    # covariances of the base centres after and before
    together, before = (
        joint_centres(nominal, machine, free_of_gauge(machine, covariance))[0].covariance
        for covariance in (estimate.covariance, root @ root.T)
    )
    # principal axes of the prior
    values, vectors = np.linalg.eigh(before)
    above_rounding = values > ROUNDING * values[-1]
    unit = vectors[:, above_rounding] * np.sqrt(values[above_rounding])
    inverse = vectors[:, above_rounding] / np.sqrt(values[above_rounding])
    v, axes = np.linalg.eigh(inverse.T @ together @ inverse)
    # e, and back to metres
    by_edges = v / np.maximum(1 - v, ROUNDING)
    alone = np.sum((unit @ axes) ** 2 * by_edges)
    edges, prior, both = (
        float(np.sqrt(x / len(before))) for x in (alone, np.trace(before), np.trace(together))
    )
    return wrong("estimate.base_only", sigma=both, edges_sigma=edges, nominal_sigma=prior)


def misfit(
    estimate: Estimate,
    labels: Mapping[str, Sequence[str]] = MappingProxyType({}),
    richer: RicherModel | None = None,
    without: Collection[str] = (),
    options: VerdictOptions = VERDICT,
) -> Iterator[Finding]:
    """Findings on measurements that the model does not explain, that scatter more than stated, or
    of which many are rejected, by groups of rows with one noise scale.

    A noise scale above ``too_noisy`` (UNEXPLAINED_SCALE) and a share of rejected measurements above
    ``too_many_rejected`` are reasons against the result. A noise scale above the largest one that
    is usual with the group's degrees of freedom is a warning
    (:meth:`~pkmcal.identify.false_alarm.FalseAlarm.usual_scale`).

    labels : names of the measurements in a group, in the plural; the group's own by default.
    richer : the model that explains the poses. without : groups that are judged otherwise.
    """
    for group in estimate.statistics.groups:
        weights = estimate.weights.get(group.name, np.zeros(0))
        if not weights.size or group.name in without:
            continue
        names = labels.get(group.name) or [group.name]
        facts: dict[str, Any] = {"group": group.name, "names": names, "scale": group.scale}
        if richer and group.name == "poses":
            facts |= {"model": richer.name, "model_scale": richer.scale}
        if group.scale > options.too_noisy:
            yield wrong("data.misfit", listed(names), **facts)
        # where other groups' noise makes most of the residuals, the factor alone proves nothing
        elif group.scale > SESSION_FALSE_ALARM.usual_scale(group.dof) and (
            group.chance is None or group.chance < SESSION_FALSE_ALARM.of_noise
        ):
            yield doubtful("data.scatter", listed(names), **facts)
        share, limit = float(np.mean(weights < INLIER_WEIGHT)), options.too_many_rejected
        if share > limit:
            facts = {"names": names, "share": share, "limit": limit}
            yield wrong("data.rejected_share", listed(names), **facts)


def _singular(estimate: Estimate, options: VerdictOptions) -> Iterator[Finding]:
    """Refusal if most poses are near-singular: small errors then move the platform far, and
    linearization does not hold. A note on legs that hold the platform in no pose.
    """
    if estimate.purpose is Purpose.LENGTHS:
        yield note("machine.not_held")
        return
    machine = estimate.machine
    poses = estimate.state.T_base_platform[estimate.configurations]
    weak = on_manifold(machine.layout, machine.values, poses).singularity < NEAR_SINGULAR
    if weak.mean() >= options.singular_share:
        yield wrong("configurations.singular", number=int(weak.sum()), of=weak.size)


def _undetermined(
    estimate: Estimate, identification: Identification, options: VerdictOptions
) -> Iterator[Finding]:
    """Findings on the largest motions that the data do not determine.

    They are a refusal if all such errors together make most of the tool's variance, so that no
    refusal depends on the names of motions; otherwise a warning for each single motion that makes a
    noticeable part of the standard deviation.
    """
    shift, sigma = identification.undetermined_shift, platform_sigma(estimate)
    if shift <= negligible_shift(estimate.machine.parameters):
        return
    causes = sorted(
        (*identification.unidentified, *identification.weak),
        key=lambda s: s.moves_platform,
        reverse=True,
    )
    # where noise makes enough of the variance, the standard deviation suffices
    refused = (
        sigma**2 - shift**2 <= options.least_noise_share * sigma**2
        and shift > options.undetermined_share * identification.by_nominal
    )
    least = options.large_cause_share * shift if refused else options.worth_reporting * sigma
    large = [s for s in causes if s.matters and s.moves_platform > least]
    for one in large or causes[: int(refused)]:
        yield finding(
            "machine.undetermined",
            Level.WRONG if refused else Level.DOUBTFUL,
            ", ".join(one.parameters),
            parameters=one.parameters,
            dimensions=one.dimensions,
            tool_shift=one.moves_platform,
            weak=one.weak,
            matters=one.matters,
            what=one.text,
            advice=one.advice,
        )


def _harmless(identification: Identification) -> Iterator[Finding]:
    """One note on unidentified motions that do not move the platform; the report contains the
    sentences.
    """
    if not identification.n_harmless:
        return
    harmless = [s for s in (*identification.unidentified, *identification.weak) if not s.matters]
    if harmless:
        what = re.split(r"\.(?=\s|$)", harmless[0].text)[0]  # not at the point of a number
        what = f"{what[0].lower()}{what[1:]}"
    else:  # no name describes these changes without others that move it
        number = in_full(identification.n_harmless)
        what = f"{number} of the machine's numbers, or combinations of them"
    yield note(
        "machine.undetermined_harmless",
        ", ".join(harmless[0].parameters) if harmless else "",
        what=what,
        matters=False,
        more=len(harmless) - 1 if len(harmless) > 1 else None,
    )


def _warnings(
    observation: Observation, estimate: Estimate, options: VerdictOptions
) -> Iterator[Finding]:
    """Warnings on values far from the nominal model, and on causes of large standard deviations."""
    table = estimate.machine.parameters
    change = np.abs(_from_nominal(estimate.machine))
    # values to be checked by a person
    far = [table.names[k] for k in np.argsort(-change) if change[k] > CONTRADICTION_SIGMAS]
    if far:
        yield doubtful(
            "machine.far_from_nominal",
            ", ".join(far),
            parameters=far,
            tolerances=CONTRADICTION_SIGMAS,
            most=float(change.max()),
        )
    # edges: legs seldom in view, scatter, shading
    in_view = np.bincount(observation.edges.leg, minlength=estimate.machine.n_legs)
    for leg in np.flatnonzero(in_view < options.few_edges_share * np.median(in_view)).tolist():
        yield doubtful("edges.leg_seldom_seen", f"leg {leg + 1}", leg=leg + 1)
    shading = estimate.edge_noise.shading if observation.edges.leg.size else np.zeros(1)
    if shading.min() > POLISHED_SHADING:
        yield doubtful("edges.polished", value=float(shading.min()))
    used = int(np.sum(estimate.configurations))
    if used < options.few_configurations and estimate.purpose is not Purpose.HEIGHT:
        yield note("configurations.few", number=used)


def _from_nominal(machine: Machine) -> Array:
    """Changes (P,) of the parameters in prior sigmas, in the frames that minimize them.

    Frames defined by three joints would add these joints' errors to all other parameters, mainly
    axes.
    """
    table = machine.parameters
    change = (machine.values - table.nominal) / table.tolerance
    frames = generators(machine.layout, table.nominal) @ freedoms(machine)
    frames = frames / table.tolerance[:, None]
    return change - frames @ np.linalg.lstsq(frames, change, rcond=None)[0]
