"""[B] V as a study: a hexapod's legs seen by a mirror between them, and by a camera before it.

Sixty configurations at the workspace's limits; every edge is what a fit to a hundred points with
0.2 px of noise gives. Compared are the linear system of [B] 14 by several regressions, and the
joint estimate, on right edges and on wrong ones, with a shift of all edges that lenses and light
make, and with a wrong radius.
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
from pkmcal.identify.estimate import State
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine, load_mechanism, machine_from_document, with_exact_scales
from pkmcal.papers import linear
from pkmcal.simulation.edges import EdgeNoise, simulate_edges
from pkmcal.simulation.truth import true_machine
from pkmcal.studies.estimates import Fitted
from pkmcal.studies.tasks import Batch, Key, Population, Quantity, Sample

PAPER_B_LEG_RADIUS, PAPER_B_LEG_REACH = 0.014, (0.02, 0.6)
"""m, of a leg, which is one cylinder from joint to joint, as in the paper."""
PAPER_B_CONFIGURATIONS = 60
POINTS_FITTED_AN_EDGE, POINT_NOISE = 100, 0.2
"""Points an edge is fitted to, and px of each."""
PAPER_B_READING_NOISE = 3e-6
"""m, noise of a reading."""
PAPER_B_BATCH_RUNS = 5
RUNS_A_CASE = 4
"""One run of a case for so many that are asked for: there are twelve, and most end in a joint
estimate."""
MOST_CONTROLLED_RUNS = 20
"""Most runs of the machine that is controlled."""
CONTROLLED_MACHINE_SEED = 2006
"""Seed of that machine."""

MIRROR_VIEW, PERSPECTIVE_VIEW = "mirror", "perspective"
PLAIN_REGRESSION, HUBER_REGRESSION, TUKEY_REGRESSION = "plain", "huber", "tukey"
LEAST_MEDIAN_REGRESSION, ROBUST_REGRESSION = "least-median", "robust"
SCALED_BY_RATIO, SCALED_BY_SIMILARITY = "eq. 16", "similarity"
PAPER_B_JOINT, PAPER_B_DRAWING = "joint", "drawing"
PAPER_B_REGRESSIONS: tuple[linear.RegressionMethod, ...] = (
    PLAIN_REGRESSION,
    HUBER_REGRESSION,
    TUKEY_REGRESSION,
    LEAST_MEDIAN_REGRESSION,
    ROBUST_REGRESSION,
)


class View(NamedTuple):
    """A camera and where it stands, (4, 4)."""

    camera: Camera
    T_camera_base: Array


class Case(NamedTuple):
    """What is wrong with the edges, and what is tried on them.

    wrong : share of edges that are another leg's. outward : px by which all lie outside. radius :
    relative error of the radius that is believed.
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
"""The population of one machine that is measured again and again, to be controlled."""
PAPER_B_VIEW_NAMES = (MIRROR_VIEW, PERSPECTIVE_VIEW)
PAPER_B_QUANTITIES = {
    "centre": Quantity("rms", 1e3, "mm"),
    "depth": Quantity("rms", 1e3, "mm"),
    "cad": Quantity("mean", 1e3, "mm"),
    "pixel": Quantity("rms", 1.0, "px"),
}
"""Errors of the base centres in the camera's frame: their length; along the camera's axis;
[B] V.A's square root of the median square from the drawing, after [B] 15; in the picture."""


@dataclass(frozen=True)
class HexapodByLegs:
    """[B] V.A and V.B."""

    doing = "Edges of the legs"
    quantities = PAPER_B_QUANTITIES

    def populations(self, runs: int) -> list[Population]:
        """Each camera with each case; and one machine that is controlled."""
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
        """A true machine a run, its configurations, and the edges that are seen."""
        rng = batch.generator(0)
        if batch.population == CONTROLLED_POPULATION:
            truth, view = controlled_machine(), views_by_name()[PERSPECTIVE_VIEW]
            case = PAPER_B_CASES["right"]
            return [measured_hexapod(truth, view, case, rng) for _ in range(batch.runs)]
        where, _, name = batch.population.partition(", ")
        view, case = views_by_name()[where], PAPER_B_CASES[name]
        return [measured_hexapod(drawn_machine(rng), view, case, rng) for _ in range(batch.runs)]

    def solve(self, batch: Batch, data: list[MeasuredHexapod]) -> dict[Key, Fitted]:
        """Every method's base centres in the camera's frame, (B, L, 3)."""
        where, _, name = batch.population.partition(", ")
        methods = PAPER_B_CASES[name].methods if name else (ROBUST_REGRESSION,)
        rng = batch.generator(1)
        results = [solved(one, methods, rng) for one in data]
        values = hexapod_with_cylinder_legs().parameters.drawing
        theta = np.broadcast_to(values, (batch.runs, len(values)))
        return {
            (where, name or CONTROLLED_POPULATION, method): Fitted(
                theta, extra={"centres": np.stack([f[method] for f in results])}
            )
            for method in methods
        }

    def judge(
        self, batch: Batch, data: list[MeasuredHexapod], fits: Mapping[Key, Fitted]
    ) -> dict[Key, Sample]:
        """Errors of the base centres."""
        del batch
        truth = np.stack([one.centres for one in data])
        camera, drawing = data[0].view.camera, hexapod_with_cylinder_legs().base_centers()
        pixel = camera.project(truth)
        out: dict[Key, Sample] = {}
        for key, fit in fits.items():
            centres = fit.extra["centres"]
            off = centres - truth
            T = register(np.broadcast_to(drawing, centres.shape), centres)
            laid = apply(T[:, None], drawing)
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
    """One run: the true base centres (L, 3) in the camera's frame, and what is measured and
    believed.
    """

    view: View
    centres: Array
    machine: Machine
    measurements: Measurements


@cache
def hexapod_with_cylinder_legs() -> Machine:
    """The catalogue's Gough-Stewart platform with one cylinder a leg, readings as they are."""
    document = with_exact_scales(load_mechanism("gough-stewart").document)
    kind = type(document.legs[0].tubes[0])
    tube = kind.model_validate(
        {"radius": PAPER_B_LEG_RADIUS, "from": PAPER_B_LEG_REACH[0], "to": PAPER_B_LEG_REACH[1]}
    )
    legs = tuple(leg.model_copy(update={"tubes": (tube,)}) for leg in document.legs)
    return machine_from_document(document.model_copy(update={"legs": legs}))


def drawn_machine(rng: np.random.Generator) -> Machine:
    """A machine built within the drawing's tolerances, its radii as drawn: what a wrong radius does
    is a case of its own.
    """
    drawing = hexapod_with_cylinder_legs()
    values = true_machine(drawing, 1.0, rng).values.copy()
    radii = np.array(drawing.parameters.kinds) == "radius"
    values[radii] = drawing.values[radii]
    return drawing.with_values(values)


@cache
def controlled_machine() -> Machine:
    """The one machine that is controlled, [B] V.B."""
    return drawn_machine(np.random.default_rng(CONTROLLED_MACHINE_SEED))


@cache
def views_by_name() -> dict[str, View]:
    """[B] V.A: a mirror between the legs, its 640 x 480 pixels parallel to the base, and a camera
    of 1024 x 780 that looks level from in front.
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
    truth: Machine, view: View, case: Case, rng: np.random.Generator
) -> MeasuredHexapod:
    """What a camera sees of a machine at the limits of its workspace."""
    corners = np.array(list(product(*truth.joint_ranges)))
    readings = corners[rng.permutation(len(corners))[:PAPER_B_CONFIGURATIONS]]
    poses = truth.forward(readings)
    noise = EdgeNoise(
        shift=POINT_NOISE / np.sqrt(POINTS_FITTED_AN_EDGE),
        tilt=POINT_NOISE
        * np.sqrt(3 / POINTS_FITTED_AN_EDGE),  # of a line's ends, by points all along it
        outward=case.outward,
        wrong=case.wrong,
    )
    T = view.T_camera_base
    edges, joints = simulate_edges(
        truth, T[None], view.camera, poses, noise, rng, joint_noise=PAPER_B_READING_NOISE
    )
    believed = hexapod_with_cylinder_legs()
    if case.radius:
        values = believed.values.copy()
        values[np.array(believed.parameters.kinds) == "radius"] *= 1 + case.radius
        believed = believed.with_values(values)
    measured = Measurements(edges, joints, PAPER_B_READING_NOISE, 1, np.zeros(1, dtype=int))
    return MeasuredHexapod(view, apply(T, truth.base_centers()), believed, measured)


def solved(
    one: MeasuredHexapod, methods: tuple[str, ...], rng: np.random.Generator
) -> dict[str, Array]:
    """Base centres (L, 3), camera frame, by each of the methods."""
    drawing = hexapod_with_cylinder_legs().base_centers()
    out: dict[str, Array] = {}
    for method in PAPER_B_REGRESSIONS:
        if method in methods or method == ROBUST_REGRESSION:
            value = linear.centres(one.machine, one.measurements, method, rng)
            out[method] = value.centres[0]
    start = out[ROBUST_REGRESSION]
    if SCALED_BY_RATIO in methods:
        out[SCALED_BY_RATIO] = start / linear.scale_ratio(start, drawing)
        out[SCALED_BY_SIMILARITY] = start / linear.procrustes_scale(start, drawing)
    if PAPER_B_JOINT in methods:
        out[PAPER_B_JOINT] = jointly_estimated_centres(one, start)
    return {method: out[method] for method in methods}


def jointly_estimated_centres(one: MeasuredHexapod, start: Array) -> Array:
    """The joint estimate's base centres (L, 3), camera frame, begun where the linear ones lay the
    drawing.
    """
    machine, measured = one.machine, one.measurements
    T = register(machine.base_centers(), start)
    poses = machine.forward_result(measured.joints).T_base_platform
    state = State(machine.values, T[None], poses)
    fit = bundle(machine, measured, state)
    return apply(fit.state.T_camera_base[0], fit.machine.base_centers())
