"""Result of an estimate: values, covariance, statistics, and the problem that it solves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, short_repr
from pkmcal.identify.assembly import Assembled, batch_of
from pkmcal.identify.covariance import Information
from pkmcal.identify.scatter import EdgeScatter
from pkmcal.identify.state import State, estimated_unknowns
from pkmcal.identify.unknowns import Unknowns, own_blocks
from pkmcal.measurements import SHADING_SIGMA, Measurements
from pkmcal.measurements.rows import RowGroups
from pkmcal.mechanisms import Machine


class Purpose(Enum):
    """What the result of a calibration promises, by which it is judged.

    Heights alone determine only the tool's height above a bed. Legs that do not hold the platform
    (four cables under a spatial one) determine no pose by their readings; a controller commands
    their lengths.
    """

    POSE = "the tool's pose at given readings"
    HEIGHT = "the tool's height above the bed"
    LENGTHS = "the legs' lengths at given poses"


class GroupStatistics(NamedTuple):
    """Statistics of a group of rows, which have one noise scale.

    name : edges, poses, readings or links.
    scale : factor on the stated noise.
    chi2 : with that noise.
    n : numbers.
    dof : degrees of freedom that the residuals have left.
    noise_range : factors on the stated noise that the data allow, smallest and largest; None for
        edges.
    chance : p-value of all noise being as stated, of poses and links. None for edges, whose noise
        is estimated tube by tube, so that ``scale`` alone is judged, and for readings, whose noise
        is replaced where ``noise_range`` excludes the stated one.
    """

    name: str
    scale: float
    chi2: float
    n: float
    dof: float
    noise_range: tuple[float, float | None] | None
    chance: float | None


@dataclass(frozen=True)
class Statistics:
    """Goodness of fit and noise of an estimate.

    chi2, dof : of all residuals in use; robust weights count as fractions of a datum.
    chi2_edges, n_edges, chi2_joints, n_joints, chi2_drawing, n_drawing : sum of squares and number
        of residuals of edges, readings and nominal model.
    steps : solver steps.
    stopped : stopping reason, for people.
    noise_scale : factor on the edges' stated standard deviations that makes them agree with the
        residuals; 1 where their noise is not estimated.
    chi2_poses, n_poses, pose_scale : the same of measured poses; a full pose has six residuals.
    dof_edges, dof_joints, dof_poses : degrees of freedom of each kind of residual, tr(I - H); with
        those of links and nominal model their sum is ``dof``.
    shading : px, standard deviation of the common shift of all edges of one side of a tube at one
        station.
    reading_scale : factor on the readings' stated noise, 1 where the data do not contradict it.
    reading_range, pose_range : confidence interval of the factors on the stated noise, None for no
        upper bound (:mod:`pkmcal.identify.noise`).
    pose_chance : p-value of all noise being as stated, from the poses' residuals; None where the
        noise is not estimated.
    look_scatter : scatter of the result with the prediction from which edges were measured,
        relative to its standard deviations by noise; the covariance contains it.
    chi2_links, n_links, dof_links, link_scale, link_range, link_chance : the same of measurements
        that link two configurations.
    """

    chi2: float
    dof: float
    chi2_edges: float
    n_edges: float
    chi2_joints: float
    n_joints: int
    chi2_drawing: float
    n_drawing: int
    steps: int
    stopped: str
    noise_scale: float
    chi2_poses: float = 0.0
    n_poses: float = 0.0
    pose_scale: float = 1.0
    dof_edges: float = 0.0
    dof_joints: float = 0.0
    dof_poses: float = 0.0
    shading: float = SHADING_SIGMA
    reading_scale: float = 1.0
    reading_range: tuple[float, float | None] = field(default=(0.0, None), repr=False)
    pose_range: tuple[float, float | None] = field(default=(0.0, None), repr=False)
    pose_chance: float | None = field(default=None, repr=False)
    look_scatter: float = 0.0
    chi2_links: float = field(default=0.0, repr=False)
    n_links: float = field(default=0.0, repr=False)
    dof_links: float = field(default=0.0, repr=False)
    link_scale: float = field(default=1.0, repr=False)
    link_range: tuple[float, float | None] = field(default=(0.0, None), repr=False)
    link_chance: float | None = field(default=None, repr=False)

    @property
    def chi2_as_stated(self) -> float:
        """Chi-square per degree of freedom at the stated noise, NaN without degrees of freedom.

        At the estimated noise it is about 1 for any model, however wrong, because the factors on
        the noise are estimated from it.
        """
        chi2 = self.chi2_drawing + sum(one.chi2 * one.scale**2 for one in self.groups)
        return chi2 / self.dof if self.dof > 0 else float("nan")

    @property
    def groups(self) -> tuple[GroupStatistics, ...]:
        """Statistics of each group of rows."""
        rows = (
            ("edges", self.noise_scale, self.chi2_edges, self.n_edges, self.dof_edges, None, None),
            ("poses", self.pose_scale, self.chi2_poses, self.n_poses, self.dof_poses,
             self.pose_range, self.pose_chance),
            ("readings", self.reading_scale, self.chi2_joints, self.n_joints, self.dof_joints,
             self.reading_range, None),
            ("links", self.link_scale, self.chi2_links, self.n_links, self.dof_links,
             self.link_range, self.link_chance),
        )  # fmt: skip
        return tuple(GroupStatistics(*one) for one in rows)


class Linearization(NamedTuple):
    """Problem of an estimate with its final weights and noise, and its residuals and Jacobian at
    the solution.
    """

    assembled: Assembled
    info: Information

    def __repr__(self) -> str:
        return "Linearization(assembled=Assembled, info=Information)"


@dataclass(frozen=True)
class Estimate:
    """Result of an estimate, in the frames that ``gauge`` names.

    machine : machine with the identified values.
    state : all unknowns.
    joint_covariance : (n, n) of the machine's parameters, stations and mounts together, in the
        gauge, n = P + 6 S + 6 M; zero rows where fixed. Poses by (omega, tau), left perturbation of
        T_camera_base and T_mount.
    column_covariance : (n, n) of ``state.columns`` of each code.
    edge_residuals : (N, 2) whitened.
    edge_weights : (N,) robust weights 0..1.
    edge_noise : noise of the edges of each tube of a leg.
    edge_trust : (N,) IRLS weight of each edge by the tails of its tube's noise, one on average
        (:mod:`pkmcal.identify.edge_noise`).
    joint_residuals : (K, m) in standard deviations.
    data_share : (P,) 1 - posterior variance / prior variance in the same gauge: near 1 the value is
        determined by the data, near 0 by the nominal model.
    pose_residuals, pose_weights : (N, 6) whitened, and (N,) robust weights, of the measured poses.
    link_residuals, link_weights : (N,) of measurements that link two configurations, kind by kind.
    line_shading : (n,) px, standard deviation of the shading of each side of a tube at each
        station.
    line_shift, line_shift_sigma : (n,) px outward, estimated shading and its standard deviation.
        Lines are numbered by :func:`~pkmcal.measurements.effects.lines`.
    configurations : (K,) True where the configuration has measurements and its pose was estimated.
    gauge : name of the gauge, for people.
    problem : problem as assembled, with the stated noise and unit weights.
    """

    machine: Machine
    state: State
    joint_covariance: Array
    column_covariance: Mapping[str, Array]
    edge_residuals: Array
    edge_weights: Array
    edge_noise: EdgeScatter
    edge_trust: Array
    joint_residuals: Array
    data_share: Array
    configurations: Booleans
    statistics: Statistics
    gauge: str
    problem: Assembled
    pose_residuals: Array = field(default_factory=lambda: np.zeros((0, 6)))
    pose_weights: Array = field(default_factory=lambda: np.zeros(0))
    link_residuals: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    link_weights: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    line_shading: Array = field(default_factory=lambda: np.zeros(0))
    line_shift: Array = field(default_factory=lambda: np.zeros(0))
    line_shift_sigma: Array = field(default_factory=lambda: np.zeros(0))

    __repr__ = short_repr

    @cached_property
    def purpose(self) -> Purpose:
        """What the result promises."""
        if self.machine.layout.underdetermined:
            return Purpose.LENGTHS
        # components that are not measured have zero residuals
        poses, others = self.pose_residuals, self.edge_weights.size + self.link_weights.size
        only_heights = not others and len(poses) and not poses[:, :5].any()
        return Purpose.HEIGHT if only_heights else Purpose.POSE

    @cached_property
    def linearized(self) -> Linearization:
        """Stored problem with this estimate's weights and noise, linearized at its state.

        The lines' shading is zero in that state; like any other unknown that is not at its minimum,
        it is corrected by a linear step. Rows are evaluated when first used, and cached.
        """
        statistics, problem = self.statistics, self.problem.problem
        edges = self.edge_noise.batch().applied(problem.blocks, problem.data)
        noise = problem.joint_noise * statistics.reading_scale
        problem = replace(problem, data=edges, joint_noise=noise)
        if len(self.line_shading):
            problem = problem.shaded(self.line_shading[None])
        weights = RowGroups(
            self.edge_weights * self.edge_trust,
            self.pose_weights / statistics.pose_scale**2,
            self.link_weights / statistics.link_scale**2,
        )
        assembled = replace(self.problem, problem=problem)
        assembled = replace(assembled, problem=assembled.trusting(weights))
        start = batch_of(self.machine, assembled, self.state)
        return Linearization(assembled, Information(assembled.problem, start))

    def stated_edge_noise(self, measurements: Measurements) -> Measurements:
        """Measurements with the estimated noise of readings and edges as their stated noise.

        measurements : all or some of those of the estimate. ``edge_trust`` is a further factor on
            the weight of each edge.
        """
        scale, edges = self.statistics.reading_scale, measurements.edges
        value = self.edge_noise
        covariance = edges.covariance * value.scale[edges.tube, None, None] ** 2
        edges = replace(edges, covariance=covariance, shading=value.shading[edges.tube])
        noise = measurements.joint_noise * scale
        return replace(measurements, edges=edges, joint_noise=noise)

    def column_sigma(self, code: str) -> Array:
        """Standard deviations (n,) of ``state.columns`` of a code; empty where the code has no
        column.
        """
        return np.sqrt(np.diag(self.column_covariance.get(code, np.zeros((0, 0)))))

    @property
    def weights(self) -> dict[str, Array]:
        """Robust weights 0..1 of the measurements, by group of rows; readings have none."""
        return {
            "edges": self.edge_weights,
            "poses": self.pose_weights,
            "links": self.link_weights,
        }

    @property
    def covariance(self) -> Array:
        """Covariance (P, P) of the machine's parameters."""
        at = self._estimated_unknowns.machine
        return self.joint_covariance[at, at]

    @property
    def station_covariance(self) -> Array:
        """Covariance (S, 6, 6) of each station's pose, left perturbation of T_camera_base."""
        return own_blocks(self.joint_covariance, self._estimated_unknowns.stations, 6)

    @property
    def mount_covariance(self) -> Array:
        """Covariance (M, 6, 6) of each mount's pose, left perturbation of T_mount."""
        return own_blocks(self.joint_covariance, self._estimated_unknowns.mounts, 6)

    @property
    def _estimated_unknowns(self) -> Unknowns:
        return estimated_unknowns(self.state)
