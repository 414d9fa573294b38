"""The unknowns of the joint estimate: their names, their columns, and their values in many runs.

Shared by all configurations, in this order of columns:

- **machine** : free combinations z of its parameters, ``theta = drawing + free z``.
- **stations** : left perturbation (omega, tau) of each T_camera_base.
- **optics** : of each camera its edge shift (px), then its intrinsics where they are refined (in
  units of their prior).
- **shading** : shift of each tube's side at each station, where light gives it one (in units of its
  standard deviation).
- **breathing** : of each station's photograph the excess of its focal lengths, where the camera is
  held by hand (in units of its standard deviation).
- **sizes** : of each board whose size is not known exactly, the excess of its size over what its
  file says (in units of its tolerance).
- **mounts** : left perturbation of each T_mount, of boards and targets.
- **linked** : the own unknowns, see below, of each configuration that a measurement links to
  another: the rows of both depend on them, so they are shared.

Each other configuration has unknowns of its own besides: the platform's motion (left perturbation
of T_base_platform, along the directions that the machine has) and, on an articulated platform, its
hinges; :attr:`~pkmcal.mechanisms.layout.LimbLayout.own_motion` says how.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from pkmcal.arrays import Array, Integers

Name = Literal[
    "machine",
    "stations",
    "edge shifts",
    "intrinsics",
    "optics",
    "shading",
    "breathing",
    "sizes",
    "mounts",
    "linked",
]


@dataclass(frozen=True)
class Unknowns:
    """How many of each there are, and so in which columns each stands.

    n_free : of the machine. n_optics : of each camera, one and the refined intrinsics. n_lines :
    tubes' sides at stations with a shading of their own. n_breathing : stations where focal lengths
    breathe, all or none. n_sizes : boards of unsure size. n_linked : own unknowns, all together, of
    the configurations that are linked.
    """

    n_free: int
    n_stations: int
    n_cameras: int
    n_optics: int = 1
    n_lines: int = 0
    n_mounts: int = 0
    n_breathing: int = 0
    n_sizes: int = 0
    n_linked: int = 0

    @cached_property
    def machine(self) -> slice:
        """The machine's columns."""
        return slice(0, self.n_free)

    @cached_property
    def stations(self) -> slice:
        """The stations' columns, six each."""
        return slice(self.n_free, self.n_free + 6 * self.n_stations)

    @cached_property
    def optics(self) -> slice:
        """The cameras' columns, ``n_optics`` each."""
        first = self.stations.stop
        return slice(first, first + self.n_cameras * self.n_optics)

    @cached_property
    def shading(self) -> slice:
        """The lines' columns."""
        return slice(self.optics.stop, self.optics.stop + self.n_lines)

    @cached_property
    def breathing(self) -> slice:
        """The focal lengths' columns, one a station."""
        return slice(self.shading.stop, self.shading.stop + self.n_breathing)

    @cached_property
    def sizes(self) -> slice:
        """The boards' sizes' columns."""
        return slice(self.breathing.stop, self.breathing.stop + self.n_sizes)

    @cached_property
    def mounts(self) -> slice:
        """The mounts' columns, six each."""
        return slice(self.sizes.stop, self.sizes.stop + 6 * self.n_mounts)

    @cached_property
    def linked(self) -> slice:
        """The columns of linked configurations' own unknowns."""
        return slice(self.mounts.stop, self.mounts.stop + self.n_linked)

    @cached_property
    def count(self) -> int:
        """Number of shared unknowns, na."""
        return self.linked.stop

    def columns(self, *names: Name) -> Integers:
        """Where the named unknowns stand, in increasing order."""
        optics = np.arange(self.optics.start, self.optics.stop).reshape(-1, self.n_optics)
        where: dict[str, Integers] = {
            "edge shifts": optics[:, 0],
            "intrinsics": optics[:, 1:].ravel(),
        }
        for name in (
            "machine",
            "stations",
            "optics",
            "shading",
            "breathing",
            "sizes",
            "mounts",
            "linked",
        ):
            part: slice = getattr(self, name)
            where[name] = np.arange(part.start, part.stop)
        none = np.zeros(0, dtype=int)
        return np.unique(np.concatenate([none, *(where[name] for name in names)]))


def own_blocks(matrix: Array, part: slice, width: int) -> Array:
    """Each one's own block of a covariance, (n, width, width), of unknowns ``width`` wide each."""
    n = (part.stop - part.start) // width
    own = matrix[part, part].reshape(n, width, n, width)
    return np.einsum("iaib->iab", own)


@dataclass(frozen=True)
class BatchState:
    """Values of the unknowns of B runs: z (B, nz) free parameters, T_camera_base (B, S, 4, 4),
    T_base_platform (B, K, 4, 4), optics (B, C, w), T_mount (B, M, 4, 4) of boards,
    internal (B, K, n) of articulated platforms, shading (B, n) of the lines, outward, in units of
    its standard deviation, breathing (B, n) of the stations' focal lengths, sizes (B, n) of the
    boards of unsure size, in units of their own. linked : (B, J, 4, 4) T_base_platform of the
    linked configurations, in the state of some configurations only; else none, for
    T_base_platform has them.
    """

    z: Array
    T_camera_base: Array
    T_base_platform: Array
    optics: Array
    T_mount: Array = field(default_factory=lambda: np.zeros((0, 0, 4, 4)))
    internal: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))
    shading: Array = field(default_factory=lambda: np.zeros((0, 0)))
    breathing: Array = field(default_factory=lambda: np.zeros((0, 0)))
    sizes: Array = field(default_factory=lambda: np.zeros((0, 0)))
    linked: Array = field(default_factory=lambda: np.zeros((0, 0, 4, 4)))

    def __post_init__(self) -> None:
        """Runs without boards or hinges get none each, so that all fields select alike."""
        none = {
            "internal": (self.T_base_platform.shape[1], 0),
            "T_mount": (0, 4, 4),
            "linked": (0, 4, 4),
        }
        for name in ("T_mount", "internal", "shading", "breathing", "sizes", "linked"):
            if len(getattr(self, name)) != len(self.z):
                empty = np.zeros((len(self.z), *none.get(name, (0,))))
                object.__setattr__(self, name, empty)
