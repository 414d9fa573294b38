"""Parameters of a machine: names, units, nominal values, prior sigmas, and which are free.

A parameter's name is its path in the mechanism file, ``legs[1].base.center.z``, with legs counted
from 1. The estimator works on the vector z of free unknowns. A tie makes several parameters change
together, and an axis has two rotations, so values = nominal values + M z with a constant matrix M.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cached_property

import numpy as np

from pkmcal.arrays import Array, Integers, short_repr
from pkmcal.errors import InputError
from pkmcal.levels import ROUNDING

EVERY_LEG = "legs[*]"
"""Beginning of an entry that stands for all legs."""


@dataclass(frozen=True)
class ParameterTable:
    """All parameters of a machine, in a fixed order.

    names, units, kinds : P entries. Units are m, rad, 1 for components of directions, empty for
        ratios. ``kinds`` are names of prior sigmas: center, offset, radius, axis, arm, angle,
        scale.
    labels : names for people, without the leg: ``base centre z``.
    parts : part of the leg that a parameter changes: its ``base`` or ``platform`` joint, its
        ``rod``, the ``zero`` or the ``lead`` of its reading, or a part named by its carrier; empty
        for a tube's radius, which is no part of the mechanism.
    nominal, tolerance : (P,) nominal values and their prior sigmas.
    fixed : names that keep their nominal value.
    tied : groups of names that change by the same amount.
    opposed : for each group, the names that change by the opposite amount.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    kinds: tuple[str, ...]
    labels: tuple[str, ...]
    parts: tuple[str, ...]
    nominal: Array
    tolerance: Array
    fixed: tuple[str, ...] = ()
    tied: tuple[tuple[str, ...], ...] = ()
    opposed: tuple[tuple[str, ...], ...] = ()

    __repr__ = short_repr

    def __len__(self) -> int:
        return len(self.names)

    def index(self, name: str) -> int:
        """Index of a parameter; raises InputError with the closest name."""
        try:
            return self.names.index(name)
        except ValueError:
            close = get_close_matches(name, self.names, n=1)
            raise InputError(
                what="there is no such parameter",
                found=repr(name),
                expected=f"a name such as {close[0] if close else self.names[0]!r}",
                next_step="write the parameter as its path in the mechanism file, legs from 1",
            ) from None

    def in_words(self, name: str) -> str:
        """Name of a parameter for people: ``leg 3 base centre z``."""
        leg = name.partition("]")[0].removeprefix("legs[")
        return f"leg {leg} {self.labels[self.index(name)]}"

    def with_roles(
        self, fixed: tuple[str, ...] = (), tied: tuple[tuple[str, ...], ...] = ()
    ) -> ParameterTable:
        """Copy with other fixed and tied parameters; all names are checked.

        ``legs[1].base.axis`` and ``legs[1].base.center`` stand for all their components,
        ``legs[*]`` for all legs that have the rest of the path, and a name after ``-`` in a tie
        changes by the opposite. A single component of an axis can be fixed only if its nominal
        value is zero: the axis then rotates orthogonally to it. Otherwise the axis is fixed as a
        whole.
        """
        fixed = tuple(
            n for entry in fixed for e in self._for_all_legs(entry) for n in self._members(e)
        )
        groups = [part for group in tied for part in self._component_ties(group)]
        return replace(
            self,
            fixed=fixed,
            tied=tuple(tuple(name for name, _ in part) for part in groups),
            opposed=tuple(tuple(name for name, sign in part if sign < 0) for part in groups),
        )

    def _for_all_legs(self, entry: str) -> tuple[str, ...]:
        """Entries for which an entry with ``legs[*]`` stands."""
        if EVERY_LEG not in entry:
            return (entry,)
        first, _, rest = entry.partition(EVERY_LEG)
        legs = dict.fromkeys(n[: n.index("]") + 1] for n in self.names)
        every = [f"{leg}{rest}" for leg in legs if self._components(f"{leg}{rest}")]
        if first or not every:
            self.index(entry)  # raises the error about a name
        return tuple(every)

    def _components(self, entry: str) -> tuple[str, ...]:
        """Names of the parameters that an entry stands for, possibly none."""
        return tuple(n for n in self.names if n == entry or n.startswith(f"{entry}."))

    def _members(self, entry: str) -> tuple[str, ...]:
        """Names of the parameters that an entry under ``fixed`` or ``tied`` stands for; raises
        InputError.
        """
        whole = self._components(entry)
        if len(whole) > 1:
            return whole
        k = self.index(entry)
        if self.kinds[k] == "axis" and abs(self.nominal[k]) > ROUNDING:
            raise InputError(
                what=f"{entry} cannot be held alone: an axis is one direction",
                expected=f"the whole axis, {entry.rpartition('.')[0]!r}",
            )
        return (entry,)

    def _component_ties(self, group: tuple[str, ...]) -> list[list[tuple[str, int]]]:
        """Ties that a group stands for, as names with signs; whole centres or axes are tied
        component by component.
        """
        entries = [
            (e, -1 if entry.startswith("-") else 1)
            for entry in group
            for e in self._for_all_legs(entry.removeprefix("-"))
        ]
        members = [[(name, sign) for name in self._members(e)] for e, sign in entries]
        axes = {self.kinds[self.index(m[0][0])] == "axis" for m in members}
        what = ""
        if len({len(m) for m in members}) > 1:
            what = "a whole centre or axis is tied to a single number"
        elif len(axes) > 1:
            what = "an axis is tied to a centre"
        elif len({name for m in members for name, _ in m}) < sum(len(m) for m in members):
            what = "a parameter is tied to itself"
        if what:
            text = ", ".join(group)
            raise InputError(what, found=text, expected="entries of one kind, each once")
        if True in axes:
            self._check_parallel(group, members)
        return [list(tie) for tie in zip(*members, strict=True)]

    def _check_parallel(self, group: tuple[str, ...], members: list[list[tuple[str, int]]]) -> None:
        """Check that tied axes are whole and parallel in the nominal model."""
        axes = np.array([[s * self.nominal[self.index(n)] for n, s in m] for m in members])
        if axes.shape[1] != 3 or np.abs(axes - axes[0]).max() > ROUNDING:
            raise InputError(
                what="axes that differ in the nominal model are tied",
                found=", ".join(group),
                expected="whole axes with the same direction in their bodies' frames",
            )

    @cached_property
    def axes(self) -> Integers:
        """Indices (n, 3) of the axes' components."""
        return np.flatnonzero(np.array(self.kinds, dtype=object) == "axis").reshape(-1, 3)

    @cached_property
    def _free(self) -> Array:
        """Matrix M of :meth:`free_matrix`, cached."""
        owner, sign = self._owners()
        fixed = [self.index(name) for name in self.fixed]
        # One column for each group of tied parameters that is not fixed, axes apart.
        still = {owner[k] for k in fixed if self.kinds[k] != "axis"}
        plain = [k for k in np.unique(owner) if k not in still and self.kinds[k] != "axis"]
        matrix = (owner[:, None] == np.array(plain, dtype=int)[None, :]) * sign[:, None]
        # Up to two columns for each group of tied axes.
        tangents = [
            self._tangent(np.flatnonzero(owner == axis[0]), sign, fixed)
            for axis in self.axes
            if owner[axis[0]] == axis[0]
        ]
        return np.concatenate([matrix.astype(float), *tangents], axis=1)

    def _owners(self) -> tuple[Integers, Array]:
        """First parameter with which each one changes, (P,), and the sign, (P,).

        Ties with a common name are merged.
        """
        owner, sign = np.arange(len(self)), np.ones(len(self))
        opposed = self.opposed or ((),) * len(self.tied)
        for group, against in zip(self.tied, opposed, strict=True):
            members = np.array([self.index(name) for name in group])
            own = np.array([-1.0 if name in against else 1.0 for name in group])
            turn = {owner[k]: s * sign[k] for k, s in zip(members, own, strict=True)}
            if any(turn[owner[k]] != s * sign[k] for k, s in zip(members, own, strict=True)):
                raise InputError(
                    what="a parameter is tied to its own opposite",
                    found=", ".join(group),
                    code="mechanism.tied_to_opposite",
                )
            # Merge the groups into the first one's, with signs relative to it.
            first = min(turn)
            for root, flip in turn.items():
                joined = owner == root
                sign[joined] *= flip * turn[first]
                owner[joined] = first
        return owner, sign

    def _tangent(self, first: Integers, sign: Array, fixed: list[int]) -> Array:
        """Columns (P, 0 to 2): rotations of tied axes whose x components are at ``first``.

        Fixed components leave only the rotation orthogonal to them.
        """
        # Orthogonal complement of the axis and the fixed components.
        axis = self.nominal[first[0] : first[0] + 3]
        held = [np.eye(3)[i] for k in first for i in range(3) if k + i in fixed]
        span = np.array([axis, *held])
        rank = int(np.linalg.matrix_rank(span, tol=ROUNDING))
        basis = np.linalg.svd(span)[2][rank:].T
        out = np.zeros((len(self), basis.shape[1]))
        for k in first:
            out[k : k + 3] = sign[k] * basis
        return out

    def free_matrix(self) -> Array:
        """Matrix M (P, n_free) with values = nominal values + M z: one column for each free
        parameter or tie.

        An axis has two columns, its rotations (rad). Its components stay on the tangent plane at
        the nominal axis, where the length is not free (see :meth:`on_tangents`).
        """
        return self._free.copy()

    def on_tangents(self, values: Array) -> Array:
        """Values (..., P) with each axis rescaled to end on the tangent plane at the nominal axis.
        Directions do not change.
        """
        if not self.axes.size:
            return values
        axis = values[..., self.axes]
        size = np.sum(axis * self.nominal[self.axes], axis=-1, keepdims=True)
        out = np.array(values, dtype=float)
        out[..., self.axes] = axis / np.where(size > 0.1, size, 1.0)
        return out

    def to_free(self, values: Array) -> Array:
        """Free unknowns z (..., n_free) of values (..., P) by least squares; deviations from fixed
        or tied parameters are dropped.
        """
        change = self.on_tangents(values) - self.nominal
        return change @ np.linalg.pinv(self._free).T

    def first_of_free(self) -> Integers:
        """Index (n_free,) of the parameter that each free unknown changes most."""
        return np.argmax(np.abs(self._free), axis=0)

    def tolerances_free(self) -> Array:
        """Prior sigma of each free unknown, (n_free,)."""
        return self.tolerance[self.first_of_free()]

    def free_names(self) -> tuple[str, ...]:
        """Name of each free unknown; rotations of an axis are numbered."""
        names, counts = list[str](), dict[str, int]()
        for k in self.first_of_free():
            name = self.names[k]
            if self.kinds[k] == "axis":
                whole = self.names[self.axes[np.any(self.axes == k, axis=1)][0, 0]]
                whole = whole.rpartition(".")[0]
                counts[whole] = counts.get(whole, 0) + 1
                name = f"{whole} ({counts[whole]})"
            names.append(name)
        return tuple(names)

    def unit_axes(self, values: Array) -> Array:
        """Values (..., P) with axes of unit length, as in files."""
        if not self.axes.size:
            return values
        out = np.array(values, dtype=float)
        axis = out[..., self.axes]
        size = np.linalg.norm(axis, axis=-1, keepdims=True)
        # unit axes stay unchanged to the last digit
        out[..., self.axes] = axis / np.where(np.abs(size - 1) < 1e-15, 1.0, size)
        return out

    def of_kind(self, kind: str) -> Integers:
        """Indices of the parameters whose prior sigma is ``kind``."""
        return np.flatnonzero(np.array(self.kinds) == kind)
