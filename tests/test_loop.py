"""The loop that a laboratory connects: it arrives, and where it must not go on, it stops."""

from __future__ import annotations

import re

import numpy as np
import pytest

from faults import raises
from pkmcal.control.loop import GoalImage, Status, VisualServo
from pkmcal.control.machine_view import machine_view, true_edges
from pkmcal.errors import GeometryError, InputError, ResultError
from pkmcal.geometry.rigid import inverse, look_at, perturb, pose_difference
from pkmcal.mechanisms import catalogue, load_mechanism
from pkmcal.mechanisms.closure import limb_ends
from servo_lab import BESIDE, MIRROR, PERSPECTIVE, WITHIN, Lab

MACHINE = load_mechanism("gough-stewart")
HOME = MACHINE.home()
READINGS = MACHINE.inverse(HOME[None])[0]
GOAL = perturb(HOME, np.array([0.05, -0.04, 0.08, 0.012, -0.01, 0.015]))
VIEW = machine_view(MACHINE, BESIDE)
WITH_TUBES = [n for n in catalogue() if any(g.tubes for g in load_mechanism(n).document.legs)]


def servo(goal=GOAL, machine=MACHINE, **options) -> VisualServo:
    return VisualServo(machine, None, BESIDE, goal, **options)


def edges(T_base_platform=HOME):
    return true_edges(VIEW, T_base_platform)


def stopped(step) -> bool:
    return not step.joint_velocities.any() and not step.status.moves and not step.converged


# ------------------------------------------------------------------ on its way


def camera_before(machine, readings):
    """Camera at the side of the machine, at three times its width."""
    ends = limb_ends(machine.layout, machine.values, readings, machine.home())
    points = np.concatenate([ends.a, ends.b])
    middle = points.mean(axis=0)
    size = np.linalg.norm(points - middle, axis=1).max()
    up = np.array([0.0, 0.0, 1.0])
    return look_at(middle + size * np.array([0.3, -3.2, 1.6]), middle, up)


@pytest.mark.parametrize("law", ["edges", "directions"])
@pytest.mark.parametrize("name", WITH_TUBES)
def test_every_machine_with_tubes_arrives(name, law):
    machine = load_mechanism(name)
    home = machine.home()
    readings = machine.inverse(home[None])[0]
    ranges = machine.joint_ranges
    span = np.where(np.isfinite(ranges).all(axis=1), np.ptp(ranges, axis=1), 0.1)
    direction = 0.08 * span * np.random.default_rng(1).uniform(-1, 1, machine.n_joints)
    goal = machine.forward((readings + direction)[None], home)[0]
    loop = VisualServo(machine, None, camera_before(machine, readings), goal, law=law, gain=0.5)
    pose, errors = home, []
    for _ in range(24):
        step = loop.step_edges(true_edges(loop.view, pose, readings), readings)
        errors.append(step.error)
        readings = readings + step.joint_velocities
        pose = machine.forward(readings[None], pose)[0]
    assert step.status is Status.CONVERGED
    assert errors[-1] < 1e-6 < errors[0]
    assert np.abs(pose_difference(pose, goal)).max() < 1e-6
    assert np.abs(step.remaining).max() < 1e-6


def test_the_first_step_is_the_laws_own():
    from pkmcal.control.laws import joint_velocities

    step = servo(gain=0.7).step_edges(edges(), READINGS)
    goal = true_edges(VIEW, GOAL)
    expected = joint_velocities("edges", VIEW, edges(), goal, READINGS, 0.7)
    np.testing.assert_allclose(step.joint_velocities, expected, rtol=1e-9)
    np.testing.assert_allclose(step.joint_velocities, -0.7 * step.remaining, rtol=1e-12)
    assert np.isnan(step.sigma).all()


def test_rate_limits_slow_all_motors_together():
    free = servo().step_edges(edges(), READINGS)
    slow = servo(rate_limits=0.005).step_edges(edges(), READINGS)
    assert np.abs(slow.joint_velocities).max() == pytest.approx(0.005)
    factor = slow.joint_velocities / free.joint_velocities
    np.testing.assert_allclose(factor, factor[0], rtol=1e-9)
    assert any("slowed down" in w for w in slow.warnings)
    each = np.full(6, 1.0)
    each[2] = 1e-4
    slow = servo(rate_limits=each).step_edges(edges(), READINGS)
    assert abs(slow.joint_velocities[2]) == pytest.approx(1e-4)


def test_edges_are_a_goal_as_well():
    step = servo(true_edges(VIEW, GOAL)).step_edges(edges(), READINGS)
    np.testing.assert_allclose(
        step.joint_velocities, servo().step_edges(edges(), READINGS).joint_velocities, atol=1e-12
    )


def test_a_lost_leg_is_done_without():
    loop = servo(gain=0.5)
    pose, readings = HOME, READINGS.copy()
    for k in range(24):
        in_view = true_edges(VIEW, pose)
        if k > 2:
            in_view[1] = np.nan
        step = loop.step_edges(in_view, readings)
        assert step.status.moves
        readings = readings + step.joint_velocities
        pose = MACHINE.forward(readings[None], pose)[0]
    assert step.used.tolist() == [True, False, True, True, True, True]
    assert any(w.startswith("leg 2 is not seen") for w in step.warnings)
    assert np.abs(pose_difference(pose, GOAL)).max() < 1e-6


# ------------------------------------------------------------------ where it stops


def test_too_few_legs_stop_it_and_their_return_goes_on():
    loop = servo()
    in_view = edges()
    assert loop.step_edges(in_view, READINGS).status is Status.RUNNING
    few = np.where(np.arange(6)[:, None, None] < 2, in_view, np.nan)
    step = loop.step_edges(few, READINGS)
    assert stopped(step)
    assert step.status is Status.LOST
    assert "legs 1 and 2 alone cannot show every motion" in step.sentence
    step = loop.step_edges(np.full_like(in_view, np.nan), READINGS)
    assert step.status is Status.LOST
    assert stopped(step)
    assert loop.step_edges(in_view, READINGS).status is Status.RUNNING


def other_assembly():
    modes = MACHINE.assembly_modes(READINGS, np.random.default_rng(1))
    far = [np.abs(pose_difference(mode, HOME)).max() for mode in modes]
    above = [m for m, f in zip(modes, far, strict=True) if f > 0.5 and m[2, 3] > 0]
    return above[0]


def test_a_wrong_assembly_at_the_start_is_distinguished_from_the_right_one():
    mode = other_assembly()
    step = servo().step_edges(edges(mode), READINGS)
    assert stopped(step)
    assert step.status is Status.WRONG_ASSEMBLY
    x, y, z = re.search(r"platform at \(([^)]*)\) m", step.sentence)[1].split(", ")
    np.testing.assert_allclose([float(x), float(y), float(z)], mode[:3, 3], atol=1e-3)
    # with that start, the goal lies behind a singular pose
    step = servo(start=mode).step_edges(edges(mode), READINGS)
    assert stopped(step)
    assert step.status is Status.CROSSING


def test_legs_of_no_assembly_at_all_are_no_start():
    elsewhere = perturb(HOME, np.array([0.5, 0.5, 0.9, 0.1, 0.1, 0.0]))
    step = servo().step_edges(edges(elsewhere), READINGS)
    assert step.status is Status.WRONG_ASSEMBLY
    assert "no other assembly fits them" in step.sentence


def test_a_goal_on_the_other_side_is_too_far():
    below = perturb(HOME, np.array([0, 0, 0, 0, 0, -2 * HOME[2, 3]]))
    step = servo(true_edges(VIEW, below)).step_edges(edges(), READINGS)
    assert stopped(step)
    assert step.status is Status.TOO_FAR
    assert "90 degrees" in step.sentence


def test_a_motor_at_its_end_stops_what_leads_further_and_not_what_leads_back():
    moving = servo().step_edges(edges(), READINGS)
    k = int(np.argmax(np.abs(moving.joint_velocities)))
    direction = np.sign(moving.joint_velocities[k])
    readings = READINGS.copy()
    readings[k] = MACHINE.joint_ranges[k, 0 if direction < 0 else 1] - 1e-4 * direction
    # the image is another one's, but the reading is under test
    loop = servo(period=0.1)
    loop._started = True
    step = loop.step_edges(edges(), readings)
    assert stopped(step)
    assert step.status is Status.OUT_OF_RANGE
    assert f"leg {k + 1} reads" in step.sentence
    readings[k] = MACHINE.joint_ranges[k, 1 if direction < 0 else 0] + 1e-3 * -direction
    step = loop.step_edges(edges(), readings)
    assert step.status is Status.RUNNING
    assert any(f"leg {k + 1} is outside its range" in w for w in step.warnings)


def test_a_singular_pose_stops_it():
    """Turned by ninety degrees about its axis, a platform over its base is singular (Fichter)."""
    turned = perturb(HOME, np.array([0, 0, np.pi / 2, 0, 0, -0.05]))
    at = MACHINE.forward_result(MACHINE.inverse(turned[None]), turned)
    assert at.singularity[0] < 0.02
    readings = MACHINE.inverse(turned[None])[0]
    step = servo(start=turned).step_edges(edges(turned), readings)
    assert stopped(step)
    assert step.status is Status.SINGULAR


def test_readings_of_no_pose_stop_it():
    step = servo().step_edges(edges(), READINGS * [2, 1, 1, 0.2, 1, 1])
    assert stopped(step)
    assert step.status is Status.UNREACHABLE


# ------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("goal", "facts"),
    [
        (np.zeros((3, 3)), {"found": "an array of shape (3, 3)"}),
        (np.ones((6, 2, 3)), {"found": "length 1.73205"}),
        (np.full((4, 4), np.nan), {"code": "array.not_finite"}),
        (perturb(HOME, np.array([0, 0, np.pi / 2, 0, 0, -0.05])), {"code": "pose.singular"}),
        (GoalImage(np.zeros((480, 640), np.uint8), READINGS), {"code": "servo.no_camera"}),
    ],
)
def test_goals_that_cannot_be_are_refused(goal, facts):
    with raises(InputError, **facts):
        servo(goal)


def test_a_goal_out_of_reach_names_the_motor():
    with raises(InputError, code="pose.outside_workspace", expected="0.345 to 0.485 m") as caught:
        servo(perturb(HOME, np.array([0, 0, 0, 0, 0, 0.2])))
    assert caught.value.what.endswith("leg 1")


def test_a_goal_that_a_lesser_machine_cannot_take_is_refused():
    machine = load_mechanism("3-rps")
    tilted = perturb(machine.home(), np.array([0, 0, 0, 0.03, 0.02, 0.0]))
    with raises(InputError, code="pose.not_admissible"):
        VisualServo(machine, None, BESIDE, tilted)


@pytest.mark.parametrize(
    ("option", "value", "code", "found"),
    [
        ("gain", 0.0, "servo.not_positive", "0.0"),
        ("tolerance", np.nan, "servo.not_positive", "nan"),
        ("rate_limits", -1.0, "servo.not_positive", str([-1.0] * 6)),
        ("law", "faces", "error.input", "faces"),
        ("legs", np.array([7]), "error.input", "legs 8"),
    ],
)
def test_options_that_cannot_be_are_refused(option, value, code, found):
    with raises(InputError, code=code, found=found) as caught:
        servo(**{option: value})
    assert option.replace("_", " ") in caught.value.what


def test_samples_that_cannot_be_are_refused():
    loop = servo()
    with raises(InputError, found="(3, 2, 3)"):
        loop.step_edges(edges()[:3], READINGS)
    with raises(InputError, found="length 2"):
        loop.step_edges(2 * edges(), READINGS)
    with raises(InputError, code="edges.sides_exchanged"):
        loop.step_edges(edges()[:, ::-1], READINGS)
    for readings in (READINGS[:5], READINGS * np.nan):
        with raises(InputError, found=str(readings.tolist()), expected="6 numbers, in m or rad"):
            loop.step_edges(edges(), readings)
    with raises(InputError, code="servo.no_camera"):
        loop.step_image(np.zeros((480, 640), np.uint8), READINGS)


# ------------------------------------------------------------------ images


@pytest.mark.parametrize("view", ["perspective", pytest.param("mirror", marks=pytest.mark.slow)])
def test_images_lead_to_the_goal_and_past_a_painted_leg(view):
    """Rendered images close the loop: in seven samples from 22 mm and 6 degrees to the accuracy of
    one image.

    A mirror image of that size has a third of the pixels per radian.
    """
    camera, T = (PERSPECTIVE, BESIDE) if view == "perspective" else (MIRROR, WITHIN)
    lab = Lab(MACHINE, camera, T)
    loop = VisualServo(MACHINE, camera, T, GOAL, gain=0.8)
    pose, readings = HOME, READINGS.copy()
    for k in range(7):
        image = lab.image(pose, readings)
        if k == 3:
            image = lab.painted(image, pose, readings, [0])
        step = loop.step_image(image, readings)
        assert step.status.moves, step.sentence
        assert k != 3 or not step.used[0]
        assert k == 3 or step.used.sum() >= 5
        readings = readings + step.joint_velocities
        pose = MACHINE.forward(readings[None], pose)[0]
    off = pose_difference(pose, GOAL)
    limit = 1 if view == "perspective" else 2
    assert np.linalg.norm(off[3:]) < limit * 0.8e-3
    assert np.rad2deg(np.linalg.norm(off[:3])) < limit * 0.25
    assert np.nanmax(np.abs(step.remaining) / step.sigma) < 5


def test_an_image_is_a_goal_and_a_wrong_start_is_stated():
    lab = Lab(MACHINE, PERSPECTIVE, BESIDE)
    image = lab.image(HOME, READINGS)
    loop = VisualServo(MACHINE, PERSPECTIVE, BESIDE, GoalImage(image, READINGS))
    step = loop.step_image(image, READINGS)
    assert np.abs(step.remaining).max() < 1e-9  # the same image
    assert step.converged
    loop.reset()
    elsewhere = perturb(HOME, np.array([0.1, 0.1, 0.3, 0.03, 0, 0.03]))
    step = loop.step_image(image, MACHINE.inverse(elsewhere[None])[0])
    assert stopped(step)
    assert step.status is Status.NOT_AT_READINGS
    assert "camera that was moved" in step.sentence
    step = loop.step_image(image, READINGS * [2, 1, 1, 0.2, 1, 1])
    assert step.status is Status.UNREACHABLE
    with raises(GeometryError, code="servo.goal_not_visible"):
        VisualServo(MACHINE, PERSPECTIVE, BESIDE, GoalImage(np.zeros_like(image), READINGS))
    with raises(GeometryError, code="readings.unreachable"):
        VisualServo(MACHINE, PERSPECTIVE, BESIDE, GoalImage(image, READINGS * [2, 1, 1, 0.2, 1, 1]))


# ------------------------------------------------------------------ a calibration on disk


def test_a_calibration_gives_machine_camera_and_place(demo):
    from pkmcal.calibration.saved_calibration import load

    saved = load(demo.calibration)
    goal = saved.T_base_platform[0]
    loop = VisualServo.from_calibration(demo.calibration, saved.stations[0].name, goal, gain=0.5)
    np.testing.assert_array_equal(loop.machine.values, saved.machine.values)
    there = saved.stations[0].T_base_camera
    np.testing.assert_allclose(inverse(loop.view.T_camera_base), there, atol=1e-12)
    assert loop._sight.edge_shift == saved.document["cameras"][0]["edge_shift"]
    assert loop._sight.binning == saved.document["stations"][0]["binning"]
    with raises(InputError, code="calibration.no_station", found="nowhere"):
        VisualServo.from_calibration(demo.calibration, "nowhere", goal)


def test_a_refused_calibration_does_not_control(demo, tmp_path):
    import json

    text = (demo.calibration / "calibration.json").read_text()
    document = json.loads(text)
    document["verdict"]["usable"] = False
    document["verdict"]["reasons"] = ["Too few images."]
    (tmp_path / "calibration.json").write_text(json.dumps(document))
    with raises(ResultError, code="calibration.refused") as caught:
        VisualServo.from_calibration(tmp_path, "station1", HOME)
    assert "Too few images." in caught.value.what
    (tmp_path / "calibration.json").write_text(text)
    with raises(InputError, code="camera.missing", found="station1"):
        VisualServo.from_calibration(tmp_path, "station1", HOME)
