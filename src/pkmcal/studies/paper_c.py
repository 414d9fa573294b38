"""[C] IV as a study: an H4, a board on its nacelle, a camera on its base.

81 poses, 71 drawn for the calibration and 10 for control; board poses with 0.2 mm and 0.03 degrees
of noise a component. Compared are equations 3 and 5 as printed and whitened, the joint estimate and
the Cramér-Rao bound, with models that are the truth's, richer or poorer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.estimate import State
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.unknowns import BatchState
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.kinematics import forward, on_manifold, readings_at_poses
from pkmcal.papers.hand_eye import size_of, solve_pairs
from pkmcal.papers.inverse_kinematic import PoseFit, PoseFitForm, fit_machine_to_poses, pose_problem
from pkmcal.papers.rotation_axis import rotation_axis
from pkmcal.studies.engine import StudyResult
from pkmcal.studies.estimates import (
    Fitted,
    drawn_from_bound,
    freedom,
    joint,
    nominal_estimate,
    tool_errors,
    tool_places,
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

PAPER_C_DRAWING, EQ3_AS_PRINTED, EQ5_AS_PRINTED, EQ5_WHITENED, PAPER_C_JOINT, PAPER_C_BOUND = (
    "drawing", "eq. 3", "eq. 5", "eq. 5 whitened", "joint", "bound",
)  # fmt: skip
ROTATION_AXIS_METHOD = "axis of rotation"
METHODS_BY_TRUTH: dict[H4ModelKind, dict[H4ModelKind, tuple[str, ...]]] = {
    "design": {
        "design": (
            PAPER_C_DRAWING,
            EQ3_AS_PRINTED,
            EQ5_AS_PRINTED,
            EQ5_WHITENED,
            PAPER_C_JOINT,
            PAPER_C_BOUND,
        ),
        "calibration": (EQ5_AS_PRINTED, EQ5_WHITENED, PAPER_C_JOINT),
    },
    "calibration": {
        "design": (PAPER_C_DRAWING, EQ3_AS_PRINTED, PAPER_C_JOINT),
        "calibration": (EQ3_AS_PRINTED, EQ5_AS_PRINTED, EQ5_WHITENED, PAPER_C_JOINT, PAPER_C_BOUND),
    },
    "rods": {
        "design": (PAPER_C_JOINT,),
        "calibration": (PAPER_C_JOINT,),
        "rods": (EQ5_WHITENED, PAPER_C_JOINT),
    },
}
"""For each truth the models that are fitted to it, and how."""
H4_MODEL_KINDS: tuple[H4ModelKind, ...] = tuple(METHODS_BY_TRUTH)
PRINTED_EQUATION_FORMS: dict[str, PoseFitForm] = {
    EQ3_AS_PRINTED: "joint",
    EQ5_AS_PRINTED: "implicit",
}

PAPER_C_BATCH_RUNS = 20
RODS_SHARE = 5
"""One run with rods for so many others: it has 82 parameters and takes ten times as long."""
LARGER_WORKSPACE_FACTOR = 1.25
"""Half sizes of the workspace that errors are also told over, by those of the measured volume. The
errata's prototype does not name its own; this one fits its figures."""
PAPER_C_COMPARED_POSES = 100
"""Poses at which a run's machine is held against the truth."""
PAPER_C_BOUND_STREAM, COMPARED_POSES_STREAM, RULED_LINES_STREAM = 1, 2, 3
"""Uses of a batch's draws, besides the simulation."""
PAPER_C_QUANTITIES = {
    "shift": Quantity("rms", 1e3, "mm"),
    "turn": Quantity("rms", 1e3, "mrad"),
    "larger_shift": Quantity("rms", 1e3, "mm"),
    "larger_turn": Quantity("rms", 1e3, "mrad"),
    "chi2": Quantity("mean"),
}
"""The tool's errors over the measured volume and over a larger workspace, and chi2 per degree of
freedom, NaN where rows are not whitened."""


@dataclass(frozen=True)
class H4ByBoard:
    """[C] IV. turn, shift : standard deviations of a board's pose, rad and m a component.
    joint_noise : of a reading, rad. deviations : of the true machines from the drawing. control :
    poses that are held back.
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
        """Of boards and readings."""
        return Noise(self.joint_noise, pose=np.repeat([self.turn, self.shift], 3))

    def populations(self, runs: int) -> list[Population]:
        """Each truth; fewer with rods."""
        out = [
            Population(kind, runs, PAPER_C_BATCH_RUNS) for kind in H4_MODEL_KINDS if kind != "rods"
        ]
        return [*out, Population("rods", max(2, runs // RODS_SHARE), PAPER_C_BATCH_RUNS // 4)]

    def draw(self, batch: Batch) -> SimulatedRuns:
        """True machines and their poses; calibration first, then control."""
        return self.simulated(kind_of(batch.population), batch.runs, batch.generator(0))

    def simulated(self, kind: H4ModelKind, runs: int, rng: np.random.Generator) -> SimulatedRuns:
        """The same of one kind of truth."""
        machine = model(kind)
        theta = true_values(kind, self.deviations, runs, rng)
        order = np.argsort(rng.random((runs, len(measured_volume_grid()))), axis=1)
        poses = measured_volume_grid()[order]
        if kind == "rods":  # two rods a forearm tilt the nacelle a little
            poses = on_manifold(machine.layout, theta[:, None], poses).T_base_platform
        readings = readings_at_poses(machine.layout, theta[:, None], poses)
        station = np.zeros(len(measured_volume_grid()), dtype=int)
        view = Viewpoints(PAPER_C_CAMERA_POSE[None], station, T_platform_board=PAPER_C_BOARD_POSE)
        return simulate_runs(machine, theta, readings, poses, view, self.noise, rng, self.control)

    def solve(self, batch: Batch, data: SimulatedRuns) -> dict[Key, Fitted]:
        """Every model that is fitted to this truth, by every method that is asked for."""
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
        """The tool's errors; where the truth is the paper's machine, its validation as well."""
        space, lines = batch.generator(COMPARED_POSES_STREAM), batch.generator(RULED_LINES_STREAM)
        near, far = (
            tool_places(data, workspace(PAPER_C_COMPARED_POSES, space, larger))
            for larger in (1.0, LARGER_WORKSPACE_FACTOR)
        )
        papers = batch.population == "design"
        out: dict[Key, Sample] = {}
        for (kind, name, method), fit in fits.items():
            machine = model(kind_of(name))
            one, other = (
                tool_errors(machine.layout, fit.theta, at, self.turn, self.shift)
                for at in (near, far)
            )
            values = {
                "chi2": np.full(batch.runs, np.nan),
                "shift": one.shift, "turn": one.turn,
                "larger_shift": other.shift, "larger_turn": other.turn,
            }  # fmt: skip
            if papers and method != PAPER_C_BOUND:
                off = control_residuals(machine, fit, data)
                values |= {
                    "control_mean": off.mean(axis=1),
                    "control_rms": np.sqrt(np.mean(off**2, axis=1)),
                    "straightness": straightness_along_rulers(machine, fit.theta, data, lines),
                    "square": square(machine, fit.theta, data),
                }
            if papers and name == "design":
                values["table_2"] = table_2_of(machine, fit.theta)
            out[kind, name, method] = Sample(values | fit.extra)
        return out | {("design", ROTATION_AXIS_METHOD): axis_of_rotation(data)} if papers else out


def kind_of(name: str) -> H4ModelKind:
    """A kind of truth or model by its name."""
    return next(kind for kind in H4_MODEL_KINDS if kind == name)


def _fits(
    data: SimulatedRuns, name: H4ModelKind, methods: tuple[str, ...], rng: np.random.Generator
) -> dict[str, Fitted]:
    """Every asked method's estimate with one model. Only rods need the drawing as a prior."""
    machine, prior = model(name), name == "rods"
    begin = start(machine, data)
    out: dict[str, Fitted] = {}
    if PAPER_C_DRAWING in methods:
        out[PAPER_C_DRAWING] = nominal_estimate(machine, len(data.theta))
    for method, form in PRINTED_EQUATION_FORMS.items():
        if method in methods:
            out[method] = estimate_of_pose_fit(at_poses(machine, data, begin, form, whitened=False))
    whitened = at_poses(machine, data, begin, "implicit", whitened=True, use_drawing=prior)
    if EQ5_WHITENED in methods:
        out[EQ5_WHITENED] = estimate_of_pose_fit(whitened, whitened=True)
    out[PAPER_C_JOINT] = joint_from_pose_fit(machine, data, whitened, use_drawing=prior)
    if PAPER_C_BOUND in methods:
        out[PAPER_C_BOUND] = estimate_at_bound(machine, data, rng)
    return out


def start(machine: Machine, data: SimulatedRuns) -> State:
    """Where every method begins: the drawing, camera and board by the closed form; B runs."""
    n, values = data.count, machine.parameters.drawing
    fk = forward(machine.layout, values, data.joints[:, :n], machine.home())
    pair = solve_pairs(fk.T_base_platform, data.T_camera_board[:, :n], size_of(machine))
    return State(
        values,
        pair.T_camera_base[:, None],
        fk.T_base_platform,
        T_mount=pair.T_mount[:, None],
        on_platform=np.ones(1, dtype=bool),
        internal=fk.internal,
    )


def at_poses(
    machine: Machine, data: SimulatedRuns, begin: State, form: PoseFitForm, *,
    whitened: bool, use_drawing: bool = False,
) -> PoseFit:  # fmt: skip
    """[C] eq. 3 or 5, as printed or whitened. begin : of :func:`start`."""
    n, in_view = data.count, data.T_camera_board
    problem, state = pose_problem(
        machine, measurements(data), in_view[:, :n], data.joints[:, :n], begin, form
    )
    noise = np.broadcast_to(np.diag(data.noise.pose**2), (n, 6, 6)) if whitened else None
    return fit_machine_to_poses(
        machine, problem, state, noise, data.noise.reading, use_drawing=use_drawing
    )


def estimate_of_pose_fit(fit: PoseFit, *, whitened: bool = False) -> Fitted:
    """A fit at measured poses as an estimate, with its rank and how many unknowns it estimates."""
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
    machine: Machine, data: SimulatedRuns, begin: PoseFit, *, use_drawing: bool = False
) -> Fitted:
    """The joint estimate, from a fit at measured poses."""
    problem = joint_problem(machine, data, default_gauge(machine), use_drawing=use_drawing)
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
    """A draw from the Cramér-Rao bound at the truth, whose parameters are the machine's."""
    problem = joint_problem(machine, data, default_gauge(machine))
    z = (data.theta - machine.parameters.drawing) @ np.linalg.pinv(problem.free).T
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
    """[C] IV.B of every run: spread of the axis over pairs of poses, found and by noise alone, and
    of single poses, rad; chi2 per degree of freedom of one axis.
    """
    results = [
        rotation_axis(measurements(data, run).poses, "schoenflies")
        for run in range(len(data.theta))
    ]
    return Sample(
        {
            "spread": np.array([f.spread for f in results]),
            "expected": np.array([f.expected_spread for f in results]),
            "tilt": np.array([np.sqrt(np.mean(f.tilt**2)) for f in results]),
            "chi2": np.array([f.chi2 / f.dof for f in results]),
            "dof": np.array([f.dof for f in results]),
        }
    )


def ranks(study: StudyResult[H4ByBoard]) -> dict[tuple[H4ModelKind, str], tuple[int, int]]:
    """Rank of the Jacobian with everything free, and how many unknowns are estimated, by model and
    method, each on its own truth.
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
