"""Study of [B] V: a hexapod's legs observed by a catadioptric camera between them, and by a pinhole
camera in front.

Sixty configurations at the limits of the workspace; every edge has the noise of a fit to a hundred
points with 0.2 px each. Compared are the linear system of [B] eq. 14 with several regressions and
the joint estimate, on right and on wrong edges, with a common shift of all edges as lenses and
lighting cause it, and with a wrong radius.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras import Camera
from pkmcal.cameras.pinhole import Pinhole
from pkmcal.cameras.unified import Unified
from pkmcal.geometry.rigid import apply, look_at, register
from pkmcal.identify.bundle import bundle
from pkmcal.identify.methods import linear
from pkmcal.identify.state import State
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine, load_mechanism, machine_from_document, with_exact_scales
from pkmcal.placement.edges import EdgeNoise, simulate_edges
from pkmcal.simulation.truth import true_machine
from pkmcal.studies.estimates import Fitted
from pkmcal.studies.tasks import Batch, Key, Population, Quantity, Sample

PAPER_B_LEG_RADIUS, PAPER_B_LEG_REACH = 0.014, (0.02, 0.6)
"""Radius of a leg and the range of its cylinder along the leg, m; as in the paper, each leg is one
cylinder.
"""
PAPER_B_CONFIGURATIONS = 60
POINTS_FITTED_AN_EDGE, POINT_NOISE = 100, 0.2
"""Number of points to which an edge is fitted, and standard deviation of each in px."""
PAPER_B_READING_NOISE = 3e-6
"""Standard deviation of a reading, m."""
PAPER_B_BATCH_RUNS = 5
RUNS_A_CASE = 4
"""Divisor of the number of runs for each of the twelve cases, most of which end in a joint
estimate.
"""
MOST_CONTROLLED_RUNS = 20
"""Maximum number of runs of the controlled machine."""
CONTROLLED_MACHINE_SEED = 2006
"""Seed of the controlled machine."""

MIRROR_VIEW, PERSPECTIVE_VIEW = "mirror", "perspective"
PLAIN_REGRESSION, HUBER_REGRESSION, TUKEY_REGRESSION = "plain", "huber", "tukey"
LEAST_MEDIAN_REGRESSION, ROBUST_REGRESSION = "least-median", "robust"
SCALED_BY_RATIO, SCALED_BY_SIMILARITY = "eq. 16", "similarity"
PAPER_B_JOINT = "joint"
PAPER_B_REGRESSIONS: tuple[linear.RegressionMethod, ...] = (
    PLAIN_REGRESSION,
    HUBER_REGRESSION,
    TUKEY_REGRESSION,
    LEAST_MEDIAN_REGRESSION,
    ROBUST_REGRESSION,
)


class View(NamedTuple):
    """Camera and its pose T_camera_base (4, 4)."""

    camera: Camera
    T_camera_base: Array


class Case(NamedTuple):
    """Errors of the edges, and the methods that are applied.

    wrong : share of edges that belong to another leg. outward : shift of all edges, px. radius :
    relative error of the assumed radius.
    """

    methods: tuple[str, ...]
    wrong: float = 0.0
    outward: float = 0.0
    radius: float = 0.0


PAPER_B_CASES = {
    "right": Case((*PAPER_B_REGRESSIONS, PAPER_B_JOINT)),
    "5 % wrong": Case((*PAPER_B_REGRESSIONS, PAPER_B_JOINT), wrong=0.05),
    "20 % wrong": Case((LEAST_MEDIAN_REGRESSION, ROBUST_REGRESSION, PAPER_B_JOINT), wrong=0.2),
    "35 % wrong": Case((LEAST_MEDIAN_REGRESSION, ROBUST_REGRESSION), wrong=0.35),
    "shifted": Case((ROBUST_REGRESSION, PAPER_B_JOINT), outward=0.1),
    "radius": Case(
        (ROBUST_REGRESSION, SCALED_BY_RATIO, SCALED_BY_SIMILARITY, PAPER_B_JOINT), radius=0.01
    ),
}
CONTROLLED_POPULATION = "controlled"
"""Population of one machine that is measured repeatedly, for the control by its images."""
PAPER_B_VIEW_NAMES = (MIRROR_VIEW, PERSPECTIVE_VIEW)
PAPER_B_QUANTITIES = {
    "centre": Quantity("rms", 1e3, "mm"),
    "depth": Quantity("rms", 1e3, "mm"),
    "cad": Quantity("mean", 1e3, "mm"),
    "pixel": Quantity("rms", 1.0, "px"),
}
"""Errors of the base centres in the camera's frame: their length; along the camera's axis; the
square root of the median square from the nominal model of [B] V.A, after [B] eq. 15; in the image.
"""


@dataclass(frozen=True)
class HexapodByLegs:
    """Setting of [B] V.A and V.B."""

    doing = "Edges of the legs"
    quantities = PAPER_B_QUANTITIES

    def populations(self, runs: int) -> list[Population]:
        """Populations of each camera with each case, and of the controlled machine."""
        each = max(2, runs // RUNS_A_CASE)
        out = [
            Population(f"{view}, {case}", each, PAPER_B_BATCH_RUNS)
            for view, case in product(PAPER_B_VIEW_NAMES, PAPER_B_CASES)
        ]
        return [
            *out,
            Population(CONTROLLED_POPULATION, min(each, MOST_CONTROLLED_RUNS), PAPER_B_BATCH_RUNS),
        ]

    def draw(self, batch: Batch) -> list[MeasuredHexapod]:
        """Draw a true machine for each run, with its configurations and visible edges."""
        rng = batch.generator(0)
        if batch.population == CONTROLLED_POPULATION:
            truth, view = controlled_machine(), views_by_name()[PERSPECTIVE_VIEW]
            case = PAPER_B_CASES["right"]
            return [measured_hexapod(truth, view, case, rng) for _ in range(batch.runs)]
        where, _, name = batch.population.partition(", ")
        view, case = views_by_name()[where], PAPER_B_CASES[name]
        return [measured_hexapod(drawn_machine(rng), view, case, rng) for _ in range(batch.runs)]

    def solve(self, batch: Batch, data: list[MeasuredHexapod]) -> dict[Key, Fitted]:
        """Base centres (B, L, 3) in the camera's frame by every method."""
        where, _, name = batch.population.partition(", ")
        methods = PAPER_B_CASES[name].methods if name else (ROBUST_REGRESSION,)
        rng = batch.generator(1)
        centres = [solved(one, methods, rng) for one in data]
        nominal = hexapod_with_cylinder_legs().parameters.nominal
        theta = np.broadcast_to(nominal, (batch.runs, len(nominal)))
        return {
            (where, name or CONTROLLED_POPULATION, method): Fitted(
                theta, extra={"centres": np.stack([f[method] for f in centres])}
            )
            for method in methods
        }

    def judge(
        self, batch: Batch, data: list[MeasuredHexapod], fits: Mapping[Key, Fitted]
    ) -> dict[Key, Sample]:
        """Errors of the base centres."""
        del batch
        truth = np.stack([one.centres for one in data])
        camera, nominal = data[0].view.camera, hexapod_with_cylinder_legs().base_centers()
        pixel = camera.project(truth)
        out: dict[Key, Sample] = {}
        for key, fit in fits.items():
            # Error in the camera's frame, and distance from the registered nominal centres.
            centres = fit.extra["centres"]
            off = centres - truth
            T = register(np.broadcast_to(nominal, centres.shape), centres)
            laid = apply(T[:, None], nominal)
            square = np.sum((centres - laid) ** 2, axis=-1)
            out[key] = Sample(
                {
                    "centre": np.sqrt(np.sum(off**2, axis=-1)),
                    "depth": off[..., 2],
                    "cad": np.sqrt(np.median(square, axis=1)),
                    "pixel": np.linalg.norm(camera.project(centres) - pixel, axis=-1),
                    "centres": centres,
                    "truth": truth,
                }
            )
        return out


@dataclass(frozen=True)
class MeasuredHexapod:
    """Hexapod of one run, with its measurements.

    view : the camera.
    centres : (L, 3) true base centres in its frame.
    machine : the assumed model.
    measurements : edges and readings.
    """

    view: View
    centres: Array
    machine: Machine
    measurements: Measurements


@cache
def hexapod_with_cylinder_legs() -> Machine:
    """The catalogue's Gough-Stewart platform with one cylinder for each leg and exact scales."""
    document = with_exact_scales(load_mechanism("gough-stewart").document)
    kind = type(document.legs[0].tubes[0])
    tube = kind.model_validate(
        {"radius": PAPER_B_LEG_RADIUS, "from": PAPER_B_LEG_REACH[0], "to": PAPER_B_LEG_REACH[1]}
    )
    legs = tuple(leg.model_copy(update={"tubes": (tube,)}) for leg in document.legs)
    return machine_from_document(document.model_copy(update={"legs": legs}))


def drawn_machine(rng: np.random.Generator) -> Machine:
    """Machine drawn by the prior sigmas; radii are nominal, since a wrong radius is a case of its
    own.
    """
    nominal = hexapod_with_cylinder_legs()
    values = true_machine(nominal, 1.0, rng).values.copy()
    radii = np.array(nominal.parameters.kinds) == "radius"
    values[radii] = nominal.values[radii]
    return nominal.with_values(values)


@cache
def controlled_machine() -> Machine:
    """The controlled machine of [B] V.B."""
    return drawn_machine(np.random.default_rng(CONTROLLED_MACHINE_SEED))


@cache
def views_by_name() -> dict[str, View]:
    """Cameras of [B] V.A: a catadioptric camera of 640 x 480 px between the legs, its image
    parallel to the base, and a pinhole camera of 1024 x 780 px that looks horizontally from the
    front.
    """
    mirror = Unified((640, 480), np.array([173.6, 173.3, 319.8, 240.2, 1.0, 0, 0, 0, 0]))
    up = np.array([0.01, -0.02, 0.06])
    front = Pinhole((1024, 780), np.array([900.0, 900.0, 511.5, 389.5, 0, 0, 0, 0, 0]))
    middle = np.array([0.0, 0.0, 0.16])
    place = middle + 0.95 * np.array([np.cos(np.pi / 3), np.sin(np.pi / 3), 0.0])
    return {
        MIRROR_VIEW: View(mirror, look_at(up, up + np.array([0.0, 0.0, 0.4]), -np.eye(3)[1])),
        PERSPECTIVE_VIEW: View(front, look_at(place, middle, np.eye(3)[2])),
    }


def measured_hexapod(
    truth: Machine,
    view: View,
    case: Case,
    rng: np.random.Generator,
    point_noise: float = POINT_NOISE,
    reading_noise: float = PAPER_B_READING_NOISE,
) -> MeasuredHexapod:
    """Measurements of a machine at the limits of its workspace by a camera."""
    corners = np.array(list(product(*truth.joint_ranges)))
    readings = corners[rng.permutation(len(corners))[:PAPER_B_CONFIGURATIONS]]
    poses = truth.forward(readings)
    noise = EdgeNoise(
        shift=point_noise / np.sqrt(POINTS_FITTED_AN_EDGE),
        # at the ends of a line that is fitted to points all along it
        tilt=point_noise * np.sqrt(3 / POINTS_FITTED_AN_EDGE),
        outward=case.outward,
        wrong=case.wrong,
    )
    T = view.T_camera_base
    edges, joints = simulate_edges(
        truth, T[None], view.camera, poses, noise, rng, joint_noise=reading_noise
    )
    believed = hexapod_with_cylinder_legs()
    if case.radius:
        values = believed.values.copy()
        values[np.array(believed.parameters.kinds) == "radius"] *= 1 + case.radius
        believed = believed.with_values(values)
    measured = Measurements(edges, joints, reading_noise, 1, np.zeros(1, dtype=int))
    return MeasuredHexapod(view, apply(T, truth.base_centers()), believed, measured)


def solved(
    one: MeasuredHexapod, methods: tuple[str, ...], rng: np.random.Generator
) -> dict[str, Array]:
    """Base centres (L, 3), camera frame, by each of the methods."""
    nominal = hexapod_with_cylinder_legs().base_centers()
    out: dict[str, Array] = {}
    for method in PAPER_B_REGRESSIONS:
        if method in methods or method == ROBUST_REGRESSION:
            estimate = linear.centres(one.machine, one.measurements, method, rng)
            out[method] = estimate.centres[0]
    start = out[ROBUST_REGRESSION]
    if SCALED_BY_RATIO in methods:
        out[SCALED_BY_RATIO] = start / linear.scale_ratio(start, nominal)
        out[SCALED_BY_SIMILARITY] = start / linear.procrustes_scale(start, nominal)
    if PAPER_B_JOINT in methods:
        out[PAPER_B_JOINT] = jointly_estimated_centres(one, start)
    return {method: out[method] for method in methods}


def jointly_estimated_centres(one: MeasuredHexapod, start: Array) -> Array:
    """Base centres (L, 3), camera frame, by the joint estimate.

    The nominal model, registered to the linear estimate's centres ``start``, is the starting point.
    """
    machine, measured = one.machine, one.measurements
    T = register(machine.base_centers(), start)
    poses = machine.forward_result(measured.joints).T_base_platform
    state = State(machine.values, T[None], poses)
    fit = bundle(machine, measured, state)
    return apply(fit.state.T_camera_base[0], fit.machine.base_centers())
