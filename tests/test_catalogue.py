"""Every machine of the catalogue: an independent closure, and a calibration from nothing but data.

Machines are enumerated from the folder; loading, kinematics and files there and back are tested
for each of them in test_kinematics and test_mechanisms.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import pkmcal
from conftest import slow_but
from pkmcal.cameras import camera_models
from pkmcal.files import parse_yaml, validated_document
from pkmcal.geometry.rigid import perturb
from pkmcal.identify.bundle import bundle
from pkmcal.identify.gauge import default_gauge, in_gauge
from pkmcal.identify.start import start_state
from pkmcal.identify.state import State
from pkmcal.judge.against_truth import compare_with_truth
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import (
    MechanismDocument,
    catalogue,
    kinematics,
    load_mechanism,
    machine_from_document,
    mechanism_text,
)
from pkmcal.mechanisms.closure import closure, dense
from pkmcal.placement.configurations import draw_configurations
from pkmcal.placement.edges import EdgeNoise, simulate_edges
from pkmcal.simulation import Settings, draw_truth, load_truth, simulate_session, true_machine

NAMES = sorted(n for n in catalogue() if any(r.size for r in load_mechanism(n).radii()))
"""Machines whose legs a camera can see; cranks and sliders are in test_h4 and test_delta."""


@pytest.fixture(params=NAMES, scope="module")
def machine(request):
    return load_mechanism(request.param)


def test_the_catalogue_holds_what_paper_a_is_about():
    assert set(NAMES) >= {
        "3-rpr", "3-upu", "gough-stewart", "3-rps", "6-spu-passive", "constant-legs"
    }  # fmt: skip
    assert {load_mechanism(name).document.motion for name in NAMES} >= {"planar", "spatial"}


# The closure, written a second time from the file's fields alone, for complex numbers


def oracle(machine, theta, readings, rot, t):
    """Rows of the closure as docs/files.md states them; every argument may be complex."""
    value = dict(zip(machine.parameters.names, theta, strict=True))
    lengths, angles = [], []
    reading = iter(readings)
    for j, leg in enumerate(machine.document.legs, start=1):
        a, b = (
            np.array([value[f"legs[{j}].{side}.center.{c}"] for c in "xyz"])
            for side in ("base", "platform")
        )
        line = rot @ b + t - a
        fields = leg.length.model_dump()
        if fields.get("actuated") is True:
            rod = value[f"legs[{j}].scale"] * next(reading) + value[f"legs[{j}].length.offset"]
        elif not fields.get("passive"):
            rod = value[f"legs[{j}].length.constant"]
        if not fields.get("passive"):
            lengths.append(np.sqrt(line @ line) - rod)
        if machine.document.motion == "spatial":
            angles += angle_rows(leg, j, value, rot, line)
    return np.array(lengths + angles)


def angle_rows(leg, j, value, rot, line):
    """[A] eq. 7 on either side; the torsion of a universal-universal leg (errata)."""

    def axis(side):
        v = np.array([value[f"legs[{j}].{side}.axis.{c}"] for c in "xyz"])
        return v / np.sqrt(v @ v)

    rows = []
    if leg.base.joint == "revolute":
        rows.append(line @ axis("base"))
    if leg.platform.joint == "revolute":
        rows.append(line @ (rot @ axis("platform")))
    if (
        {leg.base.joint, leg.platform.joint} == {"universal"}
        and leg.base.axis
        and leg.platform.axis
    ):
        rows.append(line @ np.cross(axis("base"), rot @ axis("platform")))
    return rows


def complex_steps(function, count):
    """Derivatives (E, count) of function(delta (count,)) at zero, exact to rounding."""
    return np.stack([function(1e-30j * by).imag / 1e-30 for by in np.eye(count)], axis=-1)


def assert_as_the_oracle(machine, readings, T):
    theta, layout = machine.values, machine.layout
    rot, t = T[:3, :3], T[:3, 3]
    c = closure(layout, theta, readings, T)
    close = {"rtol": 1e-13, "atol": 1e-14}
    np.testing.assert_allclose(c.rows.value, oracle(machine, theta, readings, rot, t), **close)

    def by_pose(d):
        turn = np.array([[0, -d[2], d[1]], [d[2], 0, -d[0]], [-d[1], d[0], 0]])
        return oracle(machine, theta, readings, rot + turn @ rot, t + d[3:])

    np.testing.assert_allclose(c.rows.by_pose, complex_steps(by_pose, 6), **close)
    by_theta = complex_steps(lambda d: oracle(machine, theta + d, readings, rot, t), len(theta))
    np.testing.assert_allclose(dense(c, len(theta)), by_theta, **close)
    by_reading = complex_steps(
        lambda d: oracle(machine, theta, readings + d, rot, t), machine.n_joints
    )
    values = np.zeros(by_reading.shape)
    values[layout.driven_rows, np.arange(machine.n_joints)] = c.by_reading[layout.driven_rows]
    np.testing.assert_allclose(values, by_reading, **close)


def wide_poses(machine, count, seed, wide=1.0):
    """Poses about home, as far as none of them closes the machine."""
    spread = np.repeat([1.5, 0.2], 3) * wide
    motion = machine.layout.motion
    steps = np.random.default_rng(seed).uniform(-1, 1, (count, 6)) * spread
    return perturb(machine.home(), steps @ motion @ motion.T)


def test_jacobians_at_home(machine):
    home = machine.home()
    assert_as_the_oracle(machine, machine.inverse(home), home)


def test_jacobians_at_random(machine):
    """Machines, readings and poses that need not close, as in a solver's steps."""
    rng = np.random.default_rng(0)
    for T in wide_poses(machine, 5, 1):
        changed = machine.with_values(machine.values + 0.02 * rng.normal(size=len(machine.values)))
        readings = machine.inverse(T) + 0.02 * rng.normal(size=machine.n_joints)
        assert_as_the_oracle(changed, readings, T)


def test_jacobians_near_singular_poses(machine):
    poses = wide_poses(machine, 20_000, 2)
    c = closure(machine.layout, machine.values, machine.inverse(poses), poses)
    size = kinematics.singularity_of(kinematics.scaled_rows(c))
    assert size.min() < 0.01
    for k in np.argsort(size)[:5]:
        assert_as_the_oracle(machine, machine.inverse(poses[k]), poses[k])


# Kinematics of machines as they are built


def test_built_machines_move_as_drawn(machine):
    """Errors as large as the nominal model's tolerances leave usable configurations, closed and in
    home's assembly.
    """
    for seed in range(3):
        built = true_machine(machine, 1.0, np.random.default_rng(seed))
        assert loads_back(built)
        poses, joints = draw_configurations(built, 40, 0.5, np.random.default_rng(seed))
        error = closure(built.layout, built.values, joints, poses).rows.value
        assert np.abs(error).max() < 1e-11
        forward_kinematics = built.forward(joints)
        np.testing.assert_allclose(forward_kinematics, poses, atol=1e-10)
        shifted = kinematics.on_manifold(built.layout, built.values, poses)
        np.testing.assert_allclose(shifted.T_base_platform, poses, atol=1e-10)


def loads_back(built):
    """A built machine is one that a file could hold: in its plane, with axes of length one."""
    document = validated_document(
        parse_yaml(mechanism_text(built), Path("built.yaml")), MechanismDocument
    )
    return np.array_equal(machine_from_document(document).values, built.values)


def test_a_3_upu_turns_by_what_its_axes_are_off():
    """0.3 degrees between the axes of a leg turn the platform by as much; none, not at all."""
    nominal = load_mechanism("3-upu")
    poses, _ = draw_configurations(nominal, 40, 0.5, np.random.default_rng(0))
    np.testing.assert_allclose(
        poses[:, :3, :3], np.broadcast_to(np.eye(3), (len(poses), 3, 3)), atol=1e-9
    )
    built = true_machine(nominal, 1.0, np.random.default_rng(0))
    between = np.arccos(np.sum(built.base_axes() * built.platform_axes(), axis=1))
    assert np.all((np.degrees(between) > 0.05) & (np.degrees(between) < 1.5))
    poses, _ = draw_configurations(built, 40, 0.5, np.random.default_rng(0))
    turn = np.degrees(np.arccos((np.trace(poses[:, :3, :3], axis1=1, axis2=2) - 1) / 2))
    assert 0.1 < np.median(turn) < 3


# Calibration

CAMERA = camera_models()["pinhole"](
    (1024, 768), np.array([902.0, 903.0, 514.0, 381.0, -0.11, 0.09, 4e-4, -3e-4, 0.0])
)


def simulated(machine, seed, stations=1):
    """Truth and measurements of a session without images."""
    truth = draw_truth(machine, (CAMERA,) * stations, Settings(stations=stations), seed)
    edges, readings = simulate_edges(
        truth.machine, truth.T_camera_base, CAMERA, truth.T_base_platform, EdgeNoise(),
        np.random.default_rng(seed), images=truth.images,
    )  # fmt: skip
    zeros = np.zeros(stations, dtype=int)
    return truth, Measurements(edges, readings, 3e-6, stations, zeros)


def free_errors(nominal, estimate, truth):
    """Errors of the free unknowns, deviations, and their covariance, in the estimate's frames.

    Axes by their turns: along them, components change by squares of small angles only.
    """
    table = nominal.parameters
    values = State(truth.machine.values, truth.T_camera_base, truth.T_base_platform)
    true = in_gauge(nominal, values, default_gauge(nominal)).theta
    error = table.to_free(estimate.machine.values) - table.to_free(true)
    to_free = np.linalg.pinv(table.free_matrix())
    covariance = to_free @ estimate.covariance @ to_free.T
    return error, np.sqrt(np.diag(covariance)), covariance


def whitened(nominal, estimate, truth):
    """Errors over their deviations, made independent."""
    error, scale, covariance = free_errors(nominal, estimate, truth)
    above_limit = scale > 1e-9
    c = covariance[np.ix_(above_limit, above_limit)] / np.outer(
        scale[above_limit], scale[above_limit]
    )
    values, vectors = np.linalg.eigh(c)
    keep = values > 1e-6  # frames are held in combinations of several centres
    return (vectors.T @ (error[above_limit] / scale[above_limit]))[keep] / np.sqrt(values[keep])


def in_sigmas(nominal, estimate, truth):
    """Each kinematic value's error over its deviation."""
    error, scale, _ = free_errors(nominal, estimate, truth)
    table = nominal.parameters
    above_limit = (scale > 1e-9) & (np.array(table.kinds)[table.first_of_free()] != "radius")
    return error[above_limit] / scale[above_limit]


@pytest.mark.parametrize(
    "machine", slow_but(("gough-stewart", "3-rps", "6-spu-passive"), NAMES), indirect=True
)
def test_a_simulated_session_calibrates(machine):
    """Errors match the covariance, over three machines with errors as large as the tolerances."""
    z = []
    for seed in range(3):
        truth, measurements = simulated(machine, seed)
        rough = np.stack([pose.T_camera_base() for pose in truth.rough])
        start = start_state(machine, measurements, rough)
        fit = bundle(machine, measurements, start)
        z.append(whitened(machine, fit, truth))
    z = np.concatenate(z)
    assert np.mean(z**2) == pytest.approx(1, abs=4 * np.sqrt(2 / z.size))


# with images: three places for machines whose platform hides legs or moves them little
RENDERED = {name: 1 if name == "3-rpr" else 3 for name in NAMES}


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_images_calibrate(name, tmp_path):
    """Fifteen images from each place, 1024x768: localized, usable, and errors as stated.

    Bare rods' edges are shifted by some hundredths of a pixel, equally in all images from a place,
    which no standard deviation contains; hence a bound as in test_calibration.
    """
    nominal = load_mechanism(name)
    simulate_session(tmp_path / "s", nominal, CAMERA, Settings(stations=RENDERED[name]), seed=1)
    value = pkmcal.calibrate(tmp_path / "s")
    assert value.verdict.usable
    truth = load_truth(tmp_path / "s", nominal)
    errors = compare_with_truth(value, tmp_path / "s")
    assert errors.calibrated.position < errors.drawing.position / 5
    assert errors.calibrated.orientation < errors.drawing.orientation / 5
    assert np.sqrt(np.mean(in_sigmas(nominal, value.estimate, truth) ** 2)) < 1.6
