"""A machine's parameters: names, units, drawing values, tolerances, and which are free.

A parameter's name is its path in the mechanism file: ``legs[1].base.center.z``. Legs are
counted from 1, as people do. The estimator works on the free vector z; a tie makes several
parameters move together, so values = drawing + M z with a constant 0-1 matrix M.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from difflib import get_close_matches

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.errors import InputError


@dataclass(frozen=True)
class ParameterTable:
    """Every parameter of a machine, in one order.

    names, units, kinds : P entries; ``kinds`` is the tolerance's name: center, offset, radius.
    drawing, tolerance : (P,) drawing values and their standard deviations.
    fixed : names that keep their drawing value.
    tied : groups of names that change by the same amount.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    kinds: tuple[str, ...]
    drawing: Array
    tolerance: Array
    fixed: tuple[str, ...] = ()
    tied: tuple[tuple[str, ...], ...] = ()

    def __len__(self) -> int:
        return len(self.names)

    def index(self, name: str) -> int:
        """Position of a parameter; an InputError names the closest one otherwise."""
        try:
            return self.names.index(name)
        except ValueError:
            close = get_close_matches(name, self.names, n=1)
            raise InputError(
                what=f"there is no parameter {name!r}",
                expected=f"a name such as {close[0] if close else self.names[0]!r}",
                next_step="write the parameter as its path in the mechanism file, legs from 1",
            ) from None

    def with_roles(
        self, fixed: tuple[str, ...] = (), tied: tuple[tuple[str, ...], ...] = ()
    ) -> ParameterTable:
        """The same table with other fixed and tied parameters; all names are checked."""
        for name in (*fixed, *(n for group in tied for n in group)):
            self.index(name)
        return replace(self, fixed=tuple(fixed), tied=tuple(tied))

    def free_matrix(self) -> Array:
        """M (P, n_free) with values = drawing + M z: one column a free parameter or tie."""
        owner = np.arange(len(self))
        for group in self.tied:
            members = [self.index(name) for name in group]
            joined = np.isin(owner, owner[members])  # a name in two ties makes one of them
            owner[joined] = owner[members].min()
        held = {owner[self.index(name)] for name in self.fixed}
        columns = [k for k in np.unique(owner) if k not in held]
        return (owner[:, None] == np.array(columns, dtype=int)[None, :]).astype(float)

    def of_kind(self, kind: str) -> Integers:
        """Positions of the parameters whose tolerance is ``kind``."""
        return np.flatnonzero(np.array(self.kinds) == kind)
