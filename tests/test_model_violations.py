"""A wrong fact of a session is reported with its size, and nothing else is."""

from __future__ import annotations

import csv
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from conftest import FEW_IMPUTATIONS, run
from pkmcal import calibrate
from pkmcal.boards.poses import board_size_column, pose_set
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.calibration.camera_refinement import edges_by_camera
from pkmcal.calibration.localization import frozen_in
from pkmcal.calibration.saved_calibration import load
from pkmcal.calibration.tube_outlines import outlines
from pkmcal.geometry.rigid import perturb
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.bundle import bundle
from pkmcal.identify.covariance import Information
from pkmcal.identify.false_alarm import SESSION_FALSE_ALARM
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.score import ScoreTests, columns_of
from pkmcal.identify.start import start_state
from pkmcal.measurements import Column, EdgeSet, Measurements, Mount, concatenate
from pkmcal.mechanisms import load_mechanism
from pkmcal.outcome.finding import doubtful
from pkmcal.placement.configurations import draw_configurations
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.placement.edges import EdgeNoise, simulate_edges
from pkmcal.planning.subject import of_machine
from pkmcal.session.load import load_session
from pkmcal.session.station_movement import FEWEST_BESIDE_MOVEMENT
from pkmcal.wording import ratio_in_per_cent
from test_bad_input import only
from test_identify_scene import exact

NOISE = EdgeNoise(0.1, 0.1)


def measured(seed, *, scale=None, turned=None, play=None, machine=None, count=30):
    """Edges and readings of a hexapod, from one place, with a model violation; with exact readings'
    scales by default.
    """
    rng = np.random.default_rng(seed)
    nominal = machine or exact("gough-stewart")
    table = nominal.parameters
    true = nominal.with_values(
        table.nominal + table.free_matrix() @ (table.tolerances_free() * rng.standard_normal(
            table.free_matrix().shape[1]))
    )  # fmt: skip
    camera = camera_of_size((1280, 960))
    rig = of_machine(nominal, [camera, camera], nominal.joint_names, seed=seed).rig
    poses, _ = draw_configurations(true, count, 0.5, rng)
    poses = poses[:count]
    pairs = np.array([(s, k) for s in (0, 1) for k in range(count)])
    where = rig.T_station_base
    sets = []
    for part in (pairs[:, 1] < count // 2, pairs[:, 1] >= count // 2):
        T = where.copy()
        if turned is not None and part[-1]:
            T[0] = perturb(T[0], turned)
        edges, joints = simulate_edges(true, T, camera, poses, NOISE, rng, images=pairs[part])
        sets.append(edges)
    if scale:
        joints[:, scale[0]] /= 1 + scale[1]
    if play:
        direction = np.sign(np.diff(joints[:, play[0]], prepend=joints[0, play[0]]))
        joints[:, play[0]] -= play[1] / 2 * direction
    data = Measurements(concatenate(sets), joints, 3e-6, 2, np.zeros(2, dtype=int))
    return nominal, data, where


def score_tests(nominal, data, where, readings, shifted, families=None):
    """Score tests of an estimate of the data: by changes of the readings (K, m, 1), and of the
    first camera's place from the middle on.
    """
    estimate = bundle(nominal, data, start_state(nominal, data, where), scale_noise=False)
    assembled = assemble(estimate.machine, data, default_gauge(nominal))
    info = Information(assembled.problem, batch_of(estimate.machine, assembled, estimate.state))
    effects = [Column("readings.test", readings=by) for by in readings]
    if shifted:
        effects.append(Column("station.moved", station=0, since=len(data.joints) // 2))
    return estimate, ScoreTests(assembled, info, effects, families)


def scales(data):
    eye = np.eye(data.joints.shape[1])
    return [(data.joints * one)[..., None] for one in eye]


def plays(data):
    direction = np.sign(np.diff(data.joints, axis=0, prepend=data.joints[:1])) / 2
    return [(direction * one)[..., None] for one in np.eye(data.joints.shape[1])]


def test_the_scale_that_fits_is_found_and_its_gain_is_that_of_another_estimate():
    nominal, data, where = measured(1, scale=(2, 2e-3))
    estimate, tests = score_tests(nominal, data, where, scales(data), False)
    value = tests.significant()
    assert value[0][0] == 2
    fit = tests.fitted([2])[0]
    assert abs(fit.value[0] - 2e-3) < 4 * fit.sigma[0]
    assert fit.sigma[0] < 1e-3
    # an independent oracle: the readings put right by as much, and everything estimated again
    joints = data.joints.copy()
    joints[:, 2] *= 1 + fit.value[0]
    again = bundle(
        nominal, replace(data, joints=joints), start_state(nominal, data, where), scale_noise=False
    )
    gain = estimate.statistics.chi2 - again.statistics.chi2
    assert gain == pytest.approx(tests.scores()[2].chi2, rel=0.05)
    shifted = again.machine.values - estimate.machine.values
    offsets = nominal.parameters.of_kind("offset")
    np.testing.assert_allclose(
        shifted[offsets], fit.by_data[offsets], atol=0.1 * np.abs(shifted).max()
    )


def test_a_scale_beyond_its_tolerance_is_found_whole():
    """Freed beside its prior the violation leaves the parameter nominal, and is the only one."""
    nominal = load_mechanism("gough-stewart")
    nominal, data, where = measured(1, scale=(2, 1e-2), machine=nominal)
    estimate, tests = score_tests(nominal, data, where, scales(data), False)
    assert tests.significant()[0][0] == 2
    fit = tests.fitted([2])[0]
    row = nominal.parameters.index("legs[3].scale")
    present = estimate.machine.values[row]
    assert 2e-3 < present - 1 < 1e-2
    assert fit.by_data[row] == pytest.approx(1 - present, abs=1e-3)
    # beside the true machine's own scale, which is 0.05 % off
    assert abs(present * fit.value[0] - 1e-2) < 4 * np.hypot(fit.sigma[0], 5e-4)


def test_play_and_a_pushed_camera_are_distinguished_from_each_other():
    nominal, data, where = measured(2, play=(4, 4e-4))
    _, tests = score_tests(nominal, data, where, scales(data) + plays(data), True)
    assert [k for k, _ in tests.significant()] == [6 + 4]
    assert tests.fitted([10])[0].value[0] == pytest.approx(4e-4, rel=0.2)
    step = np.array([0.0, 0.0, 0.0, 6e-4, -5e-4, 4e-4])
    nominal, data, where = measured(3, turned=step)
    _, tests = score_tests(nominal, data, where, scales(data) + plays(data), True)
    assert [k for k, _ in tests.significant()] == [12]
    fit = tests.fitted([12])[0]
    off = fit.value - step
    assert np.all(np.abs(off) < 4 * fit.sigma + 0.05 * np.abs(step))


def test_two_violations_are_found_one_after_the_other():
    nominal, data, where = measured(4, scale=(0, 4e-3), play=(3, 5e-4))
    _, tests = score_tests(nominal, data, where, scales(data) + plays(data), True)
    assert {k for k, _ in tests.significant()} == {0, 6 + 3}
    one, other = tests.fitted([0, 9])
    assert one.value[0] == pytest.approx(4e-3, rel=0.3)
    assert other.value[0] == pytest.approx(5e-4, rel=0.3)


def test_nothing_is_found_twice():
    nominal, data, where = measured(7, scale=(1, 6e-3))
    _, tests = score_tests(nominal, data, where, scales(data)[1:3], False, [0, 1])
    results = [k for k, _ in tests.significant()]
    assert results[0] == 0
    assert len(results) == len(set(results))


def test_scores_are_those_of_the_whole_jacobian():
    """Against dense algebra, all columns of all rows at once; and in pieces as in one."""
    nominal, data, where = measured(8, scale=(1, 2e-3), count=14)
    estimate = bundle(nominal, data, start_state(nominal, data, where), scale_noise=False)
    assembled = assemble(estimate.machine, data, default_gauge(nominal))
    state, problem = batch_of(estimate.machine, assembled, estimate.state), assembled.problem
    effects = [Column("a", readings=scales(data)[1]), Column("b", station=1, since=5)]
    turns = np.stack([data.edges.shift, data.edges.normal[:, :2]], axis=-1)
    effects.append(Column("c", edges=turns))
    tests = ScoreTests(assembled, Information(problem, state), effects, [0, 1, 2], singles=True)
    own, m = problem.linearize(state), data.joints.shape[1]
    shared = own.by_shared[0]
    begin = problem.unknowns.stations.start + 6
    later = np.where((np.arange(14) >= 5)[:, None, None], shared[..., begin : begin + 6], 0.0)
    throughout = columns_of(assembled, state, [effects[0], effects[2]], singles=True)(
        slice(0, 14), own
    )
    single = np.einsum("krm,kl->krlm", throughout[..., 3:], np.eye(14)).reshape(
        *later.shape[:2], -1
    )
    extra = [throughout[..., :1], later, throughout[..., 1:3], single]
    extra = np.concatenate(extra, axis=-1).reshape(-1, 9 + 14 * m)
    both = np.zeros((14, shared.shape[1], 14, own.by_own.shape[-1]))
    both[np.arange(14), :, np.arange(14)] = own.by_own[0]
    whole = [shared.reshape(len(extra), -1), both.reshape(len(extra), -1)]
    J, r = np.concatenate(whole, axis=1), np.append(own.value[0].ravel(), own.shared_value[0])
    J = np.concatenate([J, np.pad(own.shared_by, ((0, 0), (0, J.shape[1] - shared.shape[-1])))])
    G = np.pad(extra, ((0, len(J) - len(extra)), (0, 0)))
    parts = [np.arange(1), np.arange(1, 7), np.arange(7, 9)]
    parts += [np.array([9 + k]) for k in range(14 * m)]

    def oracle(J, k):
        q = np.linalg.svd(J / np.maximum(np.linalg.norm(J, axis=0), 1e-30), full_matrices=False)[0]
        H = G[:, parts[k]] - q @ (q.T @ G[:, parts[k]])
        value = np.linalg.lstsq(H, -r, rcond=None)[0]
        return float(-value @ H.T @ r), value

    scores = tests.scores()
    assert len(scores) == len(parts)
    for k in [0, 1, 2, 3, 40, 70]:
        chi2, value = oracle(J, k)
        assert scores[k].chi2 == pytest.approx(chi2, rel=1e-5, abs=1e-6)
        np.testing.assert_allclose(tests.fitted([k])[0].value, value, rtol=1e-4, atol=1e-9)
    freed = [0, 1, 4]
    reference_values = np.concatenate([J, *(G[:, parts[k]] for k in freed)], axis=1)
    scores = tests.scores(freed)
    for k in [2, 3, 5, 40, 70]:
        assert scores[k].chi2 == pytest.approx(oracle(reference_values, k)[0], rel=1e-5, abs=1e-6)
    problem = replace(problem, rows_at_once=3 * problem.n_rows)
    assembled = replace(assembled, problem=problem)
    pieces = ScoreTests(assembled, Information(problem, state), effects, [0, 1, 2], singles=True)
    for one, other in zip(pieces.scores(freed), scores, strict=True):
        assert one.chi2 == pytest.approx(other.chi2, rel=1e-6, abs=1e-9)


def false_alarms(seeds):
    chances = []
    for seed in seeds:
        nominal, data, where = measured(seed, count=16)
        _, tests = score_tests(nominal, data, where, scales(data) + plays(data), True)
        chances.append([score.chance for score in tests.scores()])
    return np.array(chances)


def test_right_sessions_have_chances_like_dice():
    chances = false_alarms(range(100, 108))
    assert chances.min() > SESSION_FALSE_ALARM.level / chances.shape[1] / 10
    assert abs(chances.mean() - 0.5) < 4 * 0.289 / np.sqrt(chances.size / 2)


def test_errors_of_whole_configurations_are_no_violation():
    """Random errors of one reading, far larger than its noise, along a scale's column: without the
    scatter over configurations in the test, a scale would be reported.
    """
    named = np.zeros(2, dtype=int)
    for seed in range(4):
        nominal, data, where = measured(40 + seed, count=20)
        wrong = data.joints.copy()
        off = np.random.default_rng(seed).normal(0, 5e-3, len(wrong))
        wrong[:, 2] *= 1 + off
        data = replace(data, joints=wrong)
        _, tests = score_tests(nominal, data, where, scales(data)[2:3], False)
        named += (
            tests.scores()[0].adjusted < SESSION_FALSE_ALARM.level,
            len(tests.significant()),
        )
        assert tests.fitted([0])[0].sigma[0] > 3e-4  # 5e-3 of twenty, as far as edges see it
    assert named[0] >= 2
    assert named[1] == 0


@pytest.mark.slow
def test_right_sessions_have_chances_like_dice_often():
    chances = false_alarms(range(500))
    count = chances.shape[1]
    alarms = np.mean(chances.min(axis=1) < SESSION_FALSE_ALARM.level / count)
    assert alarms < 0.015
    assert abs(np.mean(chances < 0.1) - 0.1) < 0.02


def test_what_no_data_see_is_not_tested():
    nominal, data, where = measured(5, count=12)
    nothing = np.zeros((*data.joints.shape, 1))
    # a common error is its offset, an unknown that only the nominal model determines better
    offset = nothing.copy()
    offset[:, 1] = 1.0
    _, tests = score_tests(nominal, data, where, [nothing, offset], False)
    assert [score.dof for score in tests.scores()] == [0, 1]
    assert tests.significant() == []
    none, some = tests.fitted([0, 1])
    assert none.sigma[0] == np.inf
    offsets = np.flatnonzero(nominal.parameters.of_kind("offset"))
    assert some.sigma[0] > nominal.parameters.tolerance[offsets[1]]


def test_what_is_seen_beside_what_is_not_keeps_its_deviation():
    nominal, data, where = measured(6, scale=(1, 5e-3))
    nothing = np.zeros((*data.joints.shape, 1))
    six = np.concatenate([plays(data)[0], nothing], axis=-1)  # two numbers, of which one is seen
    _, tests = score_tests(nominal, data, where, [scales(data)[1], six], False)
    alone, beside = tests.fitted([0])[0], tests.fitted([0, 1])
    np.testing.assert_allclose(beside[0].value, alone.value, rtol=0.2)
    assert np.isfinite(beside[0].sigma).all()
    assert np.isfinite(beside[1].sigma).tolist() == [True, False]


def test_a_ratio_without_a_deviation_is_reported_roughly():
    assert ratio_in_per_cent(-0.0042, np.inf) == "some 0.4 %"
    assert ratio_in_per_cent(0.00952, 0.0011) == "0.95 ± 0.11 %"


def test_boards_of_another_size_show_where_readings_give_the_scale():
    machine = load_mechanism("delta")
    rng = np.random.default_rng(3)
    poses, _ = draw_configurations(machine, 24, 0.5, rng)
    poses = poses[:24]
    camera = np.array([[1, 0, 0, 0.05], [0, -1, 0, 0.02], [0, 0, -1, 0.9], [0, 0, 0, 1.0]])
    in_view = perturb(camera @ poses, 2e-5 * rng.standard_normal((24, 6)))
    in_view[:, :3, 3] *= 1 / 1.004
    covariance = np.tile(np.eye(6) * 4e-10, (24, 1, 1))
    boards = pose_set(0, np.arange(24), 0, in_view, covariance)
    joints = machine.inverse(poses)
    mounts = (Mount("board", "platform"),)
    data = Measurements(
        EdgeSet.empty(), joints, 1e-5, 1, np.zeros(1, dtype=int), poses=boards, mounts=mounts
    )
    start = replace(start_state(machine, data, camera[None]), T_mount=np.eye(4)[None])
    estimate = bundle(machine, data, start, scale_noise=False)
    assembled = assemble(estimate.machine, data, default_gauge(machine))
    info = Information(assembled.problem, batch_of(estimate.machine, assembled, estimate.state))
    one = board_size_column(boards, 0, "board.yaml")
    fit = ScoreTests(assembled, info, [one]).fitted([0])[0]
    assert abs(fit.value[0] - 0.004) < 4 * fit.sigma[0] + 2e-4


def outlined(seed, lines_off):
    """Findings on tubes whose edges are moved by {(leg, tube, station, side): px} outward, and that
    shift in mm, median of all.
    """
    nominal, data, where = measured(seed, count=20)
    edges = data.edges
    turn, away = np.zeros((len(edges), 2)), np.zeros(0)
    for (leg, tube, station, side), px in lines_off.items():
        mine = (edges.leg == leg) & (edges.tube == tube)
        mine &= (edges.station == station) & (edges.side == side)
        assert mine.sum() > 5
        turn[mine] = px * edges.shift[mine]
        T = where[station] @ load_mechanism("gough-stewart").home()
        away = np.append(away, np.linalg.norm(turn[mine], axis=1) * np.linalg.norm(T[:3, 3]))
    normal = edges.normal + (edges.basis @ turn[..., None])[..., 0]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    turned = edges.basis - normal[..., None] * (normal[:, None] @ edges.basis)  # bases follow
    basis, by = np.linalg.qr(turned)
    basis = basis * np.sign(np.einsum("nii->ni", by))[:, None]
    data = replace(data, edges=replace(edges, normal=normal, basis=basis), shaded=True)
    estimate = bundle(nominal, data, start_state(nominal, data, where))
    session = SimpleNamespace(
        machine=nominal, station_names=("one", "two"), document={"mechanism": "mechanism.yaml"}
    )
    values = list(outlines(session, data, estimate))
    return values, 1e3 * np.median(away) if away.size else 0.0


def test_a_tube_that_is_thicker_is_named():
    off = {(2, 0, s, side): 3.0 for s in (0, 1) for side in (0, 1)}
    (value,), thicker = outlined(11, off)
    one = value.column
    assert (one.code, one.subject) == ("tube.radius", "legs[3].tubes[1]")
    assert value.value == pytest.approx(1e-3 * thicker, rel=0.15)
    facts = one.facts(np.array([0.0015]), np.array([0.0001]))
    assert (facts["leg"], facts["tube"], facts["value"]) == (3, 1, 0.0015)
    text = doubtful("tube.radius", **facts, tool_shift=1e-4, tool_shift_sigmas=0.5).text
    assert "Tube 1 of leg 3 is 1.5 mm thicker in radius than mechanism.yaml states" in text
    assert "correct legs[3].tubes[1].radius" in text


def test_an_edge_that_is_off_alone_is_named_with_its_station():
    (value,), _ = outlined(12, {(4, 0, 1, 0): -4.0})
    one = value.column
    assert value.value < -5 * value.sigma
    assert (one.code, one.subject) == ("tube.edge", "legs[5].tubes[1], two")
    facts = one.facts(np.array([-0.002]), np.array([0.0001]))
    assert (facts["leg"], facts["tube"], facts["station"]) == (5, 1, "two")


def test_right_tubes_are_not_named():
    assert [outlined(seed, {})[0] for seed in (13, 14)] == [[], []]


# ------------------------------------------------------------------ on images


@pytest.mark.slow
def test_a_sleeve_is_named_and_harms_little(session):
    path = session / "mechanism.yaml"
    document = yaml.safe_load(path.read_text())
    document["legs"][1]["tubes"][0]["radius"] -= 0.002
    path.write_text(yaml.safe_dump(document))
    value = calibrate(session)
    (one,) = value.violations
    assert (one.code, one.of) == ("tube.radius", "legs[2].tubes[1]")
    assert abs(one.value[0] - 2e-3) < 4 * one.sigma[0]
    assert one.value[0] > 1e-3
    assert not one.against


def scaled_readings(folder, column, factor):
    path = folder / "joints.csv"
    head, *rows = list(csv.reader(path.read_text().splitlines()))
    for row in rows:
        row[column] = repr(float(row[column]) * factor)
    path.write_text("\n".join(",".join(row) for row in [head, *rows]) + "\n")


@pytest.mark.slow
def test_an_encoder_of_another_scale_is_named_and_the_result_refused(session, tmp_path):
    scaled_readings(session, 4, 1 / 1.02)
    out = tmp_path / "out"
    result = run("calibrate", str(session), "-o", str(out))
    values = " ".join((result.out + result.err).split())
    assert result.code == 1
    assert "The readings of leg4 have another scale" in values
    assert "Multiply this column of joints.csv by 1.0" in values
    (value,) = load(out).document["departures"]
    assert (value["code"], value["kind"]) == ("readings.scale", "reading scale")
    assert value["value"][0] == pytest.approx(0.02, rel=0.25)
    assert value["moves_tool_in_sigmas"] > 1


@pytest.mark.slow
def test_another_camera_is_named(session):
    path = session / "cameras" / "camera.yaml"
    document = yaml.safe_load(path.read_text())
    document["focal"] = [1.03 * f for f in document["focal"]]
    path.write_text(yaml.safe_dump(document))
    value = calibrate(session)
    (one,) = value.violations
    assert (one.code, one.of) == ("camera.focal", "cameras/camera.yaml")
    assert one.value[0] == pytest.approx(-0.03, rel=0.3)
    assert "--refine-camera" in one.finding.next_step
    assert one.finding in value.verdict.of("camera.focal")


def test_one_wrong_reading_is_named_with_its_configuration(session):
    only(session, "station1", "station2")
    path = session / "joints.csv"
    lines = path.read_text().splitlines()
    cells = lines[6].split(",")
    cells[3] = repr(float(cells[3]) + 0.004)
    lines[6] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")
    value = calibrate_session(session, options=FEW_IMPUTATIONS)
    (one,) = value.violations
    assert (one.code, one.of) == ("readings.single", f"leg3, {cells[0]}")
    assert one.value[0] == pytest.approx(-0.004, rel=0.3)
    facts = one.finding.facts
    assert (facts["column"], facts["configuration"]) == ("leg3", cells[0])
    assert facts["value"] < 0


@pytest.mark.slow
def test_a_frozen_reading_is_named(session):
    path = session / "joints.csv"
    head, *rows = list(csv.reader(path.read_text().splitlines()))
    for row in rows:
        row[2] = rows[0][2]
    path.write_text("\n".join(",".join(row) for row in [head, *rows]) + "\n")
    result = run("calibrate", str(session))
    values = " ".join((result.out + result.err).split())
    assert result.code == 2
    assert "joints.csv, column leg2: the readings of leg2 are frozen" in values
    assert f"in all {len(rows)} configurations" in values


def test_readings_that_never_change_are_frozen(demo):
    """The findings of calibrate on a session whose data fit nothing: the test above."""
    session = load_session(demo.session)
    assert frozen_in(session) is None
    joints = session.joints.copy()
    joints[:, 1] = joints[0, 1]
    error = frozen_in(replace(session, joints=joints))
    assert error is not None
    assert "the readings of leg2 are frozen" in error.what


def test_a_right_session_names_nothing(calibrated):
    assert calibrated.violations == ()
    assert len(calibrated.session.stations[0].images) < 2 * FEWEST_BESIDE_MOVEMENT


def test_edges_answer_to_their_cameras_parameters(calibrated):
    """Against finite differences: the plane through an edge's pixels, by another camera."""
    observation = calibrated.observation
    cameras = [station.camera for station in calibrated.session.stations]
    by = edges_by_camera(observation, cameras)
    step = 1e-4 * np.array([100, 100, 100, 100, 1, 1, 1, 1, 1])
    for p in (0, 3, 4):
        shifted = []
        for sign in (1, -1):
            change = sign * step[p] * np.eye(9)[p]
            other = [replace(c, parameters=c.parameters + change) for c in cameras]
            shifted.append([plane(observation, other, k) for k in (0, 50, 200)])
        for row, ahead, behind in zip((0, 50, 200), *shifted, strict=True):
            turn = observation.edges.basis[row].T @ (ahead - behind) / (2 * step[p])
            np.testing.assert_allclose(
                by[row, :, p], turn, rtol=0.02, atol=2e-2 * np.abs(turn).max()
            )


def plane(observation, cameras, k):
    """Normal of the plane through the rays of an edge's pixels."""
    pixels = observation.points[observation.point_edge == k]
    rays = cameras[observation.edges.station[k]].ray(pixels)
    normal = np.linalg.svd(rays)[2][-1]
    return normal * np.sign(normal @ observation.edges.normal[k])
