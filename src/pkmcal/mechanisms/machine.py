"""Machine: its document, parameter table and parameter values, with kinematics as methods."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import GeometryError, InputError
from pkmcal.geometry.rigid import pose, rotation
from pkmcal.mechanisms import kinematics, velocities, workspace
from pkmcal.mechanisms.carriers.contract import (
    ParameterKind,
    base_carriers,
    of_part,
    platform_carriers,
)
from pkmcal.mechanisms.closure import LimbEnds, joint_values, limb_ends, skeletons
from pkmcal.mechanisms.document import (
    CONSTANT_LENGTH_KIND,
    OFFSET_KIND,
    READING_SCALE_KIND,
    ActuatedLength,
    MechanismDocument,
    PassiveLength,
)
from pkmcal.mechanisms.document_checks import check_nominal
from pkmcal.mechanisms.joints import JOINT_AXIS_KINDS, axes_in_use, offset_rows
from pkmcal.mechanisms.layout import LimbLayout, layout_of
from pkmcal.mechanisms.motors import (
    built_in_fixed,
    built_in_ties,
    motor_ranges,
    motor_units,
    scale_tolerances,
)
from pkmcal.mechanisms.parameters import ParameterTable
from pkmcal.wording import count

if TYPE_CHECKING:
    from pkmcal.mechanisms.assembly_modes import AssemblyModes
    from pkmcal.mechanisms.follower import Follower


class _Row(NamedTuple):
    """Row of the :class:`ParameterTable`; kind : name of the prior sigma."""

    name: str
    unit: str
    kind: str
    label: str
    part: str
    nominal: float
    prior_sigma: float


@dataclass(frozen=True)
class Machine:
    """A parallel machine with parameter values.

    Attributes
    ----------
    document :
        The mechanism file from which the machine was read.
    parameters :
        Names, nominal values, prior sigmas, roles.
    layout :
        Indices of the limbs' parameters and readings.
    values :
        Present values (P,), in the table's order.
    model :
        Name of the file's model whose ``fixed`` and ``tied`` apply, None for the file's own.

    """

    document: MechanismDocument
    parameters: ParameterTable
    layout: LimbLayout
    values: Array
    model: str | None = None

    def __repr__(self) -> str:
        what = f"{count(self.n_legs, 'leg')}, {count(self.n_joints, 'reading')}"
        return (
            f"<Machine {self.name}: {self.document.motion}, {what}, {len(self.values)} parameters>"
        )

    @property
    def name(self) -> str:
        """Name of the machine in its file."""
        return self.document.name

    @property
    def n_legs(self) -> int:
        """Number of limbs."""
        return self.layout.n_legs

    @property
    def n_joints(self) -> int:
        """Number of readings in a configuration: one for each motor of a rod, crank or slider."""
        return self.layout.n_readings

    @property
    def redundancy(self) -> int:
        """Number of readings beyond the degrees of freedom, at home: constraints among the readings
        alone.
        """
        return self.n_joints - kinematics.mobility(self.layout, self.values, self.home())

    @property
    def joint_units(self) -> tuple[str, ...]:
        """Unit of each reading, ``m`` or ``rad``, (m,)."""
        return motor_units(self.document)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Default names of the readings' columns: by leg, or by motor if legs share motors."""
        if self.layout.shares_motors:
            return tuple(f"motor{k + 1}" for k in range(self.n_joints))
        return tuple(f"leg{j + 1}" for j in np.flatnonzero(self.layout.actuated >= 0))

    @property
    def joint_ranges(self) -> Array:
        """Smallest and largest reading of the file (m, 2), m or rad; NaN if not stated.

        A rod's ``range`` bounds its length, so the nominal offset and scale are removed.
        """
        return motor_ranges(self.document)

    @property
    def most_turn(self) -> tuple[float, str]:
        """Largest rotation of the platform about z to either side, rad, and the obstacle; infinity
        for a rigid platform.
        """
        return min((g.carrier.most_turn, g.carrier.obstacle) for g in self.layout.platform)

    def with_values(self, values: Array) -> Machine:
        """Copy with other parameter values (P,)."""
        return replace(self, values=np.array(values, dtype=float))

    def with_screws_held(self) -> Machine:
        """Copy with the same parameters whose readings are lengths: no joint turns a screw."""
        screws = replace(self.layout.screws, lead=np.zeros(len(self.layout.screws)))
        return replace(self, layout=replace(self.layout, screws=screws))

    def with_meeting_axes(self, poses: Array) -> Machine:
        """Copy whose universal joints have one centre each; what offsets of their axes take from a
        rod's length is, in the mean over poses (n, 4, 4), in its offset or constant length.
        """
        layout, values = self.layout, self.values.copy()
        ends = limb_ends(layout, values, self.middle_readings(), poses)
        rot, leg = poses[..., :3, :3], layout.offsets.leg
        growth = offset_rows(layout.offsets, values, rot, (ends.b - ends.a)[..., leg, :]).value
        rod = layout.rod[leg]
        values[rod[rod >= 0]] -= growth.mean(axis=0)[rod >= 0]
        none = replace(layout.offsets, offset=np.zeros_like(layout.offsets.offset))
        return replace(self, layout=replace(layout, offsets=none), values=values)

    @cached_property
    def size(self) -> float:
        """Largest of the lengths, coordinates and ranges of readings, m."""
        lengths = self.values[np.array(self.parameters.units) == "m"]
        ranges = self.joint_ranges[np.array(self.joint_units) == "m"].ravel()
        home = self.document.home.position if self.document.home else ()
        each = np.abs(np.concatenate([lengths, ranges[np.isfinite(ranges)], home]))
        return float(each.max(initial=0.0))

    def check_free(self, where: str) -> None:
        """Raise InputError if no parameter but radii, which do not move the platform, is free.

        where : field of the mechanism file, for the message.
        """
        if any(self.parameters.kinds[k] != "radius" for k in self.parameters.first_of_free()):
            return
        raise InputError(
            "every parameter that moves the platform is fixed, so there is nothing to calibrate",
            where=where,
            expected="at least one that is free",
            next_step="Remove names under fixed in the mechanism file",
        )

    def base_centers(self) -> Array:
        """Ends A (L, 3) on the base, m, base frame: joint centres, at mid-range if a crank or
        slider moves them.
        """
        return self._ends()[0]

    def platform_centers(self) -> Array:
        """Joint centres (L, 3) on the platform, m, platform frame; of an articulated platform with
        both frames parallel and hinges at zero.
        """
        return self._ends()[1]

    def base_axes(self) -> Array:
        """Unit axes of the joints on the base, (L, 3), base frame; NaN if the axis is not a
        parameter.
        """
        return self._axes(self.layout.base_axis)

    def platform_axes(self) -> Array:
        """Unit axes of the joints on the platform, (L, 3), platform frame; NaN if the axis is not a
        parameter.
        """
        return self._axes(self.layout.platform_axis)

    def radii(self) -> tuple[Array, ...]:
        """Tube radii of each leg, m."""
        return tuple(self.values[index] for index in self.layout.radius)

    def radii_of(self, legs: Integers, tubes: Integers) -> Array:
        """Radii (n,) m of tubes, from the indices of legs and tubes, (n,) each, from 0."""
        return self.values[self.layout.radius_of(legs, tubes)]

    def home(self) -> Array:
        """Starting pose (4, 4) of forward kinematics: the file's home, or one with the legs at
        mid-range.
        """
        return self._home.copy()

    def check_home(self) -> None:
        """Raise InputError if neither a home pose nor the ranges of all readings are in the
        file, or if a cable over a pulley has no reading at home.
        """
        if self.document.home is None and not np.isfinite(self.joint_ranges).all():
            raise InputError(
                what=f"mechanism {self.name!r} gives neither a home pose nor every leg's range",
                expected="length.range on each actuated leg, or home: {position: [x, y, z]}",
                next_step="add one of them, so that the right assembly can be chosen",
            )
        if self.document.home is None or not self.layout.windings:
            return
        readings, actuated = self.inverse(self.home()), self.layout.actuated
        for leg in np.concatenate([group.legs for group in self.layout.windings]).tolist():
            radius = getattr(self.document.legs[leg].base, "radius", None)
            if radius and actuated[leg] >= 0 and np.isnan(readings[actuated[leg]]):
                raise InputError(
                    what=f"the cable of leg {leg + 1} has no reading at home",
                    found=f"radius {radius:g} m",
                    expected="a platform joint outside the cable's pulley",
                    next_step="Write the radius in metres, or with its unit, such as 40 mm",
                )

    @cached_property
    def _home(self) -> Array:
        """Cached home pose."""
        if self.document.home is not None:
            h = self.document.home
            return pose(rotation(np.array(h.rotation_vector)), np.array(h.position))
        self.check_home()
        middle = self.joint_ranges.mean(axis=1)
        starts = kinematics.home_candidates(self.layout, self.values, middle)
        fk = kinematics.forward(self.layout, self.values, middle, starts)
        good = np.flatnonzero(fk.converged)
        if good.size == 0:
            raise GeometryError(
                what=f"mechanism {self.name!r} cannot be assembled with its legs at mid-range",
                found=f"closure error {float(fk.error.min()) * 1e3:.3g} mm",
                expected="a platform that all legs reach",
                next_step="check the nominal model's centres and ranges, or give home:"
                " {position: ...}",
                code="mechanism.not_assembled",
            )
        return fk.T_base_platform[good[0]]

    def inverse(self, T_base_platform: Array, near: Array | None = None) -> Array:
        """Inverse kinematics: readings (n, m) at platform poses (n, 4, 4), m or rad.

        A crank or slider has two solutions, of which the one nearest to mid-range, or to readings
        ``near`` (n, m), is returned. NaN if a limb cannot reach. Hinges of an articulated platform
        follow.
        """
        poses = _finite_array(T_base_platform, (4, 4), "T_base_platform")
        return kinematics.readings_at_poses(self.layout, self.values, poses, near)

    def forward(self, joints: Array, start: Array | None = None) -> Array:
        """Forward kinematics: platform poses T_base_platform (n, 4, 4) at readings (n, m).

        start : (4, 4) or (n, 4, 4), near the wanted assembly mode; by default the home pose.
        Raises GeometryError if the machine cannot be closed at the readings, or if the legs do not
        hold the platform.
        """
        self._check_held()
        fk = self.forward_result(joints, start)
        if not fk.converged.all():
            bad = np.flatnonzero(~np.atleast_1d(fk.converged))
            raise GeometryError(
                what=f"forward kinematics found no pose for {bad.size} of "
                f"{np.size(fk.converged)} configurations, first at row {bad[0]}",
                found=f"closure error {float(np.max(fk.error)) * 1e3:.3g} mm",
                expected="readings that the machine can reach",
                next_step="check the readings, or give a start nearer to the pose",
                code="readings.unreachable",
            )
        return fk.T_base_platform

    def forward_result(self, joints: Array, start: Array | None = None) -> kinematics.ForwardResult:
        """Result of :meth:`forward` with convergence and singularity; raises nothing for failed
        rows.
        """
        readings = _finite_array(joints, (self.n_joints,), "joints")
        begin = self._home if start is None else _finite_array(start, (4, 4), "start")
        return kinematics.forward(self.layout, self.values, readings, begin)

    def follower(self, start: Array | None = None) -> Follower:
        """Forward kinematics for a control loop: a function from readings (m,) to the pose (4, 4),
        which starts from its last result; see :class:`~pkmcal.mechanisms.follower.Follower`.

        start : (4, 4), present pose of the machine; by default the home pose.
        Raises GeometryError if the legs do not hold the platform.
        """
        self._check_held()
        from pkmcal.mechanisms.follower import Follower

        begin = self._home if start is None else _finite_array(start, (4, 4), "start")
        return Follower(self.layout, self.values, begin)

    def inverse_jacobian(self, T_base_platform: Array) -> Array:
        """Derivatives (n, m, 6) of the readings by the platform's twist, at poses (n, 4, 4).

        The twist is (omega, tau), base frame; see :func:`velocities.inverse_jacobian`.
        """
        poses = _finite_array(T_base_platform, (4, 4), "T_base_platform")
        return velocities.inverse_jacobian(self.layout, self.values, poses)

    def forward_jacobian(self, T_base_platform: Array) -> Array:
        """Derivatives (n, 6, m) of the platform's twist by the readings' rates, at poses (n, 4, 4).

        NaN at singular poses; see :func:`velocities.forward_jacobian`.
        """
        poses = _finite_array(T_base_platform, (4, 4), "T_base_platform")
        return velocities.forward_jacobian(self.layout, self.values, poses)

    def amplification(
        self, T_base_platform: Array, p_platform: Array | None = None
    ) -> velocities.Amplification:
        """Speeds, forces and condition numbers at poses (n, 4, 4), of a point (3,) of the platform,
        m; see :mod:`pkmcal.mechanisms.velocities`.
        """
        poses = _finite_array(T_base_platform, (4, 4), "T_base_platform")
        point = None if p_platform is None else _finite_array(p_platform, (3,), "p_platform")
        return velocities.amplification(self.layout, self.values, poses, point)

    def _check_held(self) -> None:
        """Raise GeometryError if the legs do not hold the platform."""
        if self.layout.underdetermined:
            raise GeometryError(
                what=f"the legs of {self.name!r} alone do not hold the platform: no pose follows"
                " from their readings",
                found=f"{self.layout.n_equations} equations for"
                f" {self.layout.own_motion.shape[1]} freedoms",
            )

    def limits(self) -> workspace.Limits:
        """Machine with its ranges and home assembly, for the functions of workspaces.

        Home is projected onto poses that rods and axes allow, because with calibrated parameters
        the file's home is not exact. Raises GeometryError if the legs do not hold the platform.
        """
        self._check_held()
        home = kinematics.on_manifold(self.layout, self.values, self._home)
        return workspace.Limits(
            self.layout,
            self.values,
            self.joint_ranges,
            self.joint_units,
            home.T_base_platform if home.converged else self.home(),
        )

    def reachable(self, T_base_platform: Array) -> workspace.Reach:
        """Whether the machine can take poses (n, 4, 4), and the obstacles where it cannot."""
        poses = _finite_array(T_base_platform, (4, 4), "T_base_platform")
        return workspace.reachable(self.limits(), poses)

    def extents(
        self, directions: Array, start: Array | None = None, most: float | None = None
    ) -> workspace.Extents:
        """Reach of the platform along directions (k, 3) or twists (k, 6) from a pose (4, 4), by
        default home; see :func:`pkmcal.mechanisms.workspace.extents`.
        """
        axes = np.asarray(directions, dtype=float)
        axes = _finite_array(axes, (6,) if axes.shape[-1:] == (6,) else (3,), "directions")
        begin = self._home if start is None else _finite_array(start, (4, 4), "start")
        return workspace.extents(self.limits(), axes.reshape(-1, axes.shape[-1]), begin, most)

    def grid(
        self, directions: Array | None = None, middle: Array | None = None, count: int = 25
    ) -> workspace.Grid:
        """Workspace at the orientation of a pose (4, 4), by default home: a volume along all
        translations of the motion, or a section along two directions (2, 3); see
        :func:`pkmcal.mechanisms.workspace.workspace_grid`.
        """
        own = np.eye(3)[self.layout.free[3:]]
        axes = own if directions is None else _finite_array(directions, (3,), "directions")
        begin = self._home if middle is None else _finite_array(middle, (4, 4), "middle")
        return workspace.workspace_grid(self.limits(), begin, axes, count)

    def check_path(self, T_base_platform: Array) -> workspace.PathCheck:
        """Whether a path of poses (n, 4, 4) stays in the workspace and crosses no singular pose,
        and where it fails.
        """
        poses = _finite_array(T_base_platform, (4, 4), "T_base_platform")
        return workspace.check_path(self.limits(), poses)

    def same_assembly(self, T_base_platform: Array, T_reference: Array | None = None) -> Booleans:
        """Whether poses (n, 4, 4) may belong to the assembly mode of a reference (4, 4), by default
        home.

        False is certain, True is not; see :func:`pkmcal.mechanisms.velocities.same_assembly`.
        """
        poses = _finite_array(T_base_platform, (4, 4), "T_base_platform")
        other = (
            self._home if T_reference is None else _finite_array(T_reference, (4, 4), "T_reference")
        )
        return velocities.same_assembly(self.layout, self.values, poses, other)

    def assembly_modes(self, joints: Array, rng: np.random.Generator) -> Array:
        """Distinct poses (k, 4, 4) that close the machine at one set of readings (m,)."""
        return self.assembly_modes_result(joints, rng).poses

    def assembly_modes_result(
        self, joints: Array, rng: np.random.Generator, most: int = 100_000
    ) -> AssemblyModes:
        """Result of :meth:`assembly_modes` with signs, counts and completeness. most : largest
        number of starts.
        """
        from pkmcal.mechanisms.assembly_modes import assembly_modes

        readings = _finite_array(joints, (self.n_joints,), "joints")
        return assembly_modes(self.layout, self.values, readings, self._home, rng, most)

    def middle_readings(self) -> Array:
        """Readings (m,) at mid-range, zero for unknown ranges."""
        return np.nan_to_num(self.joint_ranges.mean(axis=1))

    def to_document(self) -> dict[str, Any]:
        """Fields of a mechanism file with the present values."""
        out = self.document.model_dump(by_alias=True, exclude_none=True, mode="json")
        if not self.document.models:
            del out["models"]
        for leg, exact in zip(out["legs"], ~self.layout.unsure_scales, strict=True):
            if exact and leg["scale"] == 1:
                del leg["scale"]  # the default: no reading, or an exact scale of 1
        values = self.parameters.unit_axes(self.values)
        for name, value in zip(self.parameters.names, values, strict=True):
            node, key = field_of(out, name)
            node[key] = float(value)
        return out

    def _axes(self, index: Integers) -> Array:
        """Unit axes (L, 3) from the indices of their parameters, NaN for index -1."""
        axes = np.where(index >= 0, self.parameters.unit_axes(self.values)[index], np.nan)
        return axes.reshape(-1, 3)

    def ends_at(self, joints: Array, T_base_platform: Array) -> LimbEnds:
        """Ends of all limbs at readings (..., m) and poses (..., 4, 4).

        Hinges of an articulated platform are from inverse kinematics, zero where limbs cannot
        reach.
        """
        internal = None
        if self.layout.n_internal:
            turns = kinematics.inverse_result(self.layout, self.values, T_base_platform)[1]
            internal = np.nan_to_num(turns)
        return limb_ends(self.layout, self.values, joints, T_base_platform, internal)

    def arms_at(self, joints: Array) -> tuple[Array, ...]:
        """Points along each leg's arm on the base at readings (..., m), for nominal models; see
        :func:`~pkmcal.mechanisms.closure.skeletons`.
        """
        motions = joint_values(self.layout, self.values, joints)
        return skeletons(self.layout, self.values, motions)

    def _ends(self) -> tuple[Array, Array]:
        """Ends of all limbs at mid-range readings, each in the frame of its body, (L, 3) m."""
        ends = limb_ends(self.layout, self.values, self.middle_readings(), np.eye(4))
        return np.array(ends.a), np.array(ends.b)


def machine_from_document(
    document: MechanismDocument, where: Callable[..., str] | None = None
) -> Machine:
    """Machine from a validated mechanism file, with nominal values.

    where : function that returns a field's location in the file from its keys.
    Raises InputError if the nominal model is not a machine.
    """
    check_nominal(document, where)
    rows = list(_parameter_rows(document))
    ties = (*document.tied, *built_in_ties(document))
    # exact scales are no parameters
    exact = not (scale_tolerances(document) > 0).any()
    held = [entry for entry in document.fixed if not (exact and entry.endswith("].scale"))]
    table = ParameterTable(
        names=tuple(row.name for row in rows),
        units=tuple(row.unit for row in rows),
        kinds=tuple(row.kind for row in rows),
        labels=tuple(row.label for row in rows),
        parts=tuple(row.part for row in rows),
        nominal=np.array([row.nominal for row in rows]),
        tolerance=np.array([row.prior_sigma for row in rows]),
    ).with_roles((*held, *built_in_fixed(document)), ties)
    positions = {name: k for k, name in enumerate(table.names)}
    return Machine(document, table, layout_of(document, positions), table.nominal.copy())


def with_exact_scales(document: MechanismDocument) -> MechanismDocument:
    """Copy of a document in which all scales of readings are exact at their nominal values."""
    tolerance = document.tolerance.model_copy(update={"scale": 0.0})
    return document.model_copy(update={"tolerance": tolerance})


def _parameter_rows(document: MechanismDocument) -> Iterator[_Row]:
    """Rows of the parameter table, leg by leg; a scale's prior sigma is that of its reading."""
    axes, scales = axes_in_use(document), scale_tolerances(document)
    usual = document.tolerance.model_dump()
    for j, leg in enumerate(document.legs):
        path = f"legs[{j + 1}]"
        for side, carriers in (("base", base_carriers()), ("platform", platform_carriers())):
            node = getattr(leg, side)
            kinds = carriers[node.joint].parameters + (
                JOINT_AXIS_KINDS if (j, side) in axes else ()
            )
            yield from _part_rows(f"{path}.{side}", node, kinds, usual)
        if not isinstance(leg.length, PassiveLength):
            kind = OFFSET_KIND if isinstance(leg.length, ActuatedLength) else CONSTANT_LENGTH_KIND
            yield from _part_rows(f"{path}.length", leg.length, (kind,), usual)
        if scales[j] > 0:
            yield from _part_rows(
                path, leg, (READING_SCALE_KIND,), {READING_SCALE_KIND.tolerance: scales[j]}
            )
        for t, tube in enumerate(leg.tubes, start=1):
            name, label = f"{path}.tubes[{t}].radius", f"tube {t} radius"
            yield _Row(name, "m", "radius", label, "", tube.radius, usual["radius"])


def _part_rows(
    path: str, node: Any, kinds: tuple[ParameterKind, ...], tolerances: Mapping[str, float]
) -> Iterator[_Row]:
    """Rows for the parameters of one part of a document; constants and absent values have none."""
    for kind in kinds:
        value = of_part(node, kind)
        if kind.tolerance and value is not None:
            name = f"{path}.{kind.path}"
            label = kind.label or name.partition(".")[2].replace(".", " ").replace(
                "center", "centre"
            )
            part = kind.part or path.rpartition(".")[2]
            tolerance = tolerances[kind.tolerance]
            yield _Row(name, kind.unit, kind.tolerance, label, part, value, tolerance)


def field_of(document: Any, name: str) -> tuple[Any, Any]:
    """Container and key of a parameter among a file's fields, from its name, such as
    ``legs[1].base.center.x``.
    """
    *keys, last = name.replace("]", "").replace("[", ".").split(".")
    node = document
    for key in keys:
        node = node[int(key) - 1] if key.isdigit() else node[key]
    return node, "xyz".index(last) if isinstance(node, list) else last


def _finite_array(values: Array, tail: tuple[int, ...], name: str) -> Array:
    """Finite array with trailing axes ``tail``; raises InputError."""
    array = np.asarray(values, dtype=float)
    if array.shape[-len(tail) :] != tail:
        raise InputError(
            what=f"{name} has the wrong shape",
            found=str(array.shape),
            expected=f"(n, {', '.join(map(str, tail))})",
        )
    if not np.isfinite(array).all():
        raise InputError(
            what=f"{name} holds a value that is not a finite number", code="array.not_finite"
        )
    return array
