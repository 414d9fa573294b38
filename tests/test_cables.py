"""Cables over pulleys and on spools: lengths, derivatives, kinematics and calibration."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, least_squares

import pkmcal
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.cameras.pinhole import Pinhole
from pkmcal.errors import GeometryError, InputError
from pkmcal.files import parse_yaml, yaml_text
from pkmcal.geometry.rigid import perturb, pose, pose_difference, rotation
from pkmcal.identify.length_registration import register_by_lengths
from pkmcal.identify.tool import platform_sigma
from pkmcal.mechanisms import load_mechanism, mechanism_text
from pkmcal.mechanisms.carriers.pulley import Pulley, Spool
from pkmcal.mechanisms.closure import closure, dense
from pkmcal.placement.configurations import draw_configurations
from pkmcal.simulation.truth import true_machine
from pkmcal.studies.calibrations import SimulatedCalibrations
from pkmcal.studies.capture import Design
from pkmcal.studies.tasks import Batch
from test_identify_residuals import check

CORNERS = np.array(
    [[x, y, z] for z in (2.0, -2.0) for x, y in ((3, 2), (3, -2), (-3, -2), (-3, 2))]
)
JOINTS = np.array(
    [
        [x, y, z]
        for z in (0.2, -0.2)
        for x, y in ((0.1, 0.4), (0.1, -0.4), (-0.1, -0.4), (-0.1, 0.4))
    ]
)


def base(kind, corner):
    center = [float(x) for x in corner]
    if kind == "pulley":
        return {"joint": "pulley", "center": center, "axis": [0.1, 0.05, 1.0], "radius": 0.04}
    spool = {"joint": "spool", "center": center, "spool": 0.075, "gear": -12.75, "lines": 2.0}
    spool |= {"buildup": 1e-4, "range": [-1500.0, 1500.0]}
    if kind == "spool over pulley":
        spool |= {"axis": [0.1, 0.05, 1.0], "radius": 0.04}
    return spool


def cables(folder, kind, name="cables"):
    """A robot with eight cables."""
    length = {"actuated": True, "range": [0.5, 7.0]}
    if kind != "pulley":
        length = {"actuated": False, "constant": 3.5}
    legs = [
        {
            "base": base(kind, a),
            "platform": {"joint": "spherical", "center": [float(x) for x in b]},
            "length": length,
        }
        for a, b in zip(CORNERS, JOINTS, strict=True)
    ]
    document = {
        "name": name,
        "motion": "spatial",
        "legs": legs,
        "home": {"position": [0.0, 0.0, 0.0]},
        "tolerance": {"center": 0.01, "offset": 0.02, "arm": 0.0003},
    }
    path = folder / f"{name}.yaml"
    path.write_text(yaml_text(document), encoding="utf-8")
    return load_mechanism(path)


def around_home(n, seed=0):
    rng = np.random.default_rng(seed)
    return pose(rotation(rng.uniform(-0.3, 0.3, (n, 3))), rng.uniform(-0.9, 0.9, (n, 3)))


KINDS = ("pulley", "spool", "spool over pulley")


def length_by_search(center, axis, radius, b):
    """Length of a cable that lies on the pulley and goes straight on, by a search for the point at
    which its direction is the pulley's tangent.
    """
    s = axis / np.linalg.norm(axis)
    across = (b - center) - ((b - center) @ s) * s
    e = across / np.linalg.norm(across)
    middle = center + radius * e

    def point(t):
        return middle + radius * (-e * np.cos(t) + s * np.sin(t))

    def off_tangent(t):
        outward = -e * np.cos(t) + s * np.sin(t)
        return (b - point(t)) @ outward

    # of both tangents, the one in whose direction the cable came
    grid = np.linspace(-np.pi / 2 + 1e-9, 1.5 * np.pi - 1e-9, 400)
    for low, high in pairwise(grid):
        if off_tangent(low) * off_tangent(high) < 0:
            t = brentq(off_tangent, low, high, xtol=1e-15)
            ahead = e * np.sin(t) + s * np.cos(t)
            if (b - point(t)) @ ahead > 0:
                return radius * t + np.linalg.norm(b - point(t)), point(t)
    raise AssertionError("no tangent")


def test_a_cable_over_a_pulley_is_as_long_as_a_search_finds():
    rng = np.random.default_rng(0)
    for _ in range(100):
        parameters = np.concatenate([rng.normal(size=6), [rng.uniform(0.01, 0.1)]])
        b = parameters[:3] + rng.normal(size=3)
        length, point = length_by_search(parameters[:3], parameters[3:6], parameters[6], b)
        a, wound = Pulley.tangent_point(parameters, b)
        np.testing.assert_allclose(a, point, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(b - a) + wound, length, atol=1e-12)


def test_a_spool_pays_out_what_its_radius_integrates_to():
    """The radius falls with the cable paid out: dl/dphi = sqrt(R^2 - k l)."""
    radius, buildup, turns = 0.05, 4e-5, 40.0
    parameters = np.array([0, 0, 0, 0, 0, 1, 0, radius, 1.0, 1.0, buildup])
    solved = solve_ivp(
        lambda _, paid: np.sqrt(radius**2 - buildup * paid),
        (0, turns),
        [0.0],
        rtol=1e-11,
        atol=1e-13,
    )
    paid, rate, _ = Spool.paid_out(parameters, np.array(turns))
    np.testing.assert_allclose(paid, solved.y[0, -1], rtol=1e-9)
    np.testing.assert_allclose(rate, np.sqrt(radius**2 - buildup * paid), rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_readings_and_poses_agree(tmp_path, kind):
    machine, poses = cables(tmp_path, kind), around_home(20)
    joints = machine.inverse(poses)
    assert np.isfinite(joints).all()
    assert np.abs(closure(machine.layout, machine.values, joints, poses).rows.value).max() < 1e-12
    np.testing.assert_allclose(machine.forward(joints), poses, atol=1e-10)


def differences(function, x, step):
    """Central differences of the fourth order by each number of x."""
    out = []
    for k in range(len(x)):
        d = np.zeros(len(x))
        d[k] = step
        far, near = function(x + 2 * d) - function(x - 2 * d), function(x + d) - function(x - d)
        out.append((8 * near - far) / (12 * step))
    return np.stack(out, axis=-1)


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_of_the_closure(tmp_path, kind):
    machine, poses = cables(tmp_path, kind), around_home(4, 1)
    layout, theta = machine.layout, machine.values
    joints = machine.inverse(poses) + 0.01
    c = closure(layout, theta, joints, poses)

    def value(theta=theta, joints=joints, delta=0.0):
        return closure(layout, theta, joints, perturb(poses, delta + np.zeros(6))).rows.value

    by_theta = differences(lambda x: value(theta=x), theta, 1e-4)
    np.testing.assert_allclose(dense(c, len(theta)), by_theta, atol=2e-9)
    by_pose = differences(lambda x: value(delta=x), np.zeros(6), 1e-4)
    np.testing.assert_allclose(c.rows.by_pose, by_pose, atol=2e-9)
    by_reading = differences(lambda x: value(joints=joints + x), np.zeros(1), 1e-3)[..., 0]
    np.testing.assert_allclose(c.by_reading, by_reading, atol=2e-9)


@pytest.mark.parametrize("kind", ["pulley", "spool over pulley"])
def test_a_pulley_in_millimetres(tmp_path, kind):
    document = parse_yaml(mechanism_text(cables(tmp_path, kind)), tmp_path / "x.yaml").data
    document["legs"][2]["base"]["radius"] = 40
    (tmp_path / "x.yaml").write_text(yaml_text(document), encoding="utf-8")
    with pytest.raises(InputError) as error:
        load_mechanism(tmp_path / "x.yaml")
    assert "leg 3" in error.value.what
    assert error.value.found == "radius 40 m"


@pytest.mark.parametrize("kind", ["pulley", "spool over pulley"])
def test_derivatives_of_the_point_that_the_cable_leaves(tmp_path, kind):
    machine, poses = cables(tmp_path, kind), around_home(4, 2)
    layout, theta = machine.layout, machine.values
    joints = machine.inverse(poses)
    c = closure(layout, theta, joints, poses)

    def a(theta=theta, delta=0.0):
        return closure(layout, theta, joints, perturb(poses, delta + np.zeros(6))).a

    by_pose = differences(lambda x: a(delta=x), np.zeros(6), 1e-4)
    np.testing.assert_allclose(c.a_by_b @ c.b_by_pose, by_pose, atol=2e-9)
    by = np.zeros((*c.a.shape, len(theta) + 1))
    for j in range(machine.n_legs):
        by[:, j][..., layout.a_index[j]] += c.a_by[:, j]
        by[:, j][..., layout.b_index[j]] += c.a_by_b[:, j] @ c.b_by[:, j]
    by_theta = differences(lambda x: a(theta=x), theta, 1e-4)
    np.testing.assert_allclose(by[..., :-1], by_theta, atol=2e-9)


@pytest.mark.parametrize(
    ("kind", "change", "field"),
    [
        ("spool", {"radius": 0.04}, "radius"),
        ("spool", {"axis": [0.0, 0.0, 1.0]}, "axis"),
        ("spool", {"gear": 0.0}, "gear"),
        ("pulley", {"radius": 0.0}, "radius"),
    ],
)
def test_cables_that_are_no_cables(tmp_path, kind, change, field):
    document = parse_yaml(mechanism_text(cables(tmp_path, kind)), tmp_path / "x.yaml").data
    document["legs"][0]["base"] |= change
    (tmp_path / "x.yaml").write_text(yaml_text(document), encoding="utf-8")
    with pytest.raises(InputError) as error:
        load_mechanism(tmp_path / "x.yaml")
    assert field in str(error.value.where)


@pytest.mark.parametrize("kind", ["pulley", "spool over pulley"])
def test_derivatives_of_the_edges_of_cables(tmp_path, kind):
    """The point that a cable leaves moves with the platform, and the edge with it."""
    camera = Pinhole((1280, 960), np.array([900.0, 900.0, 639.5, 479.5, 0, 0, 0, 0, 0]))
    design = Design(cables(tmp_path, kind), (camera,), stations=2, configurations=4)
    data = SimulatedCalibrations(design).draw(Batch("machine", 2, np.random.SeedSequence(0)))
    problem, rng = data.assembled.problem, np.random.default_rng(3)
    check(problem, problem.retract(data.start, *small_steps(problem, data.start, rng)), rng)


def small_steps(problem, state, rng):
    linear = problem.linearize(state)
    own = linear.by_own.shape[:2] + linear.by_own.shape[-1:]
    shape = (state.z.shape[0], problem.unknowns.count)
    return 0.001 * rng.normal(size=shape), 0.001 * rng.normal(size=own)


def test_true_machines_of_a_study_close_at_their_readings(tmp_path):
    """Eight cables for six freedoms: readings of the nominal model would not close theirs."""
    camera = Pinhole((1280, 960), np.array([900.0, 900.0, 639.5, 479.5, 0, 0, 0, 0, 0]))
    design = Design(cables(tmp_path, "pulley"), (camera,), stations=2, configurations=4)
    data = SimulatedCalibrations(design).draw(Batch("machine", 3, np.random.SeedSequence(1)))
    joints = data.assembled.problem.data.joints
    layout = data.capture.machine.layout
    rows = closure(layout, data.theta[:, None], joints, data.poses)
    assert np.abs(rows.rows.value).max() < 6 * design.reading_noise


def test_configurations_are_those_that_cables_allow(tmp_path):
    """Turned by 35 degrees at most, and the nominal model takes their readings alike: cables to a
    platform that is turned by a hundred degrees would cross.
    """
    rng = np.random.default_rng(5)
    nominal = cables(tmp_path, "pulley")
    for _ in range(3):
        truth = true_machine(nominal, 1.0, rng)
        poses, joints = draw_configurations(truth, 40, 0.0, rng)
        by_nominal = nominal.forward_result(joints).T_base_platform
        for other in (by_nominal, np.broadcast_to(truth.home(), poses.shape)):
            turn = np.linalg.norm(pose_difference(poses, other)[:, :3], axis=1)
            assert np.rad2deg(turn.max()) < 35


def four_cables(folder, seed, n=24):
    """Session of a platform on four cables whose every pose a tracker measured, and its true
    anchors, joints and offsets.
    """
    rng = np.random.default_rng(seed)
    anchors, joints = CORNERS[:4], JOINTS[:4]
    legs = [
        {
            "base": {"joint": "spherical", "center": a.tolist()},
            "platform": {"joint": "spherical", "center": b.tolist()},
            "length": {"actuated": True, "range": [0.5, 8.0]},
        }
        for a, b in zip(anchors, joints, strict=True)
    ]
    document = {"name": "four", "motion": "spatial", "legs": legs}
    document |= {
        "home": {"position": [0.0, 0.0, 0.0]},
        "tolerance": {"center": 0.01, "offset": 0.02},
    }
    true = anchors + rng.normal(0, 0.01, (4, 3)), joints + rng.normal(0, 0.01, (4, 3))
    offsets = rng.normal(0, 0.02, 4)
    poses = around_home(n, seed)
    readings = lengths_at(poses, *true) - offsets + rng.normal(0, 2e-4, (n, 4))
    T_tracker_base = pose(rotation(np.array([0.02, 0.01, 1.0])), np.array([0.5, -4.0, 1.0]))
    noise = np.repeat([1e-4, 5e-5], 3) * rng.normal(size=(n, 6))
    measured = perturb(T_tracker_base @ poses, noise)
    turns = pose_difference(measured, pose(np.eye(3), measured[:, :3, 3]))[:, :3]
    folder.mkdir()
    (folder / "mechanism.yaml").write_text(yaml_text(document), encoding="utf-8")
    table("joints", "leg1,leg2,leg3,leg4", readings, folder)
    table("poses", "x,y,z,rx,ry,rz", np.concatenate([measured[:, :3, 3], turns], axis=1), folder)
    (folder / "session.yaml").write_text(
        "pkmcal: 1\nmechanism: mechanism.yaml\njoints: {file: joints.csv, noise: 0.2 mm}\n"
        "stations:\n  laser:\n    tracker: {poses: poses.csv, noise: {position: 0.05 mm,"
        " rotation: 1.0e-4}}\n",
        encoding="utf-8",
    )
    return poses, readings, (*true, offsets)


def table(name, header, values, folder):
    rows = [f"c{k:02d}," + ",".join(f"{x:.9g}" for x in row) for k, row in enumerate(values)]
    text = "\n".join([f"configuration,{header}", *rows, ""])
    (folder / f"{name}.csv").write_text(text, encoding="utf-8")


def lengths_at(poses, anchors, joints):
    ends = (poses[:, None, :3, :3] @ joints[:, :, None])[..., 0] + poses[:, None, :3, 3]
    return np.linalg.norm(ends - anchors, axis=-1)


def test_four_cables_are_calibrated_where_a_tracker_measured_every_pose(tmp_path):
    """The cables hold no pose, so what is stated are their lengths at poses; against the truth."""
    ratios = []
    for seed in range(3):
        poses, _, (anchors, joints, offsets) = four_cables(tmp_path / str(seed), seed)
        result = calibrate_session(tmp_path / str(seed))
        assert result.verdict.usable
        assert "machine.not_held" in result.verdict.codes
        # the poses' noise is a tenth of the residuals, so a factor on it alone proves nothing
        assert "data.scatter" not in result.verdict.codes
        least, _ = result.estimate.statistics.pose_range
        assert least <= 1
        assert np.isnan(result.tool_error(poses).position).all()
        true = lengths_at(poses, anchors, joints) - offsets
        # the frames of base and platform are conventions
        best = least_squares(off_by, np.zeros(12), args=(result.machine, poses, true))
        ratios.append(np.sqrt(np.mean(best.fun**2)) / platform_sigma(result.estimate))
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_readings_of_four_cables_that_scatter_more_than_stated_are_reported(tmp_path):
    four_cables(tmp_path / "s", 1)
    path = tmp_path / "s" / "session.yaml"
    text = path.read_text().replace("0.05 mm", "0.02 mm").replace("1.0e-4", "4.0e-5")
    path.write_text(text.replace("0.2 mm", "0.08 mm"), encoding="utf-8")
    assert "readings.noise" in calibrate_session(tmp_path / "s").verdict.codes


@pytest.mark.parametrize("seed", [0, 1])
def test_a_wrong_reading_of_four_cables_is_reported(tmp_path, seed):
    """Where a pose is rejected, nothing else determines two of its numbers."""
    _, readings, _ = four_cables(tmp_path / "s", seed)
    readings[4, 0] += 0.01
    table("joints", "leg1,leg2,leg3,leg4", readings, tmp_path / "s")
    assert {"readings.single", "readings.outvoted"} & set(
        calibrate_session(tmp_path / "s").verdict.codes
    )


@pytest.mark.parametrize("what", ["exchanged", "shifted"])
def test_mistakes_in_readings_of_four_cables_are_named(what, tmp_path):
    """No pose follows from the readings: hypotheses are compared at the measured poses. Anchors at
    the corners of a rectangle look alike in a mirror, so an exchange of the two others is a rival.
    """
    for seed in range(8):
        _, readings, _ = four_cables(tmp_path / f"{seed}", seed)
        wrong = np.roll(readings, 1, axis=0)
        if what == "exchanged":
            one, other = np.random.default_rng(seed).choice(4, 2, replace=False)
            wrong = readings.copy()
            wrong[:, [one, other]] = readings[:, [other, one]]
        table("joints", "leg1,leg2,leg3,leg4", wrong, tmp_path / f"{seed}")
        with pytest.raises(InputError) as error:
            calibrate_session(tmp_path / f"{seed}")
        assert error.value.code == f"readings.{what}"
        if what == "exchanged":
            assert f"leg{one + 1}" in str(error.value)
            assert f"leg{other + 1}" in str(error.value)


def test_lengths_at_measured_poses_determine_each_leg(tmp_path):
    """Exact lengths of another machine than the nominal one, in frames that nobody knows."""
    poses, _, _ = four_cables(tmp_path / "s", 0)
    machine = pkmcal.load_session(tmp_path / "s").machine
    camera = pose(rotation(np.array([0.3, -2.0, 1.0])), np.array([0.5, -4.0, 1.0]))
    mount = pose(rotation(np.array([1.0, 0.2, 0.4])), np.array([0.1, 0.0, -0.2]))
    observed, whiten = camera @ poses @ mount, np.tile(np.eye(6), (len(poses), 1, 1))
    found = register_by_lengths(machine, machine.inverse(poses)[None], observed[None], whiten, 1e-4)
    np.testing.assert_allclose(found.T_camera_base[0], camera, atol=1e-9)
    np.testing.assert_allclose(found.T_mount[0], mount, atol=1e-9)
    assert found.squares.max() < 1e-9


def off_by(frames, machine, poses, true):
    base, platform = perturb(np.eye(4), frames[:6]), perturb(np.eye(4), frames[6:])
    return (machine.inverse(base @ poses @ platform) - true).ravel()


def test_one_untracked_pose_of_four_cables_is_refused(tmp_path):
    four_cables(tmp_path / "s", 0)
    path = tmp_path / "s" / "poses.csv"
    path.write_text("\n".join(path.read_text().splitlines()[:-1]) + "\n", encoding="utf-8")
    with pytest.raises(InputError) as error:
        pkmcal.load_session(tmp_path / "s")
    assert error.value.code == "mechanism.not_held"


def test_what_needs_poses_of_readings_refuses_four_cables(tmp_path):
    _, readings, _ = four_cables(tmp_path / "s", 0)
    machine = pkmcal.load_session(tmp_path / "s").machine
    for limited in (machine.limits, machine.follower, lambda: machine.forward(readings)):
        with pytest.raises(GeometryError):
            limited()
    with pytest.raises(InputError):
        load_mechanism(tmp_path / "s" / "mechanism.yaml")
