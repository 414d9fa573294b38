"""Sessions of poses from tables, without images: calibrated, mixed, with faults."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from faults import raises
from pkmcal.boards.views import Boards
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.calibration.camera_refinement import measurements_of
from pkmcal.calibration.faults import richer_model, wrong_scale
from pkmcal.calibration.outlier_explanations import outlier_explanations
from pkmcal.calibration.saved_calibration import load
from pkmcal.checks.check import check_session, pose_findings
from pkmcal.errors import InputError
from pkmcal.files import csv_text, yaml_text
from pkmcal.geometry.rigid import (
    inverse,
    perturb,
    pose,
    rotation,
    rotation_vector,
)
from pkmcal.identify.bundle import bundle
from pkmcal.identify.hand_eye import solve_pairs, start_from_poses
from pkmcal.identify.methods import estimates
from pkmcal.mechanisms import load_mechanism, mechanism_text
from pkmcal.outcome import Level
from pkmcal.placement.configurations import draw_configurations
from pkmcal.report.calibration import save
from pkmcal.session.load import load_session
from pkmcal.session.poses import PoseTable, read_poses
from pkmcal.simulation.truth import true_machine

T_TRACKER_BASE = pose(rotation(np.array([0.4, -0.2, 2.0])), np.array([1.5, 0.3, -0.4]))
T_PLATFORM_TARGET = pose(rotation(np.array([0.3, 1.2, 0.4])), np.array([0.03, 0.02, -0.04]))
COLUMNS = {
    "poses": ("x", "y", "z", "rx", "ry", "rz"),
    "points": ("x", "y", "z"),
    "heights": ("z",),
    "orientations": ("rx", "ry", "rz"),
}
POSITION, TURN = 2e-5, 1e-4


@dataclass(frozen=True)
class Made:
    """A session's folder and its truth."""

    folder: object
    nominal: object
    machine: object
    joints: np.ndarray
    T: np.ndarray


def make(folder, name, kind="poses", n=24, seed=0, scale=1.0, model=None, station=None):
    """A session of one tracker; its noise is as stated."""
    rng = np.random.default_rng(seed)
    nominal = load_mechanism(name, model=model)
    machine = true_machine(nominal, scale, rng)
    T, joints = configurations(machine, n, rng)
    place = np.eye(4) if kind == "heights" else T_TRACKER_BASE
    target = T_PLATFORM_TARGET if station is None else station
    sigma = np.repeat([TURN, POSITION], 3)
    in_view = perturb(place @ T @ target, sigma * rng.normal(size=(len(T), 6)))
    noise = 1e-5
    readings = joints + noise * rng.normal(size=joints.shape)
    folder.mkdir()
    (folder / "mechanism.yaml").write_text(mechanism_text(nominal))
    write_joints(folder, readings)
    write_poses(folder, in_view, kind)
    document = {
        "pkmcal": 1,
        "mechanism": "mechanism.yaml",
        "joints": {"file": "joints.csv", "noise": noise},
        "stations": {
            "tracker": {
                "tracker": {
                    "poses": "poses.csv",
                    "noise": {"position": POSITION, "rotation": TURN},
                }
            }
        },
    }
    (folder / "session.yaml").write_text(yaml_text(document))
    return Made(folder, nominal, machine, readings, T)


def configurations(machine, n, rng):
    """Poses (n, 4, 4) and exact readings; of the H4 in the paper's workspace."""
    if machine.document.motion != "schoenflies":
        return tuple(part[:n] for part in draw_configurations(machine, n, 0.5, rng))
    x = rng.uniform([-0.1, -0.1, -0.525, -0.35], [0.1, 0.1, -0.375, 0.35], (n, 4))
    T = pose(rotation(x[:, 3:] * [0.0, 0.0, 1.0]), x[:, :3])
    return T, machine.inverse(T)


def write_joints(folder, joints):
    names = [f"{k:03d}" for k in range(len(joints))]
    columns = [f"motor{k + 1}" for k in range(joints.shape[1])]
    (folder / "joints.csv").write_text(csv_text(columns, names, joints))


def write_poses(folder, in_view, kind="poses"):
    names = [f"{k:03d}" for k in range(len(in_view))]
    values = np.concatenate([in_view[:, :3, 3], rotation_vector(in_view[:, :3, :3])], axis=1)
    at = [("x", "y", "z", "rx", "ry", "rz").index(column) for column in COLUMNS[kind]]
    values = values[:, at]
    (folder / "poses.csv").write_text(csv_text(COLUMNS[kind], names, values))


def measured_poses(made):
    """The tracker's poses without noise."""
    return T_TRACKER_BASE @ made.T @ T_PLATFORM_TARGET


def tool_error(machine, made, n=60):
    """Root mean square distance (m) of the platform's places from the true ones, after the best
    fit of both frames, at poses that were not measured.
    """
    T, joints = configurations(made.machine, n, np.random.default_rng(99))
    forward_kinematics = machine.forward(joints)
    frames = solve_pairs(forward_kinematics[None], T[None], 0.3)
    off = frames.T_camera_base[0] @ forward_kinematics @ frames.T_mount[0] - T
    return np.sqrt(np.mean(np.sum(off[:, :3, 3] ** 2, axis=-1)))


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "session"


@pytest.mark.parametrize(
    "name",
    ["gough-stewart", "h4", "delta",
     *(pytest.param(name, marks=pytest.mark.slow) for name in ("6-rus", "3-upu"))],
)  # fmt: skip
def test_whole_poses_calibrate_any_machine(folder, name):
    made = make(folder, name)
    result = calibrate_session(folder)
    s = result.estimate.statistics
    # of n numbers that are noise, the root mean square has the deviation 1 / sqrt(2 n)
    assert s.pose_scale < 1 + 4 / np.sqrt(2 * s.dof_poses)
    assert s.n_poses > 6 * 24 - 0.01  # none is let go, though one may be four deviations off
    before, after = tool_error(made.nominal, made), tool_error(result.machine, made)
    assert after < 0.1 * before
    assert after < 6e-5
    assert not [text for text in result.verdict.warnings if "outvoted" in text]


def test_stations_and_targets_are_found_with_their_deviations(folder):
    """In frames that do not matter: from the tracker to the target at each configuration."""
    made = make(folder, "gough-stewart", seed=3)
    result = calibrate_session(folder)
    state = result.estimate.state
    value = state.T_camera_base[0] @ state.T_base_platform @ state.T_mount[0]
    error = rotation_vector((inverse(value) @ measured_poses(made))[:, :3, :3])
    assert np.sqrt(np.mean(error**2)) < TURN
    sigma = np.sqrt(np.diag(result.estimate.mount_covariance[0]))
    assert np.all(sigma > 0)
    assert np.all(sigma[:3] < 1e-2)


def test_points_alone(folder):
    made = make(folder, "gough-stewart", "points", n=40)
    result = calibrate_session(folder)
    assert result.estimate.statistics.n_poses == 120
    assert tool_error(result.machine, made) < 0.3 * tool_error(made.nominal, made)


def test_orientations_alone(folder):
    """Only rotations are known: the platform's are corrected, with honest deviations, and no place
    of tracker or target is printed.
    """
    made = make(folder, "3-rps", "orientations", n=40, seed=2)
    document = yaml.safe_load((folder / "session.yaml").read_text())
    document["stations"]["tracker"]["tracker"]["noise"] = {"rotation": TURN}
    (folder / "session.yaml").write_text(yaml_text(document))
    result = calibrate_session(folder)
    assert result.verdict.usable
    assert result.estimate.statistics.n_poses == 3 * 40
    T, joints = configurations(made.machine, 60, np.random.default_rng(9))

    def orientation_error(machine):
        """Root mean square of the rotation since the first pose, in the true frame."""
        value = [
            rotation_vector(P[:, :3, :3] @ P[0, :3, :3].T) for P in (machine.forward(joints), T)
        ]
        u, _, vt = np.linalg.svd(value[0].T @ value[1])
        aligned = value[1] @ (u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt).T
        return np.sqrt(np.mean(np.sum((value[0] - aligned) ** 2, axis=1)))

    assert orientation_error(result.machine) < 0.05 * orientation_error(made.nominal)
    save(result, folder.parent / "out")
    (target,) = load(folder.parent / "out").document["targets"]
    assert target["sigma_translation"] == [None, None, None]
    assert None not in target["sigma_rotation"]


def test_what_a_tracker_measures_needs_its_own_noise(folder):
    made = make(folder, "3-rps", "orientations", n=5)
    joints = tuple(f"{k:03d}" for k in range(len(made.joints)))
    with raises(InputError, code="poses.no_noise", found="columns rx, ry, rz"):
        read_poses(folder / "poses.csv", "poses.csv", joints, POSITION, None)
    write_poses(folder, made.T, "points")
    with raises(InputError, code="poses.no_noise", found="columns x, y, z"):
        read_poses(folder / "poses.csv", "poses.csv", joints, None, TURN)


@pytest.mark.parametrize(
    ("position", "rotation", "kind"),
    [(POSITION, TURN, "poses"), (POSITION, None, "points"), (None, TURN, "orientations")],
)
def test_the_kind_to_come_follows_from_the_stated_noise(position, rotation, kind):
    assert PoseTable.to_come("tracker", "poses.csv", position, rotation).kind == kind


def test_a_tracker_to_come_without_any_noise(folder):
    with raises(InputError, code="poses.no_noise", found="neither position nor rotation"):
        PoseTable.to_come("tracker", "poses.csv", None, None)


def test_heights_of_a_flat_bed(folder):
    """A probed linear delta: its tilt and bulge are corrected, unidentifiable directions are
    reported.
    """
    target = pose(np.eye(3), np.array([0.0, 0.0, -0.04]))
    made = make(folder, "linear-delta", "heights", n=20, station=target)
    result = calibrate_session(folder)
    s = result.estimate.statistics
    assert s.n_poses == 20
    assert s.pose_scale < 1.6
    T, joints = configurations(made.machine, 60, np.random.default_rng(5))

    def bulge(machine):
        """Height of the nozzle over the best plane through the true and found heights, rms."""
        z = machine.forward(joints)[:, 2, 3] - T[:, 2, 3]
        plane = np.column_stack([T[:, 0, 3], T[:, 1, 3], np.ones(len(T))])
        return np.sqrt(np.mean((z - plane @ np.linalg.lstsq(plane, z, rcond=None)[0]) ** 2))

    assert bulge(result.machine) < 0.2 * bulge(made.nominal)


def test_outliers_are_let_go_and_named(folder):
    made = make(folder, "gough-stewart", n=30)
    in_view = measured_poses(made)
    in_view[7] = perturb(in_view[7], np.array([0, 0, 0, 0.004, 0, 0.0]))
    in_view[20] = perturb(in_view[20], np.array([0, 0.02, 0, 0, 0, 0.0]))
    write_poses(folder, in_view)
    result = calibrate_session(folder)
    assert np.flatnonzero(result.estimate.pose_weights < 0.5).tolist() == [7, 20]
    rows = [r for r in result.observation.rejected if r.configuration in (7, 20)]
    assert all("standard deviations from where all others put it" in r.reason for r in rows)
    # thirty poses of six numbers confirm that these two are wrong
    assert result.verdict.usable
    (named,) = result.verdict.of("rejected.units")
    assert (named.facts["number"], named.facts["of"]) == (2, "30 poses")
    assert named.facts["names"] == [result.session.configurations[k] for k in (7, 20)]
    assert tool_error(result.machine, made) < 6e-5


def test_a_model_too_poor_is_refused_and_the_richer_one_named(folder):
    made = make(folder, "h4", n=40)
    text = load_mechanism("h4").document
    assert "design" in text.models
    document = (folder / "session.yaml").read_text().replace("mechanism.yaml", "h4")
    (folder / "session.yaml").write_text(document)
    poor = calibrate_session(load_session(folder, "design"))
    assert not poor.verdict.usable
    (misfit,) = poor.verdict.of("data.misfit")
    assert misfit.facts["model"] == "calibration"
    rich = calibrate_session(load_session(folder, "calibration"))
    assert rich.verdict.usable
    assert tool_error(rich.machine, made) < 0.2 * tool_error(poor.machine, made)


@pytest.mark.slow
def test_poses_noisier_than_stated_need_no_richer_model(folder):
    """Three times the stated noise: more parameters fit more of it, as of any noise."""
    made, rng = make(folder, "h4", n=16, model="design"), np.random.default_rng(0)
    sigma = 3 * np.repeat([TURN, POSITION], 3)
    write_poses(folder, perturb(measured_poses(made), sigma * rng.normal(size=(16, 6))))
    document = (folder / "session.yaml").read_text().replace("mechanism.yaml", "h4")
    (folder / "session.yaml").write_text(document)
    session = load_session(folder, "design")
    measurements = measurements_of(session, Boards())
    start = start_from_poses(session.machine, measurements)
    fit = bundle(session.machine, measurements, start, scale_readings=False)
    assert fit.statistics.pose_scale > 2
    assert richer_model(session, measurements, fit) == (None, ())


def test_inverse_kinematic_is_a_method(folder):
    made = make(folder, "gough-stewart", n=30)
    joint = calibrate_session(folder)
    machine, measurements = joint.session.machine, joint.measurements
    estimate = estimates.by_method(
        "inverse-kinematic", machine, measurements, joint.estimate, repetitions=3
    )
    assert tool_error(estimate.machine, made) < 0.1 * tool_error(made.nominal, made)


def test_everything_is_saved_and_read_back(folder, tmp_path):
    make(folder, "h4")
    result = calibrate_session(folder)
    save(result, tmp_path / "out")
    document = load(tmp_path / "out").document
    assert document["targets"][0]["name"] == "tracker"
    assert len(document["targets"][0]["T_platform_target"]) == 4
    assert len(document["residuals"]["poses"]) == 24
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Measured poses" in page
    assert "Where it sits" in page
    assert 'id="photographs"' not in page


# what is wrong is found


def test_a_target_moved_on_the_platform(folder):
    made = make(folder, "gough-stewart", n=20)
    in_view = measured_poses(made)
    step = perturb(np.eye(4), np.array([0.01, 0.0, 0.02, 0.002, 0.0, 0.001]))
    in_view[12:] = in_view[12:] @ step
    write_poses(folder, in_view)
    with raises(InputError, code="board.moved") as caught:
        calibrate_session(folder)
    assert "between configuration 011 and 012" in caught.value.what


def test_one_wrong_reading_is_rejected_and_reported(folder):
    made = make(folder, "gough-stewart", n=30)
    joints = made.joints.copy()
    joints[7, 2] += 0.005
    write_joints(folder, joints)
    calibration = calibrate_session(folder)
    assert tool_error(calibration.machine, made) < 1.5e-4
    (values,) = calibration.verdict.of("readings.outvoted")
    assert values.subject == "motor3, 007"
    assert values.facts["value"] == pytest.approx(-0.005, rel=0.06)


@pytest.mark.slow
def test_no_configuration_is_exchanged_with_itself(folder):
    """A pose that lost its weight, its reading off by as much as makes it just disagree."""
    make(folder, "h4", n=30)
    right = calibrate_session(folder)
    estimate, measurements = right.estimate, right.measurements
    weights = estimate.pose_weights.copy()
    weights[measurements.poses.configuration == 7] = 0.0
    text = []
    for off in np.linspace(0, 4e-3, 81):
        joints = measurements.joints.copy()
        joints[7, 2] += off
        text += outlier_explanations(
            replace(right.session, joints=joints),
            replace(measurements, joints=joints),
            replace(estimate, pose_weights=weights),
        )
    # far off enough it is named, and nothing else
    assert {(one.code, one.subject) for one in text} == {("readings.outvoted", "motor3, 007")}
    assert "007" not in {one.facts.get("like") for one in text}
    joints = measurements.joints.copy()
    joints[7] += [2e-3, -2e-3, 3e-3, 1e-3]  # no single reading, and no other configuration's
    spoilt = replace(measurements, joints=joints)
    estimate = replace(estimate, pose_weights=weights)
    assert not [*outlier_explanations(right.session, spoilt, estimate)]


@pytest.mark.slow
def test_poses_that_coarse_readings_explain_are_not_rejected(folder):
    """Hobby servos, half a degree, stated as a thousandth of that: some poses look wrong until the
    readings' noise is estimated, and are right then.
    """
    made = make(folder, "h4", n=24)
    rng = np.random.default_rng(3)
    write_joints(folder, made.joints + np.deg2rad(0.5) * rng.normal(size=made.joints.shape))
    calibration = calibrate_session(folder)
    assert np.all(calibration.estimate.pose_weights > 0.5)
    scatter = calibration.estimate.statistics.reading_scale * calibration.session.joint_noise
    assert np.rad2deg(scatter) == pytest.approx(0.5, rel=0.25)
    low, high = calibration.estimate.statistics.reading_range
    assert low < np.deg2rad(0.5) / calibration.session.joint_noise < high


def test_exchanged_rows_are_rejected_and_reported(folder):
    made = make(folder, "h4", n=30)
    write_joints(folder, made.joints[[*range(11), 20, *range(12, 20), 11, *range(21, 30)]])
    calibration = calibrate_session(folder)
    assert tool_error(calibration.machine, made) < 1.5e-4
    (values,) = calibration.verdict.of("configurations.misnamed")
    assert values.subject == "joints.csv, configuration 011 and 020"
    assert (values.facts["configuration"], values.facts["both"]) == ("011", "yes")


def test_a_pose_under_another_name_is_reported(folder):
    made = make(folder, "gough-stewart", n=30)
    in_view = measured_poses(made)
    in_view[4] = in_view[17]
    write_poses(folder, in_view)
    calibration = calibrate_session(folder)
    (values,) = calibration.verdict.of("configurations.misnamed")
    assert (values.facts["configuration"], values.facts["other"]) == ("004", "017")
    assert values.facts["both"] == "no"


@pytest.mark.parametrize("name", [pytest.param("h4", marks=pytest.mark.slow), "delta"])
def test_a_frozen_reading(folder, name):
    made = make(folder, name, n=30)
    joints = made.joints.copy()
    joints[:, 1] = joints[0, 1]
    write_joints(folder, joints)
    with raises(InputError, code="readings.frozen", where="joints.csv, column motor2"):
        calibrate_session(folder)


@pytest.mark.parametrize("motor", [pytest.param(0, marks=pytest.mark.slow), 2])
def test_the_sign_of_one_encoder(folder, motor):
    made = make(folder, "gough-stewart", n=30)
    text = (folder / "mechanism.yaml").read_text()
    joints = made.joints.copy()
    joints[:, motor] *= -1
    write_joints(folder, joints)
    where = f"joints.csv, line 2, column motor{motor + 1}"
    with raises(InputError, code="readings.sign", where=where):
        calibrate_session(folder)
    assert "range" in text


@pytest.mark.parametrize("motor", [pytest.param(0, marks=pytest.mark.slow), 3])
def test_a_motor_that_counts_the_other_way(folder, motor):
    """With an unknown constant: the reported value fits the mechanism's tolerance."""
    made = make(folder, "gough-stewart", n=20)
    joints = made.joints.copy()
    constant = joints[:, motor].min() + joints[:, motor].max() + 0.003
    joints[:, motor] = constant - joints[:, motor]
    write_joints(folder, joints)
    with pytest.raises(InputError) as caught:
        calibrate_session(folder)
    assert caught.value.what.endswith(f"{motor + 1} count the other way")
    named = float(re.match(r"(\d+) mm", caught.value.expected)[1])
    assert abs(named - 1e3 * constant) < 6
    joints[:, motor] = 1e-3 * named - joints[:, motor]
    write_joints(folder, joints)
    assert calibrate_session(folder).verdict.usable


@pytest.mark.slow
def test_two_columns_exchanged(folder):
    made = make(folder, "h4", n=16)
    write_joints(folder, made.joints[:, [1, 0, 2, 3]])
    with raises(InputError, code="readings.exchanged") as caught:
        calibrate_session(folder)
    assert "motor1 and motor2" in caught.value.what


def test_readings_in_degrees(folder):
    made = make(folder, "h4", n=30)
    write_joints(folder, np.rad2deg(made.joints))
    with raises(InputError, code="readings.units") as caught:
        load_session(folder)
    assert caught.value.expected.startswith("radians")
    assert "pi/180" in caught.value.next_step


def test_lengths_of_another_scale(folder):
    made = make(folder, "h4", n=30)
    in_view = measured_poses(made)
    in_view[:, :3, 3] *= 1.05
    write_poses(folder, in_view)
    verdict = calibrate_session(folder).verdict
    assert not verdict.usable
    (scale,) = verdict.of("machine.scale")
    assert scale.facts["value"] == pytest.approx(0.05, rel=0.1)


def test_a_factor_of_one_kind_of_part_is_no_scale_of_the_machine():
    """A base 4 mm too wide, two prior sigmas, beside ordinary errors; all lengths 5 % longer."""
    machine = load_mechanism("gough-stewart")
    table, rng = machine.parameters, np.random.default_rng(0)
    values = table.nominal + table.tolerance * rng.normal(size=len(table.nominal))
    for leg in range(1, machine.n_legs + 1):
        x, y = (table.index(f"legs[{leg}].base.center.{axis}") for axis in "xy")
        values[[x, y]] *= 1 + 0.004 / np.hypot(table.nominal[x], table.nominal[y])

    def scale(values):
        count = len(values)
        return wrong_scale(
            SimpleNamespace(machine=machine.with_values(values), covariance=np.eye(count))
        )

    assert scale(values) == 1.0
    lengths = np.array([unit == "m" for unit in table.units])
    assert scale(np.where(lengths, 1.05, 1.0) * table.nominal) == pytest.approx(1.05, rel=1e-6)


def test_errors_of_the_joints_that_define_the_frame_are_no_scale():
    """A four-belt machine whose anchors are off by ordinary errors, in frames by two of them."""
    machine = load_mechanism("four-belt")
    table, rng = machine.parameters, np.random.default_rng(0)
    index = [[table.index(f"legs[{leg}].base.center.{c}") for c in "xy"] for leg in (1, 2, 3, 4)]
    nominal, covariance = table.nominal[index], np.zeros((len(table), len(table)))
    places = np.array(index).ravel()
    free = np.delete(places, [0, 1, 3])  # the first is the origin, the second on the x axis
    covariance[free, free] = 1.0
    named = 0
    for _ in range(2000):
        off = nominal + table.tolerance[index] * rng.normal(size=(4, 2)) - nominal[0]
        off -= off[0]
        x = off[1] / np.linalg.norm(off[1])
        values = table.nominal.copy()
        values[index] = nominal[0] + off @ np.array([x, [-x[1], x[0]]]).T
        estimate = SimpleNamespace(machine=machine.with_values(values), covariance=covariance)
        named += wrong_scale(estimate) != 1.0
    assert named <= 8


def test_check_reports_how_the_platform_turns(folder):
    made = make(folder, "h4", n=20)
    check = check_session(folder)
    assert check.exit_code < 2
    assert "poses.turning" in [one.code for one in check.findings]
    rng = np.random.default_rng(1)
    visible = perturb(measured_poses(made), np.concatenate([0.01 * rng.normal(size=(20, 3)),
                                                     np.zeros((20, 3))], axis=1))  # fmt: skip
    write_poses(folder, visible)
    faults = [
        finding.code
        for finding in pose_findings(load_session(folder), Boards())
        if finding.level is Level.DOUBTFUL
    ]
    assert "poses.not_turning" in faults
