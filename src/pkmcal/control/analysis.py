"""Visibility of the platform's motion by the legs, and singularities of visual servoing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array
from pkmcal.control.laws import task_of
from pkmcal.control.machine_view import MachineView, legs_at, moved_to, true_edges
from pkmcal.levels import NEARLY_ALL

UNSEEN_MOTION_VISIBILITY = 1e-6
"""Visibility below which a motion is unobservable; rounding leaves 1e-9."""


def matrix_at(view: MachineView, law: str, poses: Array) -> Array:
    """Interaction N (R, s, k 3, f) at goal poses (R, 4, 4), by the free twists in metres."""
    edges, legs = true_edges(view, poses), legs_at(view, poses)
    task = task_of(law, view, edges, edges, moved_to(legs, legs.b.mean(axis=-2)))
    return task.matrix.reshape(len(poses), len(view.legs), -1, task.matrix.shape[-1])


def visibility(matrix: Array) -> Array:
    """Smallest singular value of N (..., s, k, f) relative to its largest, (...); 0 if N is rank
    deficient.
    """
    rows = matrix.reshape(*matrix.shape[:-3], -1, matrix.shape[-1])
    values = np.linalg.svd(np.nan_to_num(rows), compute_uv=False)
    if rows.shape[-2] < rows.shape[-1]:
        return np.zeros(values.shape[:-1])
    return values[..., -1] / np.maximum(values[..., 0], 1e-300)


@dataclass(frozen=True)
class Visibility:
    """Visibility of the platform's motion over the workspace, smallest and median."""

    worst: float
    usual: float

    @classmethod
    def of(cls, matrix: Array) -> Visibility:
        """From the interaction (R, s, k, f) at poses over the workspace."""
        values = visibility(matrix)
        return cls(float(values.min()), float(np.median(values)))

    @property
    def blind(self) -> bool:
        """Whether some motion is unobservable over most of the workspace."""
        return self.usual < UNSEEN_MOTION_VISIBILITY

    @property
    def fading(self) -> bool:
        """Whether nearly all of the median visibility is lost at some poses."""
        return self.worst < (1 - NEARLY_ALL) * self.usual
