"""Study of [C] IV: an H4 with a board on its nacelle, and a camera on its base.

81 poses, of which 71 are drawn for the calibration and 10 for control; board poses with noise of
0.2 mm and 0.03 degrees in each component. Compared are equations 3 and 5 as printed and whitened,
the joint estimate and the Cramér-Rao bound, with models that are equal to the truth, richer or
poorer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.hand_eye import size_of, solve_pairs
from pkmcal.identify.methods.inverse_kinematic import (
    PoseFit,
    PoseFitForm,
    fit_machine_to_poses,
    pose_problem,
)
from pkmcal.identify.rotation_axis import rotation_axis
from pkmcal.identify.state import State
from pkmcal.identify.unknowns import BatchState
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.kinematics import forward, on_manifold, readings_at_poses
from pkmcal.studies.engine import StudyResult
from pkmcal.studies.estimates import (
    Fitted,
    drawn_from_bound,
    freedom,
    joint,
    nominal_estimate,
    tool_errors,
    tool_positions,
)
from pkmcal.studies.paper_c_machine import (
    PAPER_C_BOARD_POSE,
    PAPER_C_CAMERA_POSE,
    Deviations,
    H4ModelKind,
    measured_volume_grid,
    model,
    table_2_of,
    true_values,
    workspace,
)
from pkmcal.studies.paper_c_validation import control_residuals, square, straightness_along_rulers
from pkmcal.studies.simulated import (
    Noise,
    SimulatedRuns,
    Viewpoints,
    joint_problem,
    measurements,
    simulate_runs,
)
from pkmcal.studies.tasks import Batch, Key, Population, Quantity, Sample

PAPER_C_NOMINAL, EQ3_AS_PRINTED, EQ5_AS_PRINTED, EQ5_WHITENED, PAPER_C_JOINT, PAPER_C_BOUND = (
    "drawing", "eq. 3", "eq. 5", "eq. 5 whitened", "joint", "bound",
)  # fmt: skip
ROTATION_AXIS_METHOD = "axis of rotation"
METHODS_BY_TRUTH: dict[H4ModelKind, dict[H4ModelKind, tuple[str, ...]]] = {
    "design": {
        "design": (
            PAPER_C_NOMINAL,
            EQ3_AS_PRINTED,
            EQ5_AS_PRINTED,
            EQ5_WHITENED,
            PAPER_C_JOINT,
            PAPER_C_BOUND,
        ),
        "calibration": (EQ5_AS_PRINTED, EQ5_WHITENED, PAPER_C_JOINT),
    },
    "calibration": {
        "design": (PAPER_C_NOMINAL, EQ3_AS_PRINTED, PAPER_C_JOINT),
        "calibration": (EQ3_AS_PRINTED, EQ5_AS_PRINTED, EQ5_WHITENED, PAPER_C_JOINT, PAPER_C_BOUND),
    },
    "rods": {
        "design": (PAPER_C_JOINT,),
        "calibration": (PAPER_C_JOINT,),
        "rods": (EQ5_WHITENED, PAPER_C_JOINT),
    },
}
"""For each truth, the fitted models and their methods."""
H4_MODEL_KINDS: tuple[H4ModelKind, ...] = tuple(METHODS_BY_TRUTH)
PRINTED_EQUATION_FORMS: dict[str, PoseFitForm] = {
    EQ3_AS_PRINTED: "joint",
    EQ5_AS_PRINTED: "implicit",
}

PAPER_C_BATCH_RUNS = 20
RODS_SHARE = 5
"""Ratio of the number of runs to that with rods, which have 82 parameters and take ten times as
long.
"""
LARGER_WORKSPACE_FACTOR = 1.25
"""Size of the second workspace for errors, relative to the measured volume. The errata's prototype
does not name its own; this factor reproduces its figures.
"""
PAPER_C_COMPARED_POSES = 100
"""Number of poses in each run at which machines are compared with the truth."""
PAPER_C_BOUND_STREAM, COMPARED_POSES_STREAM, RULED_LINES_STREAM = 1, 2, 3
"""Random streams of a batch, besides 0 of the simulation."""
PAPER_C_QUANTITIES = {
    "shift": Quantity("rms", 1e3, "mm"),
    "turn": Quantity("rms", 1e3, "mrad"),
    "larger_shift": Quantity("rms", 1e3, "mm"),
    "larger_turn": Quantity("rms", 1e3, "mrad"),
    "chi2": Quantity("mean"),
}
"""Tool's errors over the measured volume and over a larger workspace, and chi2 per degree of
freedom, which is NaN if rows are not whitened.
"""


@dataclass(frozen=True)
class H4ByBoard:
    """Setting of [C] IV.

    turn, shift : standard deviations of a board's pose in each component, rad and m. joint_noise :
    of a reading, rad. deviations : of the true machines from the nominal model. control : number of
    held-out poses.
    """

    turn: float = float(np.radians(0.03))
    shift: float = 2e-4
    joint_noise: float = 1e-5
    deviations: Deviations = field(default_factory=Deviations)
    control: int = 10

    doing = "Board poses"
    quantities = PAPER_C_QUANTITIES

    @property
    def noise(self) -> Noise:
        """Noise of board poses and readings."""
        return Noise(self.joint_noise, pose=np.repeat([self.turn, self.shift], 3))

    def populations(self, runs: int) -> list[Population]:
        """Population of each truth; fewer runs with rods."""
        out = [
            Population(kind, runs, PAPER_C_BATCH_RUNS) for kind in H4_MODEL_KINDS if kind != "rods"
        ]
        return [*out, Population("rods", max(2, runs // RODS_SHARE), PAPER_C_BATCH_RUNS // 4)]

    def draw(self, batch: Batch) -> SimulatedRuns:
        """Draw true machines and their poses: those for the calibration first, then those for
        control.
        """
        return self.simulated(kind_of(batch.population), batch.runs, batch.generator(0))

    def simulated(self, kind: H4ModelKind, runs: int, rng: np.random.Generator) -> SimulatedRuns:
        """Simulated runs of one kind of truth."""
        machine = model(kind)
        theta = true_values(kind, self.deviations, runs, rng)
        order = np.argsort(rng.random((runs, len(measured_volume_grid()))), axis=1)
        poses = measured_volume_grid()[order]
        if kind == "rods":  # forearms of two rods tilt the nacelle a little
            poses = on_manifold(machine.layout, theta[:, None], poses).T_base_platform
        readings = readings_at_poses(machine.layout, theta[:, None], poses)
        station = np.zeros(len(measured_volume_grid()), dtype=int)
        view = Viewpoints(PAPER_C_CAMERA_POSE[None], station, T_platform_board=PAPER_C_BOARD_POSE)
        return simulate_runs(machine, theta, readings, poses, view, self.noise, rng, self.control)

    def solve(self, batch: Batch, data: SimulatedRuns) -> dict[Key, Fitted]:
        """Estimates with every model and method of METHODS_BY_TRUTH for this truth."""
        kind = kind_of(batch.population)
        return {
            (kind, name, method): fit
            for name, methods in METHODS_BY_TRUTH[kind].items()
            for method, fit in _fits(
                data, name, methods, batch.generator(PAPER_C_BOUND_STREAM)
            ).items()
        }

    def judge(
        self, batch: Batch, data: SimulatedRuns, fits: Mapping[Key, Fitted]
    ) -> dict[Key, Sample]:
        """Errors of the tool; for the paper's machine as truth, also the paper's validation."""
        space, lines = batch.generator(COMPARED_POSES_STREAM), batch.generator(RULED_LINES_STREAM)
        near, far = (
            tool_positions(data, workspace(PAPER_C_COMPARED_POSES, space, larger))
            for larger in (1.0, LARGER_WORKSPACE_FACTOR)
        )
        papers = batch.population == "design"
        out: dict[Key, Sample] = {}
        for (kind, name, method), fit in fits.items():
            machine = model(kind_of(name))
            # Errors of the tool over the measured volume and the larger workspace.
            one, other = (
                tool_errors(machine.layout, fit.theta, at, self.turn, self.shift)
                for at in (near, far)
            )
            figures = {
                "chi2": np.full(batch.runs, np.nan),
                "shift": one.shift, "turn": one.turn,
                "larger_shift": other.shift, "larger_turn": other.turn,
            }  # fmt: skip
            if papers and method != PAPER_C_BOUND:
                # The paper's validation.
                off = control_residuals(machine, fit, data)
                figures |= {
                    "control_mean": off.mean(axis=1),
                    "control_rms": np.sqrt(np.mean(off**2, axis=1)),
                    "straightness": straightness_along_rulers(machine, fit.theta, data, lines),
                    "square": square(machine, fit.theta, data),
                }
            if papers and name == "design":
                figures["table_2"] = table_2_of(machine, fit.theta)
            out[kind, name, method] = Sample(figures | fit.extra)
        return out | {("design", ROTATION_AXIS_METHOD): axis_of_rotation(data)} if papers else out


def kind_of(name: str) -> H4ModelKind:
    """Kind of truth or model by its name."""
    return next(kind for kind in H4_MODEL_KINDS if kind == name)


def _fits(
    data: SimulatedRuns, name: H4ModelKind, methods: tuple[str, ...], rng: np.random.Generator
) -> dict[str, Fitted]:
    """Estimates with one model by the given methods. Only the model with rods needs priors from the
    nominal model.
    """
    machine, prior = model(name), name == "rods"
    begin = start(machine, data)
    out: dict[str, Fitted] = {}
    if PAPER_C_NOMINAL in methods:
        out[PAPER_C_NOMINAL] = nominal_estimate(machine, len(data.theta))
    for method, form in PRINTED_EQUATION_FORMS.items():
        if method in methods:
            out[method] = estimate_of_pose_fit(at_poses(machine, data, begin, form, whitened=False))
    whitened = at_poses(machine, data, begin, "implicit", whitened=True, use_prior=prior)
    if EQ5_WHITENED in methods:
        out[EQ5_WHITENED] = estimate_of_pose_fit(whitened, whitened=True)
    out[PAPER_C_JOINT] = joint_from_pose_fit(machine, data, whitened, use_prior=prior)
    if PAPER_C_BOUND in methods:
        out[PAPER_C_BOUND] = estimate_at_bound(machine, data, rng)
    return out


def start(machine: Machine, data: SimulatedRuns) -> State:
    """Starting state of every method, B runs: nominal parameters, camera and board by the closed
    form.
    """
    n, nominal = data.count, machine.parameters.nominal
    fk = forward(machine.layout, nominal, data.joints[:, :n], machine.home())
    pair = solve_pairs(fk.T_base_platform, data.T_camera_board[:, :n], size_of(machine))
    return State(
        nominal,
        pair.T_camera_base[:, None],
        fk.T_base_platform,
        T_mount=pair.T_mount[:, None],
        on_platform=np.ones(1, dtype=bool),
        internal=fk.internal,
    )


def at_poses(
    machine: Machine, data: SimulatedRuns, begin: State, form: PoseFitForm, *,
    whitened: bool, use_prior: bool = False,
) -> PoseFit:  # fmt: skip
    """Fit by [C] eq. 3 or 5, as printed or whitened. begin : state by :func:`start`."""
    n, measured = data.count, data.T_camera_board
    problem, state = pose_problem(
        machine, measurements(data), measured[:, :n], data.joints[:, :n], begin, form
    )
    noise = np.broadcast_to(np.diag(data.noise.pose**2), (n, 6, 6)) if whitened else None
    return fit_machine_to_poses(
        machine, problem, state, noise, data.noise.reading, use_prior=use_prior
    )


def estimate_of_pose_fit(fit: PoseFit, *, whitened: bool = False) -> Fitted:
    """Estimate of a fit at measured poses, with its rank and its number of estimated unknowns."""
    problem, state = fit.problem, fit.solution.state
    runs, n = problem.readings.shape[:2]
    extra = {
        "rank": np.full(runs, fit.rank),
        "estimated": np.full(runs, int(problem.keep.sum())),
    }
    if whitened:
        rows = problem.weigh.shape[-1] - problem.layout.n_internal
        extra["chi2"] = fit.solution.cost / (n * rows + len(problem.prior) - fit.rank)
    return Fitted(problem.theta(state), state.T_camera_base[:, 0], state.T_mount[:, 0], extra)


def joint_from_pose_fit(
    machine: Machine, data: SimulatedRuns, begin: PoseFit, *, use_prior: bool = False
) -> Fitted:
    """Joint estimate, started from a fit at measured poses."""
    problem = joint_problem(machine, data, default_gauge(machine), use_prior=use_prior)
    state = begin.solution.state
    poses = begin.problem.platform_poses(state)
    first = BatchState(
        state.z, state.T_camera_base, poses, np.zeros((len(poses), 1)), state.T_mount,
        state.internal,
    )  # fmt: skip
    solution = joint(problem, first)
    end, reference = solution.solution.state, begin.rank - len(begin.problem.prior)
    chi2 = solution.solution.cost / freedom(data, machine.layout, reference)
    return Fitted(
        problem.theta(end), end.T_camera_base[:, 0], end.T_mount[:, 0], {"chi2": chi2}
    )  # fmt: skip


def estimate_at_bound(machine: Machine, data: SimulatedRuns, rng: np.random.Generator) -> Fitted:
    """Draw from the Cramér-Rao bound at the truth; the truth's parameters must be those of the
    machine.
    """
    problem = joint_problem(machine, data, default_gauge(machine))
    z = (data.theta - machine.parameters.nominal) @ np.linalg.pinv(problem.free).T
    runs, n = len(z), data.count
    state = BatchState(
        z,
        np.broadcast_to(PAPER_C_CAMERA_POSE, (runs, 1, 4, 4)),
        data.T_base_platform[:, :n],
        np.zeros((runs, 1)),
        np.broadcast_to(PAPER_C_BOARD_POSE, (runs, 1, 4, 4)),
        np.zeros((runs, n, machine.layout.n_internal)),
    )
    step = drawn_from_bound(problem, state, rng)
    return Fitted(data.theta + step[:, : z.shape[1]] @ problem.free.T)


def axis_of_rotation(data: SimulatedRuns) -> Sample:
    """Results of [C] IV.B for every run.

    spread : of the axis over pairs of poses, rad. expected : the same by noise alone. tilt : root
    mean square over single poses, rad. chi2 : per degree of freedom of a common axis.
    """
    axes = [
        rotation_axis(measurements(data, run).poses, "schoenflies")
        for run in range(len(data.theta))
    ]
    return Sample(
        {
            "spread": np.array([f.spread for f in axes]),
            "expected": np.array([f.expected_spread for f in axes]),
            "tilt": np.array([np.sqrt(np.mean(f.tilt**2)) for f in axes]),
            "chi2": np.array([f.chi2 / f.dof for f in axes]),
            "dof": np.array([f.dof for f in axes]),
        }
    )


def ranks(study: StudyResult[H4ByBoard]) -> dict[tuple[H4ModelKind, str], tuple[int, int]]:
    """Rank of the Jacobian with all unknowns free, and number of estimated unknowns.

    By model and method, each with the truth of its own model.
    """
    out: dict[tuple[H4ModelKind, str], tuple[int, int]] = {}
    for kind in H4_MODEL_KINDS[:2]:
        for method in (EQ3_AS_PRINTED, EQ5_AS_PRINTED, EQ5_WHITENED):
            rank, count = (study.values(q, kind, kind, method)[0] for q in ("rank", "estimated"))
            out[kind, method] = (int(rank), int(count))
    return out


def largest_side(study: StudyResult[H4ByBoard], model_and_method: tuple[str, str]) -> float:
    """Root mean square over runs of the largest of the square's four errors, m."""
    worst: Array = np.abs(study.values("square", "design", *model_and_method)).max(axis=1)
    return float(np.sqrt(np.mean(worst**2)))
