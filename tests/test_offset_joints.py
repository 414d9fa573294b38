"""Universal joints whose axes do not meet by design: closure, exports, calibration, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import pkmcal
from export_sources import source_of
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.cameras.pinhole import Pinhole
from pkmcal.errors import InputError
from pkmcal.exporters.contract import make_export
from pkmcal.exporters.samples import samples
from pkmcal.files import yaml_text
from pkmcal.geometry.rigid import perturb
from pkmcal.mechanisms import load_mechanism, mechanism_text
from pkmcal.mechanisms.closure import closure, dense, limb_ends
from pkmcal.mechanisms.joints import offset_rows, rod_shifts
from pkmcal.outcome.finding import Level
from pkmcal.studies.calibrations import JOINT_ESTIMATE_KEY, SimulatedCalibrations
from pkmcal.studies.capture import Design
from pkmcal.studies.engine import run
from pkmcal.studies.tasks import Batch
from screw_hexapod import offset_fields
from test_cables import small_steps
from test_identify_residuals import check
from test_kinematics import differences
from test_pose_sessions import make, write_joints

OFFSETS = {"both": (0.012, 0.009), "base": (0.012, None), "platform": (None, -0.01)}


def hexapod(folder, *offsets):
    path = folder / "offset.yaml"
    path.write_text(yaml_text(offset_fields(*offsets)))
    return path


@pytest.fixture(params=OFFSETS)
def machine(request, tmp_path):
    """Parameters off their nominal values, axes of another length than 1 too."""
    nominal = load_mechanism(hexapod(tmp_path, *OFFSETS[request.param]))
    rng = np.random.default_rng(1)
    return nominal.with_values(nominal.values + 0.005 * rng.normal(size=len(nominal.values)))


def rod_between(T, leg):
    """Ends of a leg's rod, m, by the angles of both joints: the second axis of each turns about its
    first one, and the rod is square to both second axes.
    """
    bodies = {"base": (np.eye(3), np.zeros(3)), "platform": (T[:3, :3], T[:3, 3])}
    joints = []
    for end, (turn, place) in bodies.items():
        axis = turn @ leg[end].get("axis", [1.0, 0.0, 0.0])
        axis = axis / np.linalg.norm(axis)
        joints.append((turn @ leg[end]["center"] + place, axis, leg[end].get("offset", 0.0)))
    toward = joints[1][0] - joints[0][0]

    def ends(angles):
        out = []
        for (center, axis, offset), sign, angle in zip(joints, (1, -1), angles, strict=True):
            ahead = sign * (toward - (toward @ axis) * axis)
            ahead = Rotation.from_rotvec(angle * axis).apply(ahead / np.linalg.norm(ahead))
            out.append((center + offset * ahead, np.cross(axis, ahead)))
        return out

    def slant(angles):
        (a, first), (b, second) = ends(angles)
        return [(b - a) @ first, (b - a) @ second]

    solved = least_squares(slant, [0.0, 0.0], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    (a, _), (b, _) = ends(solved.x)
    return a, b


def test_readings_are_those_of_rods_square_to_both_axes(machine):
    document = machine.to_document()
    shares = []
    for T, readings in zip(*samples(machine, 8), strict=True):
        rods = np.stack(machine.ends_at(readings, T).rods)
        for j, (leg, reading) in enumerate(zip(document["legs"], readings, strict=True)):
            start, stop = rod_between(T, leg)
            length = leg["scale"] * reading + leg["length"]["offset"]
            assert length == pytest.approx(np.linalg.norm(stop - start), abs=1e-12)
            np.testing.assert_allclose(rods[:, j], [start, stop], atol=1e-12)
            a, b = (np.array(leg[end]["center"]) for end in ("base", "platform"))
            shares.append(length - np.linalg.norm(T[:3, :3] @ b + T[:3, 3] - a))
    assert np.ptp(shares) > 1e-4  # no mere change of the rods' offsets


@pytest.mark.parametrize("k", range(2))
def test_derivatives(machine, k):
    layout, theta = machine.layout, machine.values
    T, q = (values[k] for values in samples(machine, 3))
    c = closure(layout, theta, q, T)
    by_pose = differences(lambda d: closure(layout, theta, q, perturb(T, d)).rows.value, 6, 1e-3)
    np.testing.assert_allclose(c.rows.by_pose, by_pose, atol=1e-10)
    count = len(theta)
    by_theta = differences(lambda d: closure(layout, theta + d, q, T).rows.value, count, 1e-3)
    np.testing.assert_allclose(dense(c, count), by_theta, atol=1e-10)


def test_derivatives_of_the_rods_ends(machine):
    layout, theta = machine.layout, machine.values
    T, q = (values[1] for values in samples(machine, 3))
    shifts = limb_ends(layout, theta, q, T).shifts
    line = limb_ends(layout, theta, q, T).platform.b - machine.base_centers()

    def moved(theta=theta, T=T, line=line):
        return rod_shifts(layout.offsets, theta, T[..., :3, :3], line).value

    count = layout.n_legs
    for leg in range(count):
        of_leg = np.arange(count)[:, None] == leg
        by_line = differences(lambda d, at=of_leg: moved(line=line + at * d[:, None]), 3, 1e-3)
        np.testing.assert_allclose(shifts.by_line[leg], by_line[leg], atol=1e-10)
    by_turn = differences(lambda d: moved(T=perturb(T, np.pad(d, ((0, 0), (0, 3))))), 3, 1e-3)
    np.testing.assert_allclose(shifts.by_turn, by_turn, atol=1e-10)
    by_theta = differences(lambda d: moved(theta + d), len(theta), 1e-3)
    by_axes = np.concatenate([shifts.by_base_axis, shifts.by_platform_axis], axis=-1)
    dense_axes = np.zeros((*by_axes.shape[:-1], len(theta) + 1))
    for leg, index in enumerate(layout.offset_axes):
        dense_axes[leg][..., index] = by_axes[leg]
    np.testing.assert_allclose(dense_axes[..., :-1], by_theta, atol=1e-10)


def test_a_leg_parallel_to_an_axis_that_counts_for_nothing(tmp_path):
    """The base joint's axes meet, whatever the direction of the leg."""
    nominal = load_mechanism(hexapod(tmp_path, None, 0.01))
    up = np.array([0.0, 0.0, 0.4])
    rows = offset_rows(nominal.layout.offsets, nominal.values, np.eye(3), np.tile(up, (6, 1)))
    assert all(np.isfinite(part).all() for part in rows)


def test_rods_of_a_leg_across_the_direction_that_counts_for_nothing(tmp_path):
    """The platform joint's axes meet; its direction stands for any, and the leg is across it."""
    nominal = load_mechanism(hexapod(tmp_path, 0.01, None))
    layout, theta = nominal.layout.offsets, nominal.values.copy()
    theta[layout.axis[:, 0]] = [0.0, 0.0, 1.0]
    line = np.tile([0.2, -0.2, 0.0], (6, 1))
    shifts = rod_shifts(layout, theta, np.eye(3), line)
    assert all(np.isfinite(part).all() for part in shifts)
    np.testing.assert_allclose(shifts.value[:, 0], 0.01 * line / np.hypot(0.2, 0.2), atol=1e-15)
    assert not shifts.value[:, 1].any()


def test_deviations_stated_from_images_hold(tmp_path):
    """Twelve calibrations by the edges of machines with errors of their prior sigmas."""
    camera = Pinhole((1280, 960), np.array([900.0, 900.0, 639.5, 479.5, 0, 0, 0, 0, 0]))
    (tmp_path / "m.yaml").write_text(yaml_text(offset_fields(*OFFSETS["both"], tubes=True)))
    machine = load_mechanism(tmp_path / "m.yaml")
    design = Design(machine, (camera,), stations=2, configurations=10)
    sample = run(SimulatedCalibrations(design), 12, 0).samples[JOINT_ESTIMATE_KEY]
    for name in ("parameters", "tool"):
        ratio = sample.values[name] / sample.sigma[name]
        assert 0.7 < np.sqrt(np.nanmean(ratio**2)) < 1.4, name


@pytest.mark.parametrize("offsets", OFFSETS)
def test_derivatives_of_the_edges(offsets, tmp_path):
    """The rod's ends move on second axes with the platform and with both first axes."""
    camera = Pinhole((1280, 960), np.array([900.0, 900.0, 639.5, 479.5, 0, 0, 0, 0, 0]))
    (tmp_path / "m.yaml").write_text(yaml_text(offset_fields(*OFFSETS[offsets], tubes=True)))
    machine = load_mechanism(tmp_path / "m.yaml")
    design = Design(machine, (camera,), stations=2, configurations=4)
    data = SimulatedCalibrations(design).draw(Batch("machine", 2, np.random.SeedSequence(0)))
    problem, rng = data.assembled.problem, np.random.default_rng(3)
    check(problem, problem.retract(data.start, *small_steps(problem, data.start, rng)), rng)


def test_poses_come_back(machine):
    poses, readings = samples(machine, 20)
    near = perturb(poses, 0.02 * np.random.default_rng(2).normal(size=(len(poses), 6)))
    result = machine.forward_result(readings, near)
    assert result.converged.all()
    np.testing.assert_allclose(result.T_base_platform, poses, atol=1e-10)


def test_the_file_has_the_offsets(machine, tmp_path):
    path = tmp_path / "again.yaml"
    path.write_text(mechanism_text(machine))
    poses, readings = samples(machine, 5)
    np.testing.assert_allclose(load_mechanism(path).inverse(poses), readings, atol=1e-12)


@pytest.mark.parametrize(
    ("to", "noted"),
    [
        ("c", True),
        ("linuxcnc", True),
        ("mujoco", False),
        ("urdf", False),
        ("sdf", False),
        ("yaml", False),
    ],
)
def test_a_format_with_one_centre_is_noted(to, noted, tmp_path):
    nominal = load_mechanism(hexapod(tmp_path, *OFFSETS["both"]))
    notes = make_export(source_of(nominal), to).notes
    notes = [one for one in notes if one.code == "export.without_joint_offsets"]
    assert bool(notes) == noted
    for note in notes:
        # less than the offsets, for the rods' offsets take their mean
        assert 1e-5 < note.facts["largest"] < 2e-3
        assert note.level is Level.DOUBTFUL


@pytest.mark.parametrize("to", ["mujoco", "urdf", "sdf"])
def test_models_of_bodies_are_read_back_with_the_offsets(machine, to, tmp_path):
    files = make_export(source_of(machine), to).files
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    again = pkmcal.new(from_file=tmp_path / next(iter(files))).texts["mechanism.yaml"]
    (tmp_path / "again.yaml").write_text(again)
    read = load_mechanism(tmp_path / "again.yaml")
    for leg, other in zip(read.to_document()["legs"], machine.to_document()["legs"], strict=True):
        for end in ("base", "platform"):
            offsets = (one[end].get("offset", 0.0) for one in (leg, other))
            assert next(offsets) == pytest.approx(next(offsets), abs=1e-12)
    poses, readings = samples(machine, 20)
    np.testing.assert_allclose(read.inverse(poses), readings, atol=1e-12)


def test_calibration_knows_the_offsets(tmp_path):
    """With them there is nothing to name; without them the joints' axes are named."""
    path = hexapod(tmp_path, *OFFSETS["both"])
    made = make(tmp_path / "session", path, n=40)
    result = calibrate_session(made.folder)
    assert result.verdict.usable
    assert not result.violations
    # one joint of another offset than stated
    fields = made.machine.to_document()
    fields["legs"][2]["base"]["offset"] += 3e-3
    (tmp_path / "true.yaml").write_text(yaml_text(fields))
    true, readings = load_mechanism(tmp_path / "true.yaml"), made.joints.copy()
    readings += true.inverse(made.T) - made.machine.inverse(made.T)
    write_joints(made.folder, readings)
    (one,) = calibrate_session(made.folder).violations
    assert (one.code, one.of) == ("machine.joint_offset", "leg 3")
    facts = one.finding.facts
    assert facts["value"] == pytest.approx(0.015, abs=4 * facts["sigma"])


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda leg: leg["base"].pop("axis"), "legs[2].base.offset"),
        (lambda leg: leg["length"].update(lead=0.005), "legs[2].length.lead"),
        (lambda leg: leg["base"].update(offset=0.3), "legs[2]"),  # half of the leg
    ],
)
def test_what_offset_joints_exclude_is_refused(change, field, tmp_path):
    fields = offset_fields(*OFFSETS["both"])
    change(fields["legs"][1])
    path = tmp_path / "wrong.yaml"
    path.write_text(yaml_text(fields))
    with pytest.raises(InputError) as error:
        load_mechanism(path)
    assert field in str(error.value.where)
