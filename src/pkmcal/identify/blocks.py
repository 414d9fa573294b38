"""The arrays that an estimation works on: edges in blocks, and the unknowns of many runs.

Edges that share their noise are whitened together: a *block* is g edges (g = 1 for edges
fitted in photographs, g = 2 for the two edges that stand for a measured axis, [A] Table 1)
of one tube at one station, with one 2g x 2g whitening matrix and one robust weight.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers


@dataclass(frozen=True)
class Blocks:
    """Where the edges are: K configurations of G blocks, padded; the same for all runs.

    leg, station, camera, radius : (K, G) leg, station, camera, position of the tube's radius.
    side : (K, G, g). present : (K, G) False for padding. line : (K, G) number of the tube's side at
    its station, whose edges are shaded alike in all photographs; empty where nothing is.
    """

    leg: Integers
    station: Integers
    camera: Integers
    radius: Integers
    side: Integers
    present: Booleans
    line: Integers = field(default_factory=lambda: np.zeros((0, 0), dtype=int))


@dataclass(frozen=True)
class Data:
    """Numbers measured in each run; leading axis B, or 1 where all runs share them.

    basis : (B, K, G, g, 3, 2). whiten : (B, K, G, 2g, 2g). optics : (B, K, G, 2g, w) change of
    the measured normals, less the predicted ones', by the w unknowns of their camera: the edge
    shift (px), then its intrinsics where they are refined (in units of their prior).
    joints : (B, K, m). weight : (B, K, G) of the blocks, 0..1 over the noise scale squared.
    """

    basis: Array
    whiten: Array
    optics: Array
    joints: Array
    weight: Array


@dataclass(frozen=True)
class BatchState:
    """Unknowns of B runs: z (B, nz) free parameters, T_camera_base (B, S, 4, 4),
    T_base_platform (B, K, 4, 4), optics (B, C, w), T_mount (B, M, 4, 4) of boards,
    internal (B, K, n) of articulated platforms, shading (B, n) px, outward, of the lines.
    """

    z: Array
    T_camera_base: Array
    T_base_platform: Array
    optics: Array
    T_mount: Array = field(default_factory=lambda: np.zeros((0, 0, 4, 4)))
    internal: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))
    shading: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        """Runs without boards or hinges get none each, so that all fields select alike."""
        if len(self.T_mount) != len(self.z):
            object.__setattr__(self, "T_mount", np.zeros((len(self.z), 0, 4, 4)))
        if len(self.internal) != len(self.z):
            none = np.zeros((*self.T_base_platform.shape[:2], 0))
            object.__setattr__(self, "internal", none)
        if len(self.shading) != len(self.z):
            object.__setattr__(self, "shading", np.zeros((len(self.z), 0)))
