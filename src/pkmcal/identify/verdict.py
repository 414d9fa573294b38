"""Is the result to be used? In words, with reasons, warnings and advice."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.centres import free_of_gauge, joint_centres
from pkmcal.identify.confirmation import FAR_FROM_NOMINAL
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.found import decided_by
from pkmcal.identify.gauge import freedoms, generators
from pkmcal.identify.sentences import Sentence
from pkmcal.identify.tool import platform_sigma
from pkmcal.identify.unidentified import Findings, only_heights
from pkmcal.measurements import OWN_SHADING, Observation
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.kinematics import NEAR_SINGULAR, on_manifold
from pkmcal.outcome import Verdict
from pkmcal.solver.search import Stop
from pkmcal.wording import listed

if TYPE_CHECKING:
    from pkmcal.identify.bed import Bed

TOO_NOISY = 4.0
"""Factor on the edges' stated noise beyond which the model does not explain the photographs."""
TOO_MANY_LOST = 0.4
"""Share of edges given up as outliers beyond which the rest may be the outliers."""
LEFT_OPEN = 0.05
"""Share of the platform's error by the drawing that may be left undecided. A calibration makes the
drawing's error twenty to fifty times smaller; what leaves a twentieth of it would be the result's
largest error, and one that more of the same photographs do not shrink. A result whose deviation is
larger anyway is no worse for it."""
MOSTLY_SINGULAR_SHARE = 0.5
"""Share of configurations near a singular pose from which on nothing said here can be trusted."""
LARGE_CAUSE_SHARE = 0.3
"""Share of what is undecided from which on a single cause of it is worth a reason."""
WORTH_SAYING = 0.5
"""Part of the platform's deviation from which on what makes it is worth a warning; half of it makes
the whole larger by an eighth."""
NOMINAL_ERROR_LEFT = 0.5
"""Part of the error that the nominal model's tolerances let expect which a result may leave: below
a half the result is better than the nominal model almost for sure; above, new values are not worth
their risk."""
ENOUGH_TOUCHES = 15
"""Of a bed, where a wrong one moves it by little more than its deviation before it is noticed
(benchmarks/heights.py)."""
EXACT_SHARE = 1e-9
"""Part of a variance below which it is rounding."""
POLISHED_SHADING = 4 * OWN_SHADING
"""px, of what shades each edge beside its line, from which tubes are as polished metal or in hard
light: of path-traced machines those of metal show 0.07 to 0.26, painted ones 0.005 to 0.05."""
POOR_MODEL_POSE_SCALE = 1.3
"""Factor on the poses' noise beyond which the model is too poor for them, if that is no chance."""


@dataclass(frozen=True)
class RicherModel:
    """Another model of the mechanism file, and by how many times their noise poses fit it."""

    name: str
    scale: float


def judge(
    observation: Observation,
    estimate: Estimate,
    findings: Findings,
    method: str = "bundle",
    *,
    richer: tuple[RicherModel, ...] = (),
    explained: bool = False,
    doubts: tuple[str, ...] = (),
    cautions: tuple[str, ...] = (),
    hints: tuple[str, ...] = (),
) -> Verdict:
    """The verdict on an estimate of a session by a method.

    findings : what the data tell of the machine.
    richer : models of the machine that were tried because this one is too poor for the poses.
    explained : whether the model discrepancy surely explains why heights scatter; the standard
    deviations then contain it.
    doubts : further reasons against it, cautions : further warnings, hints : further advice, found
    in the session.
    """
    bed = findings.bed
    large, small = ((), ()) if bed else _left_open(estimate, findings)
    if bed:
        left = _bed_unknown(bed)
        hints = (*_not_by_heights(bed, findings), *hints)
    else:
        left = [f"{s.text} {s.advice}" for s in large]
        left = left or _platform_unknown(estimate, findings.by_drawing)
    against = [] if explained else _poses_against(estimate, richer)
    reasons = tuple(_reasons(estimate, method, left) + against) + doubts
    # what is a small part of the deviation that was reached is in that, and in the report
    matter = tuple(s for s in small if s.matters)
    if matter:
        least = WORTH_SAYING * platform_sigma(estimate)
        matter = tuple(s for s in matter if s.moves_platform > least)
    warnings = (
        *_warnings(observation, estimate),
        *(() if explained else _poses_doubted(estimate, richer)),
        *(_touch_unnoticed(bed) if bed else ()),
        *cautions,
        *(f"{s.text} {s.advice}" for s in matter),
    )
    if reasons:
        headline = "This calibration should not be used."
    elif bed:
        headline = (
            f"Calibrated for a flat bed: the tool's height above it to {bed.sigma * 1e3:.2g} mm"
            f" (standard deviation) within {bed.radius * 1e3:.0f} mm of its middle. Along x and y"
            " nothing is promised."
        )
    else:
        headline = _headline(observation, estimate)
    return Verdict(
        not reasons, headline, reasons, warnings, (*_advice(estimate), *hints, *_harmless(small))
    )


def _headline(observation: Observation, estimate: Estimate) -> str:
    """What was reached: of joints where legs were seen, of the platform where only it was.

    Boards tell where the platform goes, and leave open what does not move it.
    """
    if not len(observation.edges):
        return (
            f"Calibrated: the platform's joints to {platform_sigma(estimate) * 1e3:.2g} mm at"
            " given readings (standard deviation)."
        )
    machine = estimate.machine
    covariance = free_of_gauge(machine, estimate.covariance)  # medians that favour no frame
    drawing = machine.with_values(machine.parameters.drawing)
    bodies = joint_centres(drawing, machine, covariance)
    centre = float(np.median(np.concatenate([body.sigma for body in bodies])))
    offsets = np.diag(covariance)[machine.parameters.of_kind("offset")]
    offset = float(np.sqrt(np.median(offsets))) if offsets.size else 0.0
    return (
        f"Calibrated: joint centres to {centre * 1e3:.2g} mm and offsets to {offset * 1e3:.2g} mm"
        " (standard deviations)."
    )


def no_gain(sigma: float, by_nominal: float) -> bool:
    """Whether a result is no better than the nominal model, for data of any kind.

    sigma : standard deviation of what the result is for (the platform at given readings, or the
    tool's height above the bed), by_nominal : the same by the nominal model's tolerances alone, in
    the same unit.
    """
    return not sigma <= NOMINAL_ERROR_LEFT * by_nominal


def _platform_unknown(estimate: Estimate, by_nominal: float) -> list[str]:
    """Why measurements of the platform are of no use, if they are not."""
    sigma = platform_sigma(estimate)
    if not no_gain(sigma, by_nominal):
        return []
    return [
        f"The platform's joints are known to {sigma * 1e3:.2g} mm at given readings, and by the"
        f" drawing's tolerances alone to {by_nominal * 1e3:.2g} mm: that is no gain. Measure more"
        " configurations, from further places, or with less noise.",
    ]


def _bed_unknown(bed: Bed) -> list[str]:
    """Why heights are of no use, if they are not."""
    if not no_gain(bed.sigma, bed.by_drawing):
        return []
    return [
        f"The heights leave the tool's height above the bed known to {bed.sigma * 1e3:.2g} mm, and"
        f" the drawing's tolerances alone to {bed.by_drawing * 1e3:.2g} mm: that is no gain. Probe"
        " more points, spread to the edge of the bed, or with a probe that repeats better.",
    ]


def _touch_unnoticed(bed: Bed) -> list[str]:
    """What one wrong height could do that nothing shows, where that is much: no deviation holds it,
    for nobody knows how wrong a crumb is.
    """
    if bed.unnoticed is not None and not no_gain(bed.unnoticed, bed.by_drawing):
        return []
    bends = "as far as it likes" if bed.unnoticed is None else f"by {bed.unnoticed * 1e3:.2g} mm"
    more = max(ENOUGH_TOUCHES - bed.touches, ENOUGH_TOUCHES // 2)
    return [
        f"So few heights, {bed.touches}, do not show a wrong one: a crumb under the probe could"
        f" bend the bed {bends} unnoticed, and the drawing's tolerances alone bend it by"
        f" {bed.by_drawing * 1e3:.2g} mm. Probe these again and compare, or {more} more places,"
        " spread to the edge of the bed.",
    ]


def _not_by_heights(bed: Bed, findings: Findings) -> list[str]:
    """What heights leave to the drawing, in figures, and the largest cause in words."""
    told = [
        f"Heights do not tell x and y: these are known to {bed.sideways * 1e3:.2g} mm, and sizes to"
        f" {bed.size:.2%}, by the drawing's tolerances. Measure distances on a printed part"
        " (distances in session.yaml), or a board on the tool (observe: board), where dimensions"
        " matter."
    ]
    matter = [s for s in (*findings.unidentified, *findings.weak) if s.matters]
    if matter:
        first = max(matter, key=lambda s: s.moves_platform)
        more = f" ({len(matter) - 1} more in the report)" if len(matter) > 1 else ""
        told.append(f"{first.text}{more}")
    return told


def _reasons(estimate: Estimate, method: str, undecided: list[str]) -> list[str]:
    out: list[str] = []
    lost = float(np.mean(estimate.edge_weights < 0.5)) if estimate.edge_weights.size else 0.0
    if estimate.statistics.noise_scale > TOO_NOISY and method != "bundle":
        out.append(
            f"The {method} method leaves the edges {estimate.statistics.noise_scale:.0f} times"
            " further off than their noise; it is here for comparison. Use the joint method,"
            " bundle, which is the default."
        )
    elif estimate.statistics.noise_scale > TOO_NOISY:
        out.append(
            f"The edges disagree with the machine {estimate.statistics.noise_scale:.1f} times more"
            " than their noise: something that the model leaves out moves them (lens, bending,"
            " play, photographs under wrong names)."
        )
    if lost > TOO_MANY_LOST:
        out.append(
            f"{lost:.0%} of the edges do not fit the rest; below {TOO_MANY_LOST:.0%} the majority"
            " can be trusted to be right."
        )
    if estimate.statistics.dof <= 0:
        out.append(
            "As many unknowns were estimated as there are measurements, the drawing's tolerances"
            " counted: nothing is left over that could show a wrong one. Measure more"
            " configurations."
        )
    if estimate.statistics.stopped == Stop.STEPS.value:
        out.append(
            f"The search for the best values had not settled after {estimate.statistics.steps}"
            " steps, so these are not the best: check that the drawing's tolerances fit the"
            " machine, or measure more configurations."
        )
    if method == "linear":
        out.append(_base_alone(estimate))
    out.extend(undecided)
    out.extend(_singular(estimate))
    bad = np.abs(estimate.joint_residuals) > 6.0
    if np.mean(bad) > 0.02:
        leg = int(np.argmax(bad.sum(axis=0))) + 1
        out.append(
            f"The readings of joint {leg} and others do not fit the photographs"
            f" ({int(bad.sum())} of {bad.size} by more than 6 standard deviations)."
        )
    return out


def _base_alone(estimate: Estimate) -> str:
    """How far [B]'s linear method goes: the base, by the edges and by the drawing, and no further.

    By the edges alone is what the drawing was to them taken out: in units of the drawing's
    deviations, what is known together has the variance v = e / (1 + e) where the edges' is e.
    """
    machine, table = estimate.machine, estimate.machine.parameters
    drawing = machine.with_values(table.drawing)
    root = table.free_matrix() * table.tolerances_free()
    together, before = (
        joint_centres(drawing, machine, free_of_gauge(machine, covariance))[0].covariance
        for covariance in (estimate.covariance, root @ root.T)
    )
    values, vectors = np.linalg.eigh(before)
    known = values > EXACT_SHARE * values[-1]
    unit = vectors[:, known] * np.sqrt(values[known])
    inverse = vectors[:, known] / np.sqrt(values[known])
    v, axes = np.linalg.eigh(inverse.T @ together @ inverse)
    by_edges = v / np.maximum(1 - v, EXACT_SHARE)
    alone = np.sum((unit @ axes) ** 2 * by_edges)
    edges, drawing_, both = (
        f"{np.sqrt(x / len(before)) * 1e3:.2g} mm"
        for x in (alone, np.trace(before), np.trace(together))
    )
    return (
        f"The linear method tells of the base alone: its joints are known to {both} (by the edges"
        f" alone to {edges}, by the drawing alone to {drawing_}). The platform's joints and the"
        " legs' lengths stay as drawn. Use the joint method, bundle, which is the default."
    )


def _poses_against(estimate: Estimate, richer: tuple[RicherModel, ...]) -> list[str]:
    """Poses that the model does not explain, or that do not agree among themselves."""
    out: list[str] = []
    scale = estimate.statistics.pose_scale
    if scale > TOO_NOISY:
        out.append(
            f"The measured poses disagree with the model {scale:.1f} times more than their noise:"
            f" it leaves out what moves them.{_better(richer)}"
        )
    lost = float(np.mean(estimate.pose_weights < 0.5)) if estimate.pose_weights.size else 0.0
    if lost > TOO_MANY_LOST:
        out.append(
            f"{lost:.0%} of the measured poses do not fit the rest; below {TOO_MANY_LOST:.0%} the"
            " majority can be trusted to be right."
        )
    return out


def _poses_doubted(estimate: Estimate, richer: tuple[RicherModel, ...]) -> list[str]:
    """Poses that scatter more than they should, short of a reason against the result."""
    s = estimate.statistics
    # the scale of n numbers that are noise has the standard deviation 1 / sqrt(2 n)
    chance = 1 + 4 / np.sqrt(2 * max(s.dof_poses, 1.0))
    if not max(POOR_MODEL_POSE_SCALE, chance) < s.pose_scale <= TOO_NOISY:
        return []
    return [
        f"The measured poses disagree with the model {s.pose_scale:.1f} times more than their"
        f" noise; all standard deviations are enlarged by as much.{_better(richer)}"
    ]


def _better(richer: tuple[RicherModel, ...]) -> str:
    """The richer model that fits, as a further sentence; the least rich of those that fit alike."""
    if not richer:
        return ""
    best = min(richer, key=lambda model: model.scale)
    alike = [model for model in richer if model.scale < 1.1 * best.scale]
    return f" With --model {alike[0].name} they fit {alike[0].scale:.2f} times their noise."


def _singular(estimate: Estimate) -> list[str]:
    """Where most poses are singular, small errors move the platform far and nothing is linear."""
    machine = estimate.machine
    poses = estimate.state.T_base_platform[estimate.configurations]
    weak = on_manifold(machine.layout, machine.values, poses).singularity < NEAR_SINGULAR
    if weak.mean() < MOSTLY_SINGULAR_SHARE:
        return []
    return [
        f"The machine is near a singular pose in {int(weak.sum())} of {weak.size} configurations:"
        " there its readings hardly say where the platform is, and these deviations cannot be"
        " trusted. Photograph it in other poses, or check the drawing."
    ]


def _left_open(
    estimate: Estimate, findings: Findings
) -> tuple[tuple[Sentence, ...], tuple[Sentence, ...]]:
    """What is undecided: reasons against the result, and what to know of it.

    Only what moves the platform counts. What the data know a little counts where they do not
    decide one of its values; otherwise its deviations say enough.
    """
    undecided = set(_undecided(estimate))
    weak = tuple(s for s in findings.weak if s.matters and undecided & set(s.parameters))
    open_ = findings.unidentified + weak
    total = float(np.sqrt(sum(s.moves_platform**2 for s in open_ if s.matters)))
    if total <= LEFT_OPEN * findings.by_drawing:
        return (), open_
    # where all else makes more of the deviation that was reached, that says enough
    if total <= np.sqrt(max(platform_sigma(estimate) ** 2 - total**2, 0.0)):
        return (), open_
    least = min(LARGE_CAUSE_SHARE * total, max(s.moves_platform for s in open_))
    large = tuple(s for s in open_ if s.matters and s.moves_platform >= least)
    return large, tuple(s for s in open_ if s not in large)


def _harmless(sentences: tuple[Sentence, ...]) -> list[str]:
    """One line about what is open and does no harm; the report has the sentences."""
    harmless = sum(not s.matters for s in sentences)
    if not harmless:
        return []
    first = sentences[[s.matters for s in sentences].index(False)].text
    what = re.split(r"\.(?=\s|$)", first)[0]  # not at the point of a number
    more = f" ({harmless - 1} more in the report)" if harmless > 1 else ""
    return [f"Open, without effect on the platform: {what[0].lower()}{what[1:]}{more}."]


def _undecided(estimate: Estimate) -> list[str]:
    """Parameters that the drawing decides; a tube's radius moves nothing."""
    table = estimate.machine.parameters
    decided = decided_by(table, estimate.covariance, estimate.data_share)
    named = zip(table.names, table.kinds, decided, strict=True)
    return [name for name, kind, by in named if by == "drawing" and kind != "radius"]


def _warnings(observation: Observation, estimate: Estimate) -> list[str]:
    out: list[str] = []
    table = estimate.machine.parameters
    change = np.abs(_from_drawing(estimate.machine))
    far = [table.names[k] for k in np.argsort(-change) if change[k] > FAR_FROM_NOMINAL]
    if far:
        out.append(
            f"{listed(far, 4)} differ{'s' if len(far) == 1 else ''} from the drawing by more than"
            f" {FAR_FROM_NOMINAL:.0f} tolerances (up to {change.max():.0f}): check the drawing"
            f" and its frame."
        )
    seen = np.bincount(observation.edges.leg, minlength=estimate.machine.n_legs)
    out.extend(
        f"Leg {leg + 1} was seen in few photographs; its values lean on the readings."
        for leg in np.flatnonzero(seen < 0.3 * np.median(seen))
    )
    if estimate.statistics.noise_scale > 1.5:
        out.append(
            f"The edges scatter {estimate.statistics.noise_scale:.1f} times more than their"
            " profiles promise; their deviations, and with them all others, are enlarged."
        )
    shading = estimate.edge_noise.shading if observation.edges.leg.size else np.zeros(1)
    if shading.min() > POLISHED_SHADING:
        out.append(
            f"Light moves single edges of every tube by {shading.min():.2f} px or more, as on"
            " polished metal. What it does to a leg in all photographs alike no residual shows;"
            " errors of such sessions were as large as their deviations, of some a third larger."
            " What helps: a further place, softer light, a white sheet behind the machine, chalk on"
            " the tubes."
        )
    return out


def _from_drawing(machine: Machine) -> Array:
    """Changes (P,) of the parameters in tolerances, in the frames that make them least.

    Frames by three joints would put those joints' own errors on all others, axes above all.
    """
    table = machine.parameters
    change = (machine.values - table.drawing) / table.tolerance
    frames = generators(machine.layout, table.drawing) @ freedoms(machine)
    frames = frames / table.tolerance[:, None]
    return change - frames @ np.linalg.lstsq(frames, change, rcond=None)[0]


def _advice(estimate: Estimate) -> list[str]:
    used = int(np.sum(estimate.configurations))
    if used < 10 and not only_heights(estimate):
        return [
            f"Only {used} configurations were used. Standard deviations fall with the square root"
            " of their number; extreme leg lengths help most."
        ]
    return []
