"""The machine in space at its configurations: tubes, arms, cameras, and the slider's poses."""

from dataclasses import replace

import numpy as np
import pytest

from pkmcal.cameras.frustum import frustum
from pkmcal.cameras.pinhole import Pinhole
from pkmcal.cameras.unified import Unified
from pkmcal.geometry.rigid import apply, inverse, look_at, perturb
from pkmcal.identify.centres import joint_centres
from pkmcal.mechanisms import load_mechanism
from pkmcal.report import image_scene, pictures
from test_report_case import RADIUS, Case, calibration, make_case


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> Case:
    return make_case(tmp_path_factory.mktemp("session"))


def figure(case: Case, **options):
    centres = joint_centres(case.session.machine, case.estimate.machine, case.estimate.covariance)
    shifts = np.zeros(len(case.observation.edges))
    value = calibration(case.session, case.observation, case.estimate)
    album = pictures.album(value, shifts, centres)
    none = np.zeros((0, 3)), np.zeros(0, dtype=int)
    plot = image_scene.plot(case.session, case.estimate, album.links, none, **options)
    return album, plot


def points(trace) -> np.ndarray:
    return np.stack([np.asarray(trace[axis], dtype=float) for axis in "xyz"], axis=-1) * 1e-3


def test_tubes_lie_about_their_legs_in_every_pose(case):
    _, plot = figure(case)
    machine, poses = case.estimate.machine, case.estimate.state.T_base_platform
    limbs = image_scene.posed_limbs(machine, case.session.joints, poses)
    assert [frame["name"] for frame in plot.frames] == list(case.session.configurations)
    for k, frame in enumerate(plot.frames):
        for leg, trace in enumerate(frame["data"][:6]):
            a, b = limbs.a[k, leg], limbs.b[k, leg]
            u = (b - a) / np.linalg.norm(b - a)
            rings = points(trace).reshape(2, 2, image_scene.TUBE_RING_CORNERS, 3)
            along = (rings - a) @ u
            away = np.linalg.norm(rings - a - along[..., None] * u, axis=-1)
            for tube, drawn in enumerate(machine.document.legs[leg].tubes):
                np.testing.assert_allclose(away[tube], RADIUS[tube], atol=2e-4)  # tenths of a mm
                ends = np.minimum([drawn.start, drawn.stop], np.linalg.norm(b - a))
                np.testing.assert_allclose(along[tube], np.tile(ends[:, None], 10), atol=2e-4)


def test_a_crank_is_drawn_with_its_arm():
    machine = load_mechanism("h4")
    pose = machine.home()
    joints = machine.inverse(pose[None])
    limbs = image_scene.posed_limbs(machine, joints, pose[None])
    turned = image_scene.posed_limbs(machine, joints + 0.1, pose[None])
    for leg, arm in enumerate(limbs.arms):
        np.testing.assert_allclose(arm[0, -1], limbs.a[0, leg])
        # the motor's axis stays, and the arm about it turns with the reading
        held, end = arm[0]
        other, away = turned.arms[leg][0]
        np.testing.assert_allclose(other, held, atol=1e-12)
        length = machine.document.legs[leg].base.arm
        assert np.linalg.norm(end - held) == pytest.approx(length)
        assert np.linalg.norm(away - end) == pytest.approx(2 * length * np.sin(0.05))
    drawn = machine.arms_at(machine.middle_readings())
    assert [len(arm) for arm in drawn] == [2] * 4
    hexapod = load_mechanism("gough-stewart")
    assert [len(arm) for arm in hexapod.arms_at(hexapod.middle_readings())] == [1] * 6


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


def test_points_lead_to_images_that_are_on_the_page(case):
    album, plot = figure(case)
    poses = next(t for t in plot.figure["data"] if t["name"] == "measured poses")
    assert len(poses["customdata"]) == len(case.session.configurations)
    there = {f"#{picture.anchor}" for picture in album.pictures}
    for link, k in zip(poses["customdata"], range(5), strict=True):
        assert link in there
        assert link.endswith(f"-{k + 1}")


@pytest.mark.parametrize("scale", [1.0, 6.0])
def test_all_that_is_drawn_is_in_the_picture(case, scale):
    """By an independent look-at, at Plotly's angle of 45 degrees, in a square and in a wide view;
    and no smaller than needed. scale : of the cameras' distances.
    """
    estimate = case.estimate
    away = [T.copy() for T in estimate.state.T_camera_base]
    for T in away:
        T[:3, 3] *= scale
    state = replace(estimate.state, T_camera_base=np.stack(away))
    none = np.zeros((0, 3)), np.zeros(0, dtype=int)
    links = figure(case)[0].links
    plot = image_scene.plot(case.session, replace(estimate, state=state), links, none)
    drawn = np.concatenate([points(trace) for trace in plot.figure["data"]])
    drawn = drawn[np.isfinite(drawn).all(axis=1)]
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    unit = np.prod(1.0625 * (high - low)) ** (1 / 3)  # Plotly's, with its room about the data
    corners = ((drawn - (low + high) / 2) / unit).tolist()
    layout = plot.figure["layout"]
    parts = [(layout["meta"]["wide"], layout["scene"]["camera"]), (1.0, layout["meta"]["narrow"])]
    for width, camera in parts:
        eye, center = (
            np.array([camera[name][axis] for axis in "xyz"]) for name in ("eye", "center")
        )
        T = look_at(eye, center, np.array([0.0, 0.0, 1.0]))
        x, y, z = apply(T, np.array(corners)).T
        assert np.all(z > 0)
        half = np.tan(np.pi / 8) * z
        across, up = np.abs(x / half).max() / width, np.abs(y / half).max()
        assert max(across, up) < 0.8  # the names and numbers stand beside it
        assert max(across, up) > 0.35


def test_many_poses_are_thinned_and_that_is_stated(case):
    plot = figure(case, most=3)[1]
    assert [frame["name"] for frame in plot.frames] == ["c0", "c2", "c4"]
    assert "3 poses of 5, evenly chosen" in plot.caption
    assert [s["label"] for s in plot.figure["layout"]["sliders"][0]["steps"]] == ["c0", "c2", "c4"]
