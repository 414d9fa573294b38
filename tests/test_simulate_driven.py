"""Images of machines with cranks, guides and side bars, and their localization."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.distance import cdist

import pkmcal
from conftest import run
from faults import raises
from pkmcal.errors import InputError
from pkmcal.files import parse_yaml, validated_document
from pkmcal.geometry.rigid import apply, inverse
from pkmcal.judge.against_truth import compare_with_truth
from pkmcal.mechanisms import MechanismDocument, checked_machine, load_mechanism, mechanism_text
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.mechanisms.drives import drives_of, reaches, side_bars
from pkmcal.observe.profiles import PROFILE_OPTIONS, Profiles, estimate_blur
from pkmcal.placement.configurations import FARTHEST_TURN, draw_configurations, platform_unfolded
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.simulation import (
    Settings,
    board_for,
    draw_truth,
    load_truth,
    simulate_session,
    with_forearms,
)
from pkmcal.simulation.board import board_from_fields
from pkmcal.simulation.scene import Finish, discs_of, machine_parts
from pkmcal.simulation.shapes import Cylinder
from pkmcal.simulation.surfaces import SmoothNoise
from rendered import rendered
from test_catalogue import whitened

NAMES = ("h4", "delta", "6-rus", "linear-delta", "hexaglide")
CRANKS = NAMES[:3]
SMALL = camera_of_size((320, 240))


@pytest.fixture(params=NAMES, scope="module")
def machine(request):
    return with_forearms(load_mechanism(request.param))


@pytest.fixture(scope="module")
def h4():
    return with_forearms(load_mechanism("h4"))


def parts_of(machine, T, joints):
    finish = Finish.from_noise(SmoothNoise.from_rng(np.random.default_rng(0)))
    return machine_parts(machine, discs_of(machine), finish, T, joints)


def first_hits(parts, origin, targets):
    """Distances to the first part, and its number, along rays to targets (n, 3)."""
    rays = (targets - origin).T
    rays = rays / np.linalg.norm(rays, axis=0)
    hits = np.array([part.shape.enter(origin[:, None], rays) for part in parts])
    return hits.min(axis=0), hits.argmin(axis=0)


# nominal models


def test_rods_without_cylinders_get_one(machine):
    nominal = load_mechanism(machine.name)
    assert not any(leg.tubes for leg in nominal.document.legs)
    length = machine.document.legs[0].length.constant
    for leg in machine.document.legs:
        (tube,) = leg.tubes
        assert 0 < tube.start < 0.1 * length
        assert 0.9 * length < tube.stop < length
        assert tube.radius == pytest.approx(0.02 * length, abs=0.00026)
    assert machine.layout.motion.shape == nominal.layout.motion.shape
    assert len(machine.parameters) == len(nominal.parameters) + machine.n_legs
    assert with_forearms(machine) is machine


def test_a_cylinder_that_is_drawn_stays():
    gough = load_mechanism("gough-stewart")
    assert with_forearms(gough) is gough


def cables(side=0.08):
    """Eight crossed cables; side : x of the platform's lower joints, m."""
    signs = [(x, y) for x in (1, -1) for y in (1, -1)]
    legs = [
        {
            "base": {"joint": "spherical", "center": [5 * x, 3 * y, -2 * z]},
            "platform": {"joint": "spherical", "center": [half * x, 0.4 * y, 0.2 * z]},
            "length": {"actuated": True, "range": [3, 9]},
        }
        for z, half in ((1, side), (-1, 0.05))
        for x, y in signs
    ]
    text = yaml.safe_dump(
        {"name": "cables", "motion": "spatial", "legs": legs, "home": {"position": [0, 0, 0]}}
    )
    document = parse_yaml(text, Path("cables.yaml"))
    return checked_machine(validated_document(document, MechanismDocument), document)


def test_rods_of_crossed_cables_are_thin():
    machine = with_forearms(cables())
    radius = machine.radii()[0][0]
    home = machine.home()
    ends = machine.ends_at(machine.inverse(home[None])[0], home)
    along = np.linspace(0, 1, 2001)[:, None]
    first, second = (ends.a[j] + along * (ends.b[j] - ends.a[j]) for j in (0, 4))
    assert 0.001 < radius < cdist(first, second).min() / 4 + 1e-9
    poses, _ = draw_configurations(machine, 20, 0.3, np.random.default_rng(0))
    assert len(poses) >= 20


def test_rods_that_cross_at_home_are_refused():
    with pytest.raises(InputError) as refused:
        with_forearms(cables(side=0.05))
    assert refused.value.code == "mechanism.legs_touch"
    assert "legs 1 and 5" in refused.value.found


# where motors are


@pytest.mark.parametrize("name", CRANKS)
def test_a_cranks_axis_is_where_its_arm_turns_about(name):
    machine = with_forearms(load_mechanism(name))
    drives = drives_of(machine)
    assert drives.arms.all()
    for q in (-0.4, 0.9):
        a = limb_ends(machine.layout, machine.values, np.full(machine.n_joints, q), np.eye(4)).a
        arm = a - drives.foot
        np.testing.assert_allclose(np.linalg.norm(arm, axis=1), drives.arm, atol=1e-12)
        np.testing.assert_allclose(np.sum(arm * drives.axis, axis=1), 0, atol=1e-12)
    rows = [leg.base.arm for leg in machine.document.legs]
    np.testing.assert_allclose(drives.arm, rows, atol=1e-12)
    np.testing.assert_allclose(np.abs(np.sum(drives.axis * machine.base_axes(), axis=1)), 1)


@pytest.mark.parametrize("name", ["linear-delta", "hexaglide"])
def test_guides_reach_as_far_as_their_carriages(name):
    machine = with_forearms(load_mechanism(name))
    drives = drives_of(machine)
    assert drives.guides.all()
    assert drives.upright.all() == (name == "linear-delta")
    for share in (0, 1):
        readings = machine.joint_ranges[:, share]
        a = limb_ends(machine.layout, machine.values, readings, np.eye(4)).a
        np.testing.assert_allclose(drives.ends[:, share], a, atol=1e-12)
    np.testing.assert_allclose(np.sum(drives.away * drives.axis, axis=1), 0, atol=1e-12)
    # the platform, at home and at either stop, is before the guides and not behind
    b = reaches(machine)[1].reshape(-1, 3)
    assert np.all(np.einsum("lni,li->ln", b[None] - drives.foot[:, None], drives.away) < 0)


def test_guides_of_a_file_without_ranges(tmp_path):
    document = load_mechanism("linear-delta").to_document()
    for leg in document["legs"]:
        del leg["base"]["range"]
    (tmp_path / "m.yaml").write_text(yaml.safe_dump(document))
    machine = load_mechanism(tmp_path / "m.yaml")
    drives = drives_of(machine)
    home = machine.inverse(machine.home()[None])[0]
    np.testing.assert_allclose(drives.foot[:, 2], home, atol=1e-9)
    assert np.all(np.ptp(drives.ends[:, :, 2], axis=1) > 0.1)


def test_only_machines_with_side_bars_have_them(machine):
    bars = [legs.tolist() for legs in side_bars(machine)]
    assert bars == ([[0, 3], [1, 2]] if machine.name == "h4" else [])


# the scene


def test_forearms_are_drawn_from_arm_to_platform(machine):
    T = machine.home()
    joints = machine.inverse(T[None])[0]
    ends = limb_ends(machine.layout, machine.values, joints, T)
    cylinders = [p.shape for p in parts_of(machine, T, joints) if isinstance(p.shape, Cylinder)]
    for j, leg in enumerate(machine.document.legs):
        u = (ends.b[j] - ends.a[j]) / np.linalg.norm(ends.b[j] - ends.a[j])
        (tube,) = (
            c for c in cylinders
            if abs(c.axis @ u) > 1 - 1e-12
            and np.linalg.norm(c.start - ends.a[j] - leg.tubes[0].start * u) < 1e-9
        )  # fmt: skip
        assert tube.radius == leg.tubes[0].radius
        assert tube.length == pytest.approx(leg.tubes[0].stop - leg.tubes[0].start)


def test_little_of_a_machine_hides_its_own_forearms(machine):
    """From the default station, on average over its images."""
    truth = draw_truth(machine, (SMALL,), Settings(stations=1, configurations=6), 0)
    eye = inverse(truth.T_camera_base[0])[:3, 3]
    shares = []
    for T, joints in zip(truth.T_base_platform, truth.joints, strict=True):
        parts = parts_of(truth.machine, T, joints)
        ends = limb_ends(machine.layout, truth.machine.values, joints, T)
        s = np.linspace(0.1, 0.9, 20)[:, None, None]
        axis = (ends.a + s * (ends.b - ends.a)).reshape(-1, 3)
        near, _ = first_hits(parts, eye, axis)
        wide = max(r.max() for r in machine.radii())
        # the first hit is the forearm's own skin, a radius before its axis, more on a slant
        shares.append(np.mean(near > np.linalg.norm(axis - eye, axis=1) - 6 * wide))
    assert np.mean(shares) > 0.7


def test_an_arm_is_as_long_as_the_nominal_model_states(h4):
    T = h4.home()
    for q in (0.2, 0.9):
        parts = parts_of(h4, T, np.full(4, q))
        drives = drives_of(h4)
        a = limb_ends(h4.layout, h4.values, np.full(4, q), T).a
        middle = (a[0] + drives.foot[0]) / 2
        above = middle + np.array([1e-4, 2e-4, 0.2])
        near, which = first_hits(parts, above, middle[None])
        # the arm's web is less than a forearm thick on either side
        assert abs(near[0] - 0.2) < 0.03
        assert parts[which[0]].shape.half[0] == pytest.approx(0.13, abs=1e-9)


# what is drawn of a session


def test_platforms_with_side_bars_do_not_fold(h4):
    turns = np.deg2rad([0.0, 60.0, -60.0, 80.0, 140.0])
    T = np.broadcast_to(np.eye(4), (5, 4, 4)).copy()
    T[:, 0, 0] = T[:, 1, 1] = np.cos(turns)
    T[:, 1, 0], T[:, 0, 1] = np.sin(turns), -np.sin(turns)
    assert platform_unfolded(h4, T).tolist() == [True, True, True, False, False]
    assert platform_unfolded(load_mechanism("gough-stewart"), T).all()
    truth = draw_truth(h4, (SMALL,), Settings(stations=1, configurations=20), 1)
    for machine in (h4, truth.machine):  # as it is, and as its controller models it
        poses = machine.forward(truth.joints)
        turn = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
        assert np.abs(turn).max() < FARTHEST_TURN * machine.most_turn[0]


def test_the_nominal_model_takes_the_readings(machine):
    truth = draw_truth(machine, (SMALL,), Settings(stations=1, configurations=20), 2)
    assert machine.forward_result(truth.joints).converged.all()
    assert np.isfinite(truth.joints).all()


def test_all_stations_see_the_board_on_the_platform(h4):
    board = board_for(h4, "platform")
    settings = Settings(stations=2, configurations=4, shared=True, board=board, board_on="platform")
    truth = draw_truth(h4, (SMALL,) * 2, settings, 0)
    eyes = inverse(truth.T_camera_base)[:, :3, 3]
    places = truth.T_base_platform @ truth.T_platform_board
    for eye in eyes:
        into = apply(inverse(places), eye)[:, 2]
        assert np.mean(into < 0) > 0.7  # the printed side


@pytest.mark.parametrize("name", ["3-rpr", "four-belt"])
def test_the_board_of_a_planar_machine_stands_above_its_joints(name):
    machine = with_forearms(load_mechanism(name))
    board = board_for(machine, "platform")
    settings = Settings(stations=1, configurations=4, board=board, board_on="platform")
    truth = draw_truth(machine, (SMALL,), settings, 0)
    places = truth.T_base_platform @ truth.T_platform_board
    values = machine.values
    ends = [
        limb_ends(machine.layout, values, *at).b
        for at in zip(truth.joints, truth.T_base_platform, strict=True)
    ]
    joints = apply(truth.T_base_platform[:, None], np.array(ends))[..., 2]
    assert apply(places[:, None], board.points)[..., 2].min() > joints.max()
    eye = inverse(truth.T_camera_base)[0, :3, 3]
    assert np.all(apply(inverse(places), eye)[:, 2] < 0)  # the printed side


def test_hinges_of_side_bars_cannot_be_drawn(tmp_path):
    with raises(InputError, expected="platform joints other than hinged-bar"):
        simulate_session(tmp_path / "s", with_forearms(load_mechanism("h4-rods")), SMALL)


# by the command


def test_the_command_writes_cylinders_into_the_sessions_nominal_model(tmp_path):
    done = run(
        "simulate", tmp_path / "s", "--machine", "h4", "--stations", "1", "--configurations", "2",
        "--size", "96x72",
    )  # fmt: skip
    assert done.code == 0
    assert "gives its rods no visible cylinders" in " ".join(done.out.split())
    document = yaml.safe_load((tmp_path / "s" / "mechanism.yaml").read_text())
    assert all(len(leg["tubes"]) == 1 for leg in document["legs"])
    table = (tmp_path / "s" / "joints.csv").read_text()
    assert table.startswith("configuration,leg1,leg2,leg3,leg4\n")


# in images


def imaged(folder, name, camera, configurations, board, seed):
    settings = Settings(
        stations=1, configurations=configurations, joint_noise=1e-5, board=board,
        board_on="platform",
    )  # fmt: skip
    nominal = with_forearms(load_mechanism(name))
    return rendered(folder, nominal, camera, settings, seed)


def observing(folder, words):
    path = folder / "session.yaml"
    document = yaml.safe_load(path.read_text())
    document["stations"]["station1"]["observe"] = words
    path.write_text(yaml.safe_dump(document))
    return folder


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """An H4 whose forearms and board one camera sees; few images, and small ones."""
    fields = {"type": "charuco", "squares": [5, 4], "square": 0.065, "marker": 0.05,
              "dictionary": "DICT_4X4_50"}  # fmt: skip
    folder = tmp_path_factory.mktemp("mixed") / "session"
    camera = camera_of_size((560, 420))
    return imaged(folder, "h4", camera, 8, board_from_fields(fields), 1)


@pytest.mark.slow
def test_forearms_and_board_in_images(mixed):
    value = pkmcal.calibrate(observing(mixed, ["legs", "board"]))
    errors = compare_with_truth(value, mixed)
    assert value.verdict.usable
    assert value.estimate.statistics.n_poses >= 6 * 2
    assert len(value.observation.edges) > 40
    assert errors.calibrated.position < errors.drawing.position / 10
    assert errors.calibrated.orientation < errors.drawing.orientation / 10


@pytest.mark.slow
def test_forearms_alone_in_images(mixed):
    value = pkmcal.calibrate(observing(mixed, "legs"))
    errors = compare_with_truth(value, mixed)
    assert value.estimate.statistics.n_poses == 0
    assert errors.calibrated.position < errors.drawing.position / 5


@pytest.mark.slow
def test_the_board_states_where_the_camera_stands(mixed):
    """With it, no pose by hand is needed to find the forearms."""
    path = observing(mixed, ["legs", "board"]) / "session.yaml"
    text = path.read_text()
    document = yaml.safe_load(text)
    del document["stations"]["station1"]["pose"]
    path.write_text(yaml.safe_dump(document))
    edges = pkmcal.calibrate(mixed).observation.edges
    path.write_text(text)
    assert len(edges) > 40


def test_a_few_odd_profiles_do_not_decide_the_blur():
    """Few profiles of slim legs are complete; a highlight on these does not affect the rest."""
    from test_profiles import make

    slim, wide = make(6, 300, blur=0.7).profiles, make(7, 5, blur=0.7).profiles
    step = np.where(PROFILE_OPTIONS.profile_offsets < 0, 200.0, 20.0)
    sharp = replace(wide, grey=np.broadcast_to(step, wide.grey.shape))
    cut = np.r_[np.full(5, 0), np.full(len(slim.grey), 1)]
    both = Profiles(
        np.concatenate([sharp.grey, slim.grey]),
        np.concatenate([sharp.count, slim.count]),
        np.concatenate([sharp.half_width, slim.half_width]),
        cut,
        *np.zeros((2, len(cut)), dtype=int),
        np.zeros(len(cut), dtype=bool),
    )
    assert estimate_blur(both) == pytest.approx(0.7, abs=0.06)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_legs_and_board_know_more_than_each(name, tmp_path):
    """Twenty images, 800x600, one place: errors as stated, and least together.

    Platform at the readings, mm, by legs, board and both: h4 0.07, 0.18, 0.04; delta 0.19, 0.14,
    0.03; linear-delta 0.06, 0.08, 0.04; 6-rus 0.22, 0.58, 0.04; hexaglide 0.64, 0.83, 0.47.
    """
    board = board_for(with_forearms(load_mechanism(name)), "platform")
    camera = camera_of_size((800, 600))
    folder = imaged(tmp_path / "s", name, camera, 20, board, 1)
    sigma = []
    for words in ("legs", "board", ["legs", "board"]):
        value = pkmcal.calibrate(observing(folder, words))
        nominal = value.session.machine
        z = whitened(nominal, value.estimate, load_truth(folder, nominal))
        assert np.sqrt(np.mean(z**2)) < 1.3
        errors = compare_with_truth(value, folder)
        assert errors.calibrated.position < errors.drawing.position
        sigma.append(np.sqrt(np.diag(value.estimate.covariance)))
    kinematic = np.array(nominal.parameters.kinds) != "radius"
    legs, board, both = (np.median(s[kinematic & (s > 1e-9)]) for s in sigma)
    assert both < min(legs, board)
    assert errors.calibrated.position < errors.drawing.position / 3


def test_a_home_that_a_limb_does_not_reach_is_reported_with_its_file(tmp_path):
    text = mechanism_text(load_mechanism("6-rus"))
    path = tmp_path / "short.yaml"
    path.write_text(re.sub(r"constant: [\d.]+", "constant: 0.01", text, count=1))
    result = run("simulate", str(tmp_path / "out"), "--machine", str(path), "--size", "64x64")
    values = " ".join((result.out + result.err).split())
    assert result.code == 2
    assert "short.yaml: mechanism '6-rus' cannot take its home pose: joint 1 cannot reach" in values
    assert not (tmp_path / "out").exists()
