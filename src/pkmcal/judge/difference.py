"""Difference between two calibrations, two nominal models, or one of each: ``pkmcal diff``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.arrays import Array, short_repr
from pkmcal.calibration.machine_source import loaded
from pkmcal.calibration.saved_calibration import SavedCalibration
from pkmcal.calibration.toolmap import ToolMap, map_of
from pkmcal.errors import InputError, PkmcalError
from pkmcal.files import json_value
from pkmcal.identify.centres import Centres, free_of_gauge, joint_centres
from pkmcal.judge.changes import CHANGE_ALPHA
from pkmcal.judge.machine_change import MachineChange, machine_change
from pkmcal.levels import ROUNDING
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.disturbances import growth_by_readings, tool_shift
from pkmcal.mechanisms.region import REGION_AXES, Region
from pkmcal.outcome import Verdict
from pkmcal.outcome.finding import Finding, doubtful, note, wrong
from pkmcal.wording import amount, brief, count, listed, number, percentage

DIFFERENCE_FORMAT = 1
MOST_CHANGES_NAMED = 4
"""Maximum number of changes that the verdict names."""


@dataclass(frozen=True)
class ComparedMachine:
    """One of the two machines. name : as given. saved : None for a nominal model."""

    name: str
    machine: Machine
    saved: SavedCalibration | None

    @property
    def covariance(self) -> Array | None:
        """Covariance (P, P) of the parameters; None for a nominal model."""
        return None if self.saved is None else self.saved.covariance

    @property
    def kind(self) -> str:
        """Kind of the machine's source, for people."""
        return "nominal model" if self.saved is None else "calibration"


@dataclass(frozen=True)
class MachineDifference:
    """Difference between two machines.

    change : b minus a.
    chance : p-value of its chi-square for an unchanged machine; 1 between nominal models.
    chances : (P,) p-values of each parameter's change, corrected for their number; NaN without a
        standard deviation.
    centres : of base and platform, a's registered to b's.
    tool : effect of the change on the tool over the workspace, as ``after`` of the map, or the
        reason why there is no map.
    shared : number of configurations that both calibrations used.
    assumed : assumptions, in sentences.
    """

    a: ComparedMachine
    b: ComparedMachine
    change: MachineChange
    chance: float
    chances: Array
    centres: tuple[Centres, ...]
    tool: ToolMap | str
    shared: int
    assumed: tuple[str, ...]
    verdict: Verdict
    changed: bool

    __repr__ = short_repr

    @property
    def of_calibrations(self) -> bool:
        """Whether both are calibrations; of a nominal model, a change is what was asked for."""
        return self.a.saved is not None and self.b.saved is not None

    @property
    def ordered(self) -> list[int]:
        """Indices of the parameters that differ, the most significant first."""
        size = np.abs(self.change.change)
        some = np.flatnonzero(size > ROUNDING)
        if self.change.dof:
            sigma = np.maximum(self.change.sigma, ROUNDING)
            size = size / sigma
        else:
            size = size / self.a.machine.parameters.tolerance
        return [int(k) for k in some[np.argsort(-size[some], kind="stable")]]

    @property
    def significant(self) -> list[int]:
        """Indices of the significant parameters; between nominal models, of all that differ."""
        return [k for k in self.ordered if not self.chances[k] >= CHANGE_ALPHA / 2]

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON: m and rad."""
        table, change = self.a.machine.parameters, self.change
        before = table.unit_axes(self.a.machine.values)
        sides = [
            {
                "name": side.name,
                "kind": "drawing" if side.saved is None else "calibration",
                "usable": None if side.saved is None else side.saved.verdict.usable,
            }
            for side in (self.a, self.b)
        ]
        if isinstance(self.tool, str):
            tool = {"why_not": self.tool}
        else:
            whole = self.tool.document()
            keys = {"region": "region", "poses": "poses", "change": "drawing_off", "sigma": "sigma"}
            tool = {key: whole[old] for key, old in keys.items()}
        return json_value(
            {
                "pkmcal_diff": DIFFERENCE_FORMAT,
                "verdict": self.verdict.document(),
                "changed": self.changed,
                "a": sides[0],
                "b": sides[1],
                "chi2": change.chi2 if change.dof else None,
                "dof": change.dof,
                "chance": self.chance if change.dof else None,
                "parameters": [
                    {
                        "name": name,
                        "unit": table.units[k],
                        "a": before[k],
                        "b": before[k] + change.change[k],
                        "change": change.change[k],
                        "sigma": change.sigma[k],
                        "chance": self.chances[k],
                    }
                    for k, name in enumerate(table.names)
                ],
                "tool": tool,
                "shared_configurations": self.shared,
                "assumed": self.assumed,
            }
        )


def difference(
    a: SavedCalibration | Machine | Path | str, b: SavedCalibration | Machine | Path | str
) -> MachineDifference:
    """Compare two calibrations, mechanism files or built-in machines, without writing files.

    Raises InputError if they are not of the same machine.
    """
    one, other = _compared_machine(a), _compared_machine(b)
    _check_same_machine(one, other)
    # Correlation of two calibrations: common data, and a common nominal model.
    both = [side.saved for side in (one, other) if side.saved is not None]
    shared, share = _shared_data(both)
    same_nominal = len(both) == 2 and _same_nominal_model(*both)
    change = machine_change(
        one.machine,
        other.machine,
        (one.covariance, other.covariance),
        same_nominal=same_nominal,
        shared=share,
    )
    legs_observed = all((saved.document.get("residuals") or {}).get("edges") for saved in both)
    try:
        tool: ToolMap | str = map_of(
            one.machine,
            change.machine,
            change.covariance,
            _region(both),
            legs_observed=legs_observed,
        )
    except PkmcalError as error:
        tool = f"There is no map of the workspace: {error}"
    # Significance of the change, as a whole and by parameter.
    chance, chances = _p_values(change)
    least = float(np.nanmin(chances, initial=1.0))
    held = (change.sigma <= ROUNDING) & (np.abs(change.change) > ROUNDING)
    changed = bool(chance < CHANGE_ALPHA / 2 or least < CHANGE_ALPHA / 2 or held.any())
    free = free_of_gauge(change.machine, change.covariance)
    out = MachineDifference(
        a=one,
        b=other,
        change=change,
        chance=chance,
        chances=chances,
        centres=joint_centres(one.machine, change.machine, free),
        tool=tool,
        shared=shared,
        assumed=_assumptions(one, other, same_nominal, shared, share),
        verdict=Verdict(True, ""),
        changed=changed,
    )
    return _with_verdict(out)


def _compared_machine(origin: SavedCalibration | Machine | Path | str) -> ComparedMachine:
    calibration = loaded(origin)
    if isinstance(calibration, SavedCalibration):
        name = str(origin) if isinstance(origin, Path | str) else str(calibration.path.parent)
        return ComparedMachine(name, calibration.machine, calibration)
    return ComparedMachine(
        str(origin) if isinstance(origin, Path | str) else calibration.name, calibration, None
    )


def _check_same_machine(a: ComparedMachine, b: ComparedMachine) -> None:
    one, other = (side.machine.parameters.names for side in (a, b))
    if one == other and a.machine.document.motion == b.machine.document.motion:
        return
    odd = sorted({*one} ^ {*other})
    raise InputError(
        "these are two different machines",
        where=b.name,
        found=f"{b.machine.name}, {b.machine.n_legs} legs, {len(other)} parameters"
        + (f" ({listed(odd, 3)} not in both)" if odd else ""),
        expected=f"{a.machine.name}, {a.machine.n_legs} legs, {len(one)} parameters, as in"
        f" {a.name}",
        next_step="Compare calibrations or nominal models of one machine",
        code="difference.machines",
    )


def _same_nominal_model(one: SavedCalibration, other: SavedCalibration) -> bool:
    """Whether two calibrations have the same nominal values and prior sigmas."""
    first, second = (saved.machine.parameters.tolerance for saved in (one, other))
    same = np.allclose(one.nominal, other.nominal, rtol=0, atol=ROUNDING)
    return same and np.allclose(first, second)


def _shared_data(both: list[SavedCalibration]) -> tuple[int, float]:
    """Number of the first calibration's configurations that both used, and the share of common
    data.

    Data are images, however they are grouped into configurations, or, without any, readings that
    agree to the last digit; the share is relative to the calibration with fewer data.
    """
    if len(both) < 2:
        return 0, 0.0
    one, other = (
        [_identity(saved, k) for k in np.flatnonzero(saved.used).tolist()] for saved in both
    )
    first, second = set().union(*one), set().union(*other)
    n_shared = sum(bool(marks & second) for marks in one)
    least = min(len(first), len(second))
    return n_shared, len(first & second) / least if least else 0.0


def _identity(saved: SavedCalibration, k: int) -> set[object]:
    """Identity of a configuration: its images, or its readings."""
    images = saved.document["configurations"][k].get("photographs", ())
    return set(images) or {tuple(saved.joints[k].tolist())}


def _region(both: list[SavedCalibration]) -> Region | None:
    """Workspace of the first calibration that has one; None for all reachable poses."""
    for saved in both:
        region = (saved.document.get("tool") or {}).get("region")
        if region:
            sides = {k: tuple(region[k]) if region.get(k) else None for k in REGION_AXES}
            return Region(**sides, turn=region.get("turn"))
    return None


def _p_values(change: MachineChange) -> tuple[float, Array]:
    """p-values of the whole change and (P,) of each parameter, corrected for their number."""
    from scipy.special import chdtrc, ndtr

    sigma = change.sigma
    has_sigma = sigma > ROUNDING
    chances = np.full(len(sigma), np.nan)
    single = 2 * ndtr(-np.abs(change.change[has_sigma]) / sigma[has_sigma])
    chances[has_sigma] = np.minimum(1.0, single * change.dof)
    return float(chdtrc(change.dof, change.chi2)) if change.dof else 1.0, chances


def _assumptions(
    a: ComparedMachine, b: ComparedMachine, same_nominal: bool, shared: int, share: float
) -> tuple[str, ...]:
    """Assumptions of the change's standard deviations, in sentences."""
    out = [
        "The change leads from A to B in A's frames, with B aligned to A where the two differ"
        " least: by least squares over all free numbers, each in its tolerance."
    ]
    nominal = [side for side in (a, b) if side.saved is None]
    if len(nominal) == 2:
        return (*out, "Nominal models have no standard deviations, so any difference counts.")
    if nominal:
        return (
            *out,
            f"The nominal model {nominal[0].name} has no standard deviations; those stated"
            " are the calibration's.",
            UNMODELLED_CHANGES_TEXT,
        )
    out.append(
        "Both calibrations have the same nominal model as a prior: where it alone decides, they"
        " agree, and its error is common to both."
        if same_nominal
        else "The calibrations use different nominal models as priors, whose errors are taken to be"
        " independent."
    )
    out.append(
        f"{count(shared, 'configuration')} were seen by both, {percentage(share)} of what the"
        " one that has fewer saw; their noise is taken to be common to both, and all"
        " configurations to be equally informative."
        if shared
        else "They share no configuration, so the noise of one is independent of the other's."
    )
    return (*out, UNMODELLED_CHANGES_TEXT)


UNMODELLED_CHANGES_TEXT = (
    "What the model leaves out and differs from one day to the next (bending, play, a lens, warmth)"
    " comes on top of the standard deviations, and counts as a change."
)


def _with_verdict(d: MachineDifference) -> MachineDifference:
    """Difference with its verdict."""
    refused = [
        wrong("difference.refused", side.name, reasons=" ".join(side.saved.verdict.reasons))
        for side in (d.a, d.b)
        if side.saved is not None and not side.saved.verdict.usable
    ]
    if not np.any(np.abs(d.change.change) > ROUNDING):
        headline = "The two are the same: no number differs by more than rounding."
    elif not d.changed:
        headline = (
            f"No change beyond what chance explains (χ² {number(d.change.chi2, 0)} for"
            f" {d.change.dof} degrees of freedom){_tool_clause(d)}."
        )
    elif d.of_calibrations:
        headline = f"The calibrations differ by more than chance explains{_tool_clause(d)}."
    elif d.change.dof:
        headline = (
            f"Nominal model and calibration differ by more than chance explains{_tool_clause(d)}."
        )
    else:
        headline = f"The nominal models differ{_tool_clause(d)}."
    # between calibrations a change is a fault: one of them does not hold any more
    fault = d.changed and d.of_calibrations
    named = [_parameter_finding(d, k) for k in d.significant[:MOST_CHANGES_NAMED]] if fault else []
    n_more = len(d.significant) - len(named)
    if named and n_more > 0:
        named.append(wrong("difference.more", number=n_more))
    if fault and not named:
        named.append(wrong("difference.together", chi2=d.change.chi2, dof=d.change.dof))
    advice: list[Finding] = []
    if d.a.saved and d.b.saved and fault:
        if d.shared == int(d.a.saved.used.sum()):
            seeds = d.a.saved.seed, d.b.saved.seed
            advice = [note("difference.same_images", seed_a=seeds[0], seed_b=seeds[1])]
        else:
            advice = [note("difference.unmodelled")]
    findings = (*refused, *named, *_temperature_findings(d), *advice)
    return replace(d, verdict=Verdict(not fault and not refused, headline, findings))


def _temperature_findings(d: MachineDifference) -> Iterator[Finding]:
    """Warning about machines whose lengths hold at two temperatures, if the thermal growth that
    they state moves the tool by more than the difference's standard deviation.
    """
    a, b = (side.machine.document.growth for side in (d.a, d.b))
    if isinstance(d.tool, str) or a is None or b is None:
        return
    # second moments (2, 2) of the growth of drives and frame, mean of both machines
    roots = [np.column_stack([[one.drives, one.frame], one.root]) for one in (a, b)]
    square = np.mean([root @ root.T for root in roots], axis=0)
    machine, (_, after) = d.a.machine, d.tool.evenly
    poses = after.T_base_platform
    by = growth_by_readings(machine, machine.inverse(poses), poses)
    moved = np.stack([tool_shift(machine, poses, by[..., k]) for k in range(2)], axis=-1)
    per_kelvin = np.sqrt(np.nanmean(np.einsum("nik,kl,nil->n", moved, square, moved)))
    shift = float(abs(b.temperature - a.temperature) * per_kelvin)
    sigma = float(np.sqrt(np.nanmean(after.position**2)))
    if shift > max(sigma, ROUNDING):
        yield doubtful(
            "difference.temperature",
            temperature_a=a.temperature,
            temperature_b=b.temperature,
            tool_shift=shift,
            sigma=sigma if sigma > ROUNDING else None,
        )


def _tool_clause(d: MachineDifference) -> str:
    """Effect on the tool, as the end of a sentence."""
    if isinstance(d.tool, str):
        return ""
    _, after = d.tool.evenly
    off, sigma = (x[np.isfinite(x)] for x in (after.off_position, after.position))
    if not off.size:
        return ""
    one_sigma = brief(float(np.median(sigma)) * 1e3)
    by_chance = f"; chance alone makes {one_sigma} mm (1σ)" if d.change.dof else ""
    return (
        f": the tool differs by {brief(float(np.median(off)) * 1e3)} mm over {d.tool.region}"
        f" (median), {brief(float(off.max()) * 1e3)} mm at worst{by_chance}"
    )


def _parameter_finding(d: MachineDifference, k: int) -> Finding:
    """Finding of a parameter's change."""
    table = d.a.machine.parameters
    name = table.names[k]
    return wrong(
        "difference.parameter",
        name,
        parameter=table.in_words(name),
        value=float(d.change.change[k]),
        sigma=float(d.change.sigma[k]),
        change=change_text(d, k),
    )


def change_text(d: MachineDifference, k: int) -> str:
    """``+0.54 mm (±0.07 mm)``, or the number alone without a unit."""
    unit = d.a.machine.parameters.units[k]
    value, sigma = float(d.change.change[k]), float(d.change.sigma[k])
    sign = "+" if value >= 0 else "−"
    if unit in ("m", "rad"):
        text = f"{sign}{amount(abs(value), unit)}"
        return f"{text} (±{amount(sigma, unit)})" if sigma > ROUNDING else text
    text = f"{sign}{abs(value):.2g}"
    return f"{text} (±{sigma:.2g})" if sigma > ROUNDING else text
