"""The machine in space: configurations, cameras, change and uncertainty of joints, the stage."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pkmcal.cameras.frustum import frustum
from pkmcal.cameras.pinhole import Pinhole
from pkmcal.cameras.unified import Unified
from pkmcal.geometry.rigid import apply, inverse, perturb
from pkmcal.identify.centres import free_of_gauge, joint_centres
from pkmcal.mechanisms import load_mechanism
from pkmcal.outcome import Outcome, Verdict
from pkmcal.report import scene
from pkmcal.report.space import (
    ELLIPSOID_SIGMAS,
    MOST_ENLARGED_CHANGE,
    MOST_ENLARGED_ELLIPSOID,
    changes,
)
from pkmcal.report.workspace import section
from pkmcal.web.motion import Postures
from pkmcal.web.report_page import report_page
from pkmcal.web.stage import leg_lines
from test_report_case import RADIUS, Case, make_case
from test_show import DARK, FRAME, NO_GL, SOFTWARE, acting, browse
from test_tool_error import mapped

NO_TARGETS = np.zeros((0, 3)), np.zeros(0, dtype=int)
ROUNDED = 0.6e-4
"""Half of the last digit of points true to scale, m, along each of three axes."""


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> Case:
    return make_case(tmp_path_factory.mktemp("session"))


def centres_of(case: Case):
    machine = case.estimate.machine
    covariance = free_of_gauge(machine, case.estimate.covariance)
    return joint_centres(case.session.machine, machine, covariance)


def stage(case: Case, **options):
    part = scene.section(case.session, case.estimate, centres_of(case), NO_TARGETS, None, **options)
    return part.blocks[0]


def test_legs_are_where_the_kinematics_have_them(case):
    block = stage(case)
    machine, poses = case.estimate.machine, case.estimate.state.T_base_platform
    ends = machine.ends_at(case.session.joints, poses)
    a, b = (np.broadcast_to(x, ends.b.shape) for x in (ends.a, ends.b))
    assert [pose.label for pose in block.poses] == list(case.session.configurations)
    for k, pose in enumerate(block.poses):
        assert pose.key == f"configuration:c{k}"
        for leg, shape in enumerate(pose.configuration.legs):
            np.testing.assert_allclose(shape.base[-1], a[k, leg], atol=ROUNDED)
            np.testing.assert_allclose(shape.platform[-1], b[k, leg], atol=ROUNDED)
    for leg in block.machine.legs:
        assert [tube.radius for tube in leg.tubes] == pytest.approx(list(RADIUS.values()))
    assert [camera.name for camera in block.machine.cameras] == ["front0", "front1", "front2"]
    for camera, T in zip(block.machine.cameras, case.estimate.state.T_camera_base, strict=True):
        np.testing.assert_allclose(camera.position, inverse(T)[:3, 3], atol=1e-6)


def test_the_change_leads_back_to_the_nominal_model(case):
    """Of a rigid platform it is constant, so it is in the document once."""
    block, centres = stage(case), centres_of(case)
    (change,) = block.changes
    for side in centres:
        drawn = np.array([getattr(leg, side.side)[-1] for leg in change])
        np.testing.assert_allclose(drawn, side.change, atol=1e-8)
    assert 1 <= block.enlargement <= MOST_ENLARGED_CHANGE


def test_the_change_of_an_arm_turns_with_it():
    nominal = load_mechanism("h4")
    errors = 1e-3 * np.random.default_rng(0).normal(size=len(nominal.parameters))
    errors[nominal.parameters.of_kind("radius")] = 0
    machine = nominal.with_values(nominal.values + errors)
    poses = perturb(machine.home(), np.array([np.zeros(6), [0, 0, 0, 0.05, 0, 0.02]]))
    joints = machine.inverse(poses)
    covariance = 1e-10 * np.eye(len(errors))
    centres = joint_centres(nominal, machine, free_of_gauge(machine, covariance))
    made = changes(nominal, machine, Postures(joints, poses), centres)
    assert len(made) == 2
    base = centres[0].T_calibrated_nominal
    for k, own in enumerate(made):
        before = [apply(base, arm) for arm in nominal.arms_at(joints[k])]
        after = machine.arms_at(joints[k])
        for leg, (old, new) in enumerate(zip(before, after, strict=True)):
            np.testing.assert_allclose(own[leg].base, new - old, atol=1e-7)


def test_ellipsoids_are_the_covariance(case):
    block, centres = stage(case), centres_of(case)
    assert block.sigmas == ELLIPSOID_SIGMAS
    assert 1 <= block.ellipsoid_enlargement <= MOST_ENLARGED_ELLIPSOID
    for side in centres:
        own = [one for one in block.ellipsoids if one.side == side.side]
        assert [one.leg for one in own] == list(range(6))
        for one, expected in zip(own, side.blocks, strict=True):
            axes = np.array(one.axes)
            np.testing.assert_allclose(axes.T @ axes / ELLIPSOID_SIGMAS**2, expected, atol=3e-12)


def test_points_have_the_keys_of_their_configurations(case):
    used = np.array([True, False, True, True, True])
    estimate = replace(case.estimate, configurations=used)
    part = scene.section(case.session, estimate, centres_of(case), NO_TARGETS, None)
    (points,) = part.blocks[0].points
    assert points.keys == tuple(f"configuration:c{k}" for k in (0, 2, 3, 4))
    places = estimate.state.T_base_platform[used, :3, 3]
    np.testing.assert_allclose(points.points, places, atol=ROUNDED)


def test_many_poses_are_thinned_and_the_hint_has_their_number(case):
    part = scene.section(case.session, case.estimate, centres_of(case), NO_TARGETS, None, most=3)
    block, hint = part.blocks
    assert [pose.label for pose in block.poses] == ["c0", "c2", "c4"]
    assert "3 poses of 5" in hint.text
    assert len(block.points[0].points) == 5


def test_a_pose_takes_a_kilobyte(case):
    """45 of them are a hundredth of a report."""
    block = stage(case)
    sizes = [len(pose.model_dump_json()) for pose in block.poses]
    assert max(sizes) < 1500


def test_a_crank_is_drawn_with_its_arm():
    machine = load_mechanism("h4")
    pose = machine.home()[None]
    joints = machine.inverse(pose)
    still, turned = (leg_lines(machine, Postures(q, pose)) for q in (joints, joints + 0.1))
    ends = machine.ends_at(joints, pose)
    for leg, (before, after) in enumerate(zip(still, turned, strict=True)):
        (held, end), (other, away) = before.base[0], after.base[0]
        np.testing.assert_allclose(end, ends.a[0, leg])
        # the motor's axis stays, and the arm about it turns with the reading
        np.testing.assert_allclose(other, held, atol=1e-12)
        length = machine.document.legs[leg].base.arm
        assert np.linalg.norm(end - held) == pytest.approx(length)
        assert np.linalg.norm(away - end) == pytest.approx(2 * length * np.sin(0.05))
    hexapod = load_mechanism("gough-stewart")
    pose = hexapod.home()[None]
    lines = leg_lines(hexapod, Postures(hexapod.inverse(pose), pose))
    assert [leg.base.shape for leg in lines] == [(1, 1, 3)] * 6


def test_a_frustum_is_what_the_camera_sees():
    camera = Pinhole((320, 240), np.array([280.0, 281.0, 160.2, 119.1, -0.3, 0.05, 1e-3, 0, 0]))
    T_base_camera = perturb(np.eye(4), np.array([0.3, -0.2, 0.5, 1.0, 2.0, 3.0]))
    border, *rays = frustum(camera, T_base_camera, 0.5)
    inside = apply(inverse(T_base_camera), border)
    np.testing.assert_allclose(inside[:, 2], 0.5)
    pixel = camera.project(inside)
    on = np.isclose(pixel, -0.5, atol=1e-3) | np.isclose(pixel, [319.5, 239.5], atol=1e-3)
    assert on.any(axis=1).all()
    assert len(rays) == 4
    for ray in rays:
        np.testing.assert_allclose(ray[0], T_base_camera[:3, 3])


def test_a_mirrors_field_has_no_plane():
    camera = Unified((640, 480), np.array([200.0, 200.0, 319.5, 239.5, 1.0, 0, 0, 0, 0]))
    border, *_ = frustum(camera, np.eye(4), 0.5)
    np.testing.assert_allclose(np.linalg.norm(border, axis=1), 0.5)


# ------------------------------------------------------------------ in a browser

ACT = """
const faults = [];
addEventListener("error", (event) => { if (event.message) faults.push(event.message); });
document.addEventListener("securitypolicyviolation", (event) => {
  faults.push(`blocked ${event.blockedURI} ${event.violatedDirective}`);
});
const wait = (ms) => new Promise((done) => setTimeout(done, ms));
addEventListener("load", async () => {
  const out = document.documentElement.dataset, $ = (query) => document.querySelector(query);
  const canvas = $(".space-stage canvas");
  const drawn = async () => { await wait(1000); return canvas ? canvas.toDataURL() : ""; };
  const set = async (selector, value) => {
    const input = $(selector);
    if (!input) return "";
    input.value = value;
    input.dispatchEvent(new Event("input"));
    return drawn();
  };
  const first = await drawn();
  out.note = $(".space-block .note") !== null;
  if (canvas) {
    out.moved = first !== await set(".poses input", 1);
    out.label = $(".poses output").textContent;
    const before = await drawn();
    const space = new KeyboardEvent("keydown", { key: " ", bubbles: true });
    canvas.dispatchEvent(space);
    await wait(1500);
    out.morphed = before !== await drawn();
    const wheel = new WheelEvent("wheel", { deltaY: 100, bubbles: true, cancelable: true });
    canvas.dispatchEvent(wheel);
    out.scrolls = !wheel.defaultPrevented;
  }
  const bands = () => [...document.querySelectorAll(".map-band")]
    .map((one) => one.getAttribute("d")).join();
  const error = bands();
  document.querySelectorAll(".map-tabs input")[1].click();
  out.contours = bands() !== error && bands().length > 0;
  await set(".map-slice input", 0);
  out.level = $(".map-slice output").textContent;
  await set(".map-limit input", 1e6);
  out.share = $(".map-limit output").textContent;
  out.crosses = [...document.querySelectorAll(".map-pose")].map((one) => one.dataset.key).join();
  out.overhang = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  out.faults = faults.join("; ");
  out.done = "yes";
  parent.postMessage({ ...out }, "*");
});
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("width", "options"), [(1440, SOFTWARE), (390, (*SOFTWARE, DARK)), (390, NO_GL)]
)
def test_stage_and_map_in_a_browser(case, tmp_path, width, options):
    """The stage moves and morphs, the map has other contours in another tab; without WebGL a
    sentence stands in its place.
    """
    made = mapped("gough-stewart")
    session = SimpleNamespace(configurations=("c0", "c1", "c2", "c3", "c4"))
    parts = (
        scene.section(case.session, case.estimate, centres_of(case), NO_TARGETS, made),
        section(session, case.estimate, made),
    )
    outcome = Outcome("calibrate", "Title", Verdict(True, "It is fine"), parts=parts)
    (tmp_path / "page.html").write_text(acting(report_page(outcome), ACT), encoding="utf-8")
    (tmp_path / "frame.html").write_text(FRAME.replace("WIDTH", str(width)), encoding="utf-8")
    root = browse((tmp_path / "frame.html").as_uri(), tmp_path, 1500, *options)
    assert root["faults"] == ""
    assert root["overhang"] == "0"
    assert root["contours"] == "true"
    assert root["share"].startswith("100 %")
    assert root["level"] == f"z = {made.slices[0].level * 1e3:.0f} mm"
    assert root["note"] == ("true" if options is NO_GL else "false")
    if options is NO_GL:
        return
    assert [root[name] for name in ("moved", "morphed", "scrolls")] == ["true"] * 3
    assert root["label"] == "c1"
