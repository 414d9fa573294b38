"""A calibration made by hand, with known numbers, for the tests of the report."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from pkmcal.calibration.calibrate import Calibration
from pkmcal.cameras.pinhole import Pinhole
from pkmcal.geometry.cylinders import contour_point, edge_normal_jacobians, tangent_basis
from pkmcal.geometry.rigid import look_at, perturb
from pkmcal.identify.assembly import Assembled, assemble
from pkmcal.identify.covariance import Identifiability
from pkmcal.identify.estimate import Estimate, Statistics
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.scatter import EdgeScatter
from pkmcal.identify.state import State
from pkmcal.identify.unidentified import Identification
from pkmcal.measurements import EdgeSet, Measurements, Observation, Rejection
from pkmcal.measurements.effects import EDGE_SHIFT
from pkmcal.mechanisms import load_mechanism
from pkmcal.observe.predict import legs_in_camera
from pkmcal.report.calibration import report_of
from pkmcal.session.image_files import Image
from pkmcal.session.load import Session, Station
from pkmcal.web.report_page import report_document, report_page

OUTWARD = 0.25
"""Pixels that the case's edges lie outward, besides the camera's own shift."""
CAMERA_SHIFT = 0.1
RADIUS = {0: 0.014, 1: 0.009}


@dataclass(frozen=True)
class Case:
    session: Session
    observation: Observation
    estimate: Estimate


RANKS = Identifiability(54, 12, 42, (), (), np.full(42, 20.0), np.zeros((42, 54)))
IDENTIFIABILITY = Identification(RANKS, (), (), 1e-3)
"""Findings if the data determine everything."""


def calibration(
    session, observation, estimate, verdict=None, findings=IDENTIFIABILITY, timings=None
):
    """The case as `calibrate` returns it, as far as the report needs it."""
    return Calibration(
        session, observation, None, estimate, verdict, findings, None, "bundle", 0, timings or {}
    )


def report_html(*value, **more) -> str:
    """The report's page; as :func:`calibration`."""
    return report_page(report_of(calibration(*value, **more)))


def case_document(*value, **more) -> dict:
    """The report's document; as :func:`calibration`."""
    return report_document(report_of(calibration(*value, **more))).model_dump(mode="json")


def camera() -> Pinhole:
    """Small, with a lens that bends the edges."""
    return Pinhole((320, 240), np.array([280.0, 281.0, 160.2, 119.1, -0.3, 0.05, 1e-3, 0, 0]))


def one_edge(machine, camera, T, pose, joints, place, shift):
    """An edge without noise, ``shift`` px outward; None outside the image."""
    leg, tube, side = place
    legs = legs_in_camera(machine, T, pose, joints)
    a, u, radius = legs.a[leg], legs.u[leg], np.array(RADIUS[tube])
    normal = edge_normal_jacobians(a, a + u, radius, np.array(side)).n
    span = np.array([0.04, 0.22]) if tube == 0 else np.array([0.26, 0.32])
    points = contour_point(a, u, normal, radius, np.linspace(*span, 9))
    pixels = camera.project(points)
    if not camera.in_image(pixels).all():
        return None
    basis = tangent_basis(normal, points.mean(axis=0) / np.linalg.norm(points.mean(axis=0)))
    # d pixel / d point across the edge, turned into outward px by the normal's two numbers
    by_point = camera.project_jacobians(points)[0]
    tangent = (by_point @ u[:, None])[..., 0]
    outward = np.stack([-tangent[:, 1], tangent[:, 0]], -1)
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    gain = np.abs(np.einsum("ni,nij,j->n", outward, by_point, normal))
    design = -(points * gain[:, None]) @ basis
    by_shift = np.linalg.lstsq(design, np.ones(9), rcond=None)[0]
    normal = normal + basis @ by_shift * shift
    normal /= np.linalg.norm(normal)
    basis = tangent_basis(normal, points.mean(axis=0) / np.linalg.norm(points.mean(axis=0)))
    by_shift = np.linalg.lstsq(-(points * gain[:, None]) @ basis, np.ones(9), rcond=None)[0]
    return normal, basis, np.linalg.inv(design.T @ design) * 0.04, by_shift, span


def edges_of(machine, T_camera_base, poses, joints, shift) -> EdgeSet:
    rows = []
    for s, T in enumerate(T_camera_base):
        for k, pose in enumerate(poses):
            for place in np.ndindex(6, 2, 2):
                edge = one_edge(machine, camera(), T, pose, joints[k], place, shift)
                if edge is not None:
                    rows.append((s, k, *place, *edge))
    return EdgeSet(*(np.array(column) for column in zip(*rows, strict=True)))


def make_case(folder: Path, n_poses=5, n_stations=3, station="front", prefix="c") -> Case:
    rng = np.random.default_rng(7)
    nominal = load_mechanism("gough-stewart")
    errors = 1e-3 * rng.normal(size=len(nominal.parameters))
    errors[nominal.parameters.of_kind("radius")] = 0
    machine = nominal.with_values(nominal.values + errors)
    poses = perturb(nominal.home(), 0.05 * rng.normal(size=(n_poses, 6)))
    joints = machine.inverse(poses)
    angle = 2 * np.pi * np.arange(n_stations) / n_stations + 0.4
    places = np.stack([np.cos(angle), np.sin(angle), 0.3 + 0 * angle], -1)
    T = np.stack([look_at(p, np.array([0, 0, 0.17]), np.array([0, 0, 1.0])) for p in places])
    edges = edges_of(machine, T, poses, joints, OUTWARD + CAMERA_SHIFT)
    return Case(
        make_session(folder, nominal, joints, T, station, prefix),
        Observation(edges, rejected(), np.zeros((0, 2)), np.zeros(0, int), T),
        make_estimate(machine, poses, T, edges, rng),
    )


def rejected() -> tuple[Rejection, ...]:
    return (
        Rejection(0, 0, 2, 1, 0, "seen over 3.5 mm only"),
        Rejection(1, 2, 2, 0, 1, "seen over 4.5 mm only"),
        Rejection(1, 3, -1, -1, -1, "too dark"),
    )


def make_session(folder, nominal, joints, T, station, prefix) -> Session:
    stations = []
    for s, pose in enumerate(T):
        images = []
        for k in range(len(joints)):
            path = folder / f"s{s}k{k}.png"
            cv2.imwrite(str(path), np.full((240, 320), 40 + 10 * k, np.uint8))
            images.append(Image(k, None, path))
        rough = perturb(pose, np.array([0, 0, 0.01, 0.01, 0, 0]))
        name = f"{station}{s}"
        stations.append(Station(name, camera(), "cameras/a.yaml", rough, tuple(images), "legs"))
    return Session(
        folder=folder,
        machine=nominal,
        configurations=tuple(f"{prefix}{k}" for k in range(len(joints))),
        joints=joints,
        joint_noise=3e-6,
        stations=tuple(stations),
        board=None,
        document={},
    )


def no_problem(machine) -> Assembled:
    """The problem of a machine without measurements."""
    none = np.zeros(0, dtype=int)
    measurements = Measurements(EdgeSet.empty(), machine.joint_ranges[:, :1].T, 3e-6, 0, none)
    return assemble(machine, measurements, default_gauge(machine))


def make_estimate(machine, poses, T, edges, rng) -> Estimate:
    n, count, k = len(machine.parameters), len(edges), len(poses)
    sigma = np.full(n, 4e-5)
    sigma[machine.parameters.index("legs[2].base.center.x")] = 3.44e-5
    sigma[:3] = 0  # the first centre defines the frame
    share = np.full(n, 0.99)
    share[machine.parameters.of_kind("radius")] = 0.2
    weights = np.ones(count)
    weights[:3] = 0.1
    return Estimate(
        machine=machine,
        state=State(machine.values, T, poses, {EDGE_SHIFT: np.array([CAMERA_SHIFT])}),
        joint_covariance=np.diag(np.r_[sigma**2, np.tile([1e-8] * 3 + [4e-8] * 3, len(T))]),
        column_covariance={EDGE_SHIFT: np.array([[0.012**2]])},
        edge_residuals=rng.normal(size=(count, 2)),
        edge_weights=weights,
        edge_noise=EdgeScatter(np.ones(2), np.full(2, 0.015), np.full(2, 100.0)),
        edge_trust=np.ones(count),
        joint_residuals=rng.normal(size=(k, 6)),
        data_share=share,
        configurations=np.ones(k, bool),
        statistics=Statistics(900.0, 1000.0, 800.0, 960, 60.0, 30, 40.0, 54, 7, "converged", 1.25),
        gauge="three centres: legs 1, 3, 5",
        problem=no_problem(machine),
    )
