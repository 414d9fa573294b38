"""Validation: right calibrations, detected changes, paths, hold-outs, and refusals."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import chdtr

from conftest import run
from document_keys import assert_keys
from faults import raises, replaced
from page_documents import page_blocks, page_document, page_text
from pkmcal.calibration.holdout import (
    by_region,
    chosen,
    clusters,
    points_of_poses,
    regions,
    select,
    spread,
)
from pkmcal.calibration.saved_calibration import load
from pkmcal.errors import InputError, ResultError
from pkmcal.geometry.rigid import pose, rotation
from pkmcal.identify.bundle import bundle
from pkmcal.identify.start import start_state
from pkmcal.judge.comparison import (
    compare_with_nominal,
    finite_rms,
    improvement_ratio,
    promise,
    weighed_mean_and_rms,
)
from pkmcal.judge.fixed_machine import held_machine, too_little
from pkmcal.judge.holdouts import by_regions, hold_out
from pkmcal.judge.new_data import repeated_rows
from pkmcal.judge.paths import straightness
from pkmcal.judge.prediction import predict
from pkmcal.judge.sentences import validation_verdict
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import load_mechanism
from pkmcal.placement.default_camera import default_camera
from pkmcal.placement.edges import EdgeNoise, simulate_edges
from pkmcal.report.validation import held_out_part
from pkmcal.session.load import load_session
from pkmcal.simulation import Settings
from pkmcal.simulation.truth import draw_truth, true_machine
from pose_sessions import JOINT_NOISE, T_CAMERA_BASE, measured, papers_case, papers_poses
from test_bad_input import images, only
from test_identify_scene import exact

STATIONS = 3


def legs_case(seed, true=None):
    """A hexapod's edges from three stations, eight configurations each."""
    nominal, camera = exact("gough-stewart"), default_camera()
    settings = Settings(stations=STATIONS, configurations=8)
    truth = draw_truth(nominal, (camera,) * STATIONS, settings, seed)
    true = true or truth.machine
    rng = np.random.default_rng(seed)
    edges, readings = simulate_edges(
        true, truth.T_camera_base, camera, truth.T_base_platform, EdgeNoise(), rng,
        images=truth.images,
    )  # fmt: skip
    data = Measurements(edges, readings, 3e-6, STATIONS, np.zeros(STATIONS, dtype=int))
    return nominal, true, truth.T_camera_base, data


def calibrated(seed):
    nominal, true, stations, data = legs_case(seed)
    return nominal, true, bundle(nominal, data, start_state(nominal, data, stations)), data


def observed_by(machine, data, stations):
    return predict(machine, data, start_state(machine, data, stations))


def judged_on(nominal, estimate, machine, data, stations):
    value = observed_by(machine, data, stations)
    by_nominal = observed_by(nominal, data, stations)
    rows = np.flatnonzero(value.observed)
    return compare_with_nominal(nominal, estimate.covariance, data, value, by_nominal, rows)


def changed(machine, name, by):
    values = machine.values.copy()
    values[machine.parameters.index(name)] += by
    return machine.with_values(values)


@pytest.fixture(scope="module")
def hexapod():
    return calibrated(1)


@pytest.fixture(scope="module")
def new(hexapod):
    """The same machine again: other stations, and their measurements."""
    return legs_case(60, hexapod[1])[2:]


@pytest.fixture(scope="module")
def h4():
    """[C]'s machine and its calibration from 71 poses."""
    nominal = load_mechanism("h4", model="calibration")
    rng = np.random.default_rng(3)
    true = true_machine(nominal, 1.0, rng)
    case = papers_case(true, rng)
    start = start_state(nominal, case.measurements, T_CAMERA_BASE[None])
    return nominal, true, bundle(nominal, case.measurements, start), case, rng


# the machine held


def test_held_leaves_radii_alone_free():
    machine = held_machine(load_mechanism("gough-stewart"), radii=True)
    names = machine.parameters.free_names()
    assert names
    assert all("radius" in name for name in names)
    assert held_machine(load_mechanism("h4"), radii=True).parameters.free_matrix().shape[1] == 0


def test_residuals_scatter_as_promised(hexapod):
    nominal, true, estimate, _ = hexapod
    chi2 = []
    for seed in range(60, 63):
        _, _, stations, data = legs_case(seed, true)
        chi2.append(judged_on(nominal, estimate, estimate.machine, data, stations).promise)
    share = np.mean([test.chi2 / test.dof for test in chi2])
    assert abs(share - 1) < 0.2  # one calibration in all of them; its error is 4 % of the noise
    assert all(test.holds for test in chi2)


def test_own_readings_have_no_part_in_a_pose(hexapod, new):
    """A reading that is wrong by 5 mm shows as 5 mm, and moves no estimated pose."""
    estimate = hexapod[2]
    stations, data = new
    start = start_state(estimate.machine, data, stations)
    wrong = replace(data, joints=data.joints + 5e-3 * (np.arange(len(data.joints)) == 4)[:, None])
    good, bad = (predict(estimate.machine, d, start) for d in (data, wrong))
    shift = bad.errors.residuals[4] - good.errors.residuals[4]
    assert np.abs(shift - 5e-3).max() < 2e-5
    assert np.abs(bad.T_base_platform[4] - good.T_base_platform[4]).max() < 2e-5


def test_a_refined_camera_is_no_part_of_the_machine(hexapod, new):
    """Intrinsics that are refined with the machine are found beside it, without an option."""
    estimate = hexapod[2]
    stations, data = new
    start = start_state(estimate.machine, data, stations)
    wide = replace(
        data,
        edges=replace(data.edges, by_intrinsics=np.zeros((len(data.edges), 2, 1))),
        intrinsics_factor=np.ones((1, 1, 1)),
        intrinsics_at=np.zeros((1, 1)),
    )
    held, refined = (predict(estimate.machine, d, start) for d in (data, wide))
    assert refined.by_machine.shape == held.by_machine.shape
    assert np.allclose(refined.errors.residuals, held.errors.residuals, atol=1e-9)
    assert np.allclose(refined.noise, held.noise, rtol=1e-6, atol=1e-15)


def test_own_readings_have_no_part_where_a_board_needs_the_others(h4):
    nominal, _, estimate, case, _ = h4
    few = select(case.measurements, np.arange(71) < 12)
    few = replace(few, joints=few.joints[:12])
    wrong = replace(few, joints=few.joints + 1e-2 * (np.arange(12) == 4)[:, None])
    start = start_state(estimate.machine, few, T_CAMERA_BASE[None])
    good, bad = (predict(estimate.machine, d, start) for d in (few, wrong))
    shift = bad.errors.residuals[4] - good.errors.residuals[4]
    assert np.abs(shift - 1e-2).max() < 2e-4  # to first order of a leave-one-out by leverage
    # the others do take notice, through the camera's and the board's place
    assert np.abs(bad.errors.residuals[5] - good.errors.residuals[5]).max() > 1e-5
    del nominal


def test_a_pose_that_follows_from_its_own_readings_is_left_out(hexapod, new):
    """An image in which hardly an edge was measured predicts nothing, and spoils no other one."""
    estimate = hexapod[2]
    stations, data = new
    edges = data.edges
    first = np.flatnonzero(edges.configuration == 4)[:1]
    poor = edges.select(np.sort(np.concatenate([np.flatnonzero(edges.configuration != 4), first])))
    start = start_state(estimate.machine, data, stations)
    whole, without = (
        predict(estimate.machine, one, start) for one in (data, replace(data, edges=poor))
    )
    assert whole.observed.all()
    assert np.flatnonzero(~without.observed).tolist() == [4]
    others = np.delete(np.arange(len(data.joints)), 4)
    change = without.errors.residuals[others] - whole.errors.residuals[others]
    assert np.abs(change).max() < 0.1 * np.abs(whole.errors.residuals[others]).max()
    assert np.isnan(without.errors.residuals[4]).all()


def test_a_board_in_one_configuration_decides_nothing(h4):
    _, _, estimate, case, _ = h4
    one = select(case.measurements, np.arange(71) == 0)
    start = start_state(estimate.machine, one, T_CAMERA_BASE[None])
    with raises(ResultError, code="validation.few_measurements"):
        predict(estimate.machine, one, start)


def test_five_images_of_a_board_predict_as_well_as_stated():
    """The true machine's errors have the stated covariance, from where a free machine's fit ended.

    A platform that does not turn leaves the camera's rotation to a few readings.
    """
    rng = np.random.default_rng(0)
    nominal = load_mechanism("linear-delta")
    true = true_machine(nominal, 1.0, rng)
    poses = np.tile(true.home(), (20, 1, 1))
    poses[:, :3, 3] += rng.uniform(-0.06, 0.06, (20, 3))
    data = measured(true, poses, rng, noise=0.1).measurements
    data = replace(data, poses=replace(data.poses, whiten=10 * data.poses.whiten), joint_noise=1e-6)
    chi2, dof, left_out = 0.0, 0, 0
    for first in range(0, 20, 5):
        few = select(data, np.isin(np.arange(20), np.arange(first, first + 5)))
        start = start_state(nominal, few, T_CAMERA_BASE[None])
        start = bundle(nominal, few, start).state
        value = predict(true, few, start)
        residuals = value.errors.residuals[value.observed]
        test = promise(residuals, value.noise, np.zeros_like(value.noise))
        chi2, dof, left_out = chi2 + test.chi2, dof + test.dof, left_out + 5 - len(residuals)
    assert left_out == 0
    assert 0.025 < chdtr(dof, chi2) < 0.975


@pytest.mark.parametrize(("seed", "spread", "n"), [(0, 0.04, 19), (1, 0.08, 19), (2, 0.04, 12)])
def test_a_board_on_a_platform_that_does_not_turn(seed, spread, n):
    """Readings as soft as elsewhere let board and camera slide along a curved valley."""
    rng = np.random.default_rng(seed)
    nominal = load_mechanism("3-upu")
    true = true_machine(nominal, 1.0, rng)
    poses = np.tile(true.home(), (n, 1, 1))
    poses[:, :3, 3] += rng.uniform(-spread, spread, (n, 3))
    data = measured(true, poses, rng, noise=0.03).measurements
    data = replace(
        data, poses=replace(data.poses, whiten=data.poses.whiten / 0.03), joint_noise=1e-5
    )
    start = start_state(nominal, data, T_CAMERA_BASE[None])
    estimate = bundle(nominal, data, start)
    value = predict(estimate.machine, data, estimate.state)
    assert value.observed.all()
    stated = np.sqrt(np.diag(value.noise)).reshape(n, 3)
    assert np.abs(value.errors.residuals / stated).max() < 5
    assert np.sqrt(np.mean(value.errors.residuals**2)) < 5e-5


# verdicts


def test_better_than_the_nominal_model(hexapod, new):
    nominal, _, estimate, _ = hexapod
    stations, data = new
    judged = judged_on(nominal, estimate, estimate.machine, data, stations)
    verdict = validation_verdict(judged, (), estimate.machine, data)
    assert verdict.usable
    assert "times better than the nominal model: 0." in verdict.headline
    assert judged.ratio.low > 3
    assert finite_rms(judged.after) < np.sqrt(2) * judged.floor
    (advice,) = verdict.of("validation.noise_each_once")
    assert advice.facts["stations"] == 3

    def report(station_names):
        """Advice if station ``seen_from(row)`` sees a configuration, for each edge."""
        edges = replace(data.edges, station=station_names(data.edges))
        case = replace(data, edges=edges)
        (text,) = validation_verdict(judged, (), estimate.machine, case).advice
        return text.partition("better still. ")[2]

    assert report(lambda e: 0 * e.station).startswith("Several stations that see the same")
    assert report(lambda e: e.leg % 3).startswith("All are seen from several of the 3 stations")
    some = report(lambda e: np.where(e.configuration < 10, e.leg % 3, e.station))
    assert some.startswith("14 of 24 of these configurations are seen from one of the 3 stations")


def test_rows_that_contradict_the_verdict_are_explained(hexapod):
    """One station determines depth badly: plain root mean squares are its noise, the weighted ones
    not.
    """
    nominal, true, estimate, _ = hexapod
    _, _, stations, data = legs_case(60, true)
    judged = judged_on(nominal, estimate, estimate.machine, data, stations)
    assert not validation_verdict(judged, (), estimate.machine, data).warnings
    in_view, as_drawn = judged.calibrated, judged.figures(judged.nominal)
    worse = as_drawn.joint_rms[2] / judged.figures(in_view).joint_rms[2]
    off = in_view.residuals * np.where(np.arange(6) == 2, 1.1 * worse, 1.0)
    blurred = replace(judged, calibrated=replace(in_view, residuals=off))
    (values,) = validation_verdict(blurred, (), estimate.machine, data).warnings
    promised = f"{1e3 * judged.promise.joint_rms[2]:.2g} mm"
    assert f"(joint 3: to {promised}) that single rows" in values
    far = replace(judged, calibrated=replace(in_view, position=judged.nominal.position * 1.1))
    (values,) = validation_verdict(far, (), estimate.machine, data).warnings
    assert values.startswith("Some directions are seen so badly in these images that single")


def test_a_leg_that_changed_is_named(hexapod):
    nominal, true, estimate, _ = hexapod
    _, _, stations, data = legs_case(60, changed(true, "legs[3].length.offset", 1e-3))
    judged = judged_on(nominal, estimate, estimate.machine, data, stations)
    verdict = validation_verdict(judged, (), estimate.machine, data)
    assert not verdict.usable
    assert judged.ratio.better  # it is still better than the nominal model
    assert "joint 3 reads" in verdict.reasons[0]
    assert abs(judged.promise.common[2] + 1e-3) < 4 * judged.promise.common_sigma[2]


def test_a_calibration_that_made_it_worse(hexapod, new):
    nominal, _, estimate, _ = hexapod
    stations, data = new
    worse = changed(estimate.machine, "legs[3].length.offset", 0.02)
    judged = judged_on(nominal, estimate, worse, data, stations)
    verdict = validation_verdict(judged, (), worse, data)
    assert not verdict.usable
    assert verdict.headline.startswith("The nominal model predicts the readings")
    assert "made the machine worse" in verdict.reasons[0]
    assert "larger than the calibration's deviations" in verdict.reasons[1]


def test_the_nominal_model_is_not_better_than_itself(hexapod, new):
    nominal, _, estimate, _ = hexapod
    stations, data = new
    judged = judged_on(nominal, estimate, nominal, data, stations)
    verdict = validation_verdict(judged, (), nominal, data)
    assert not verdict.usable
    assert not judged.ratio.better


def test_a_board_on_an_h4(h4):
    nominal, true, estimate, _, rng = h4
    new = measured(true, papers_poses()[rng.permutation(81)[:12]], rng)
    start = start_state(estimate.machine, new.measurements, T_CAMERA_BASE[None])
    prediction = predict(estimate.machine, new.measurements, start)
    judged = compare_with_nominal(
        nominal, estimate.covariance, new.measurements, prediction, None, np.arange(12)
    )
    verdict = validation_verdict(judged, (), estimate.machine, new.measurements)
    assert verdict.usable, verdict
    assert "° against" in verdict.headline
    assert "readings at the poses" not in verdict.headline
    assert not verdict.warnings
    for again, values in ((12, "12 are at poses"), (1, "1 is at a pose")):
        repeated = np.arange(12) < again
        text = validation_verdict(judged, (), estimate.machine, new.measurements, repeated)
        (warning,) = text.warnings
        assert warning.startswith(f"Of 12 configurations {values} that the calibration used, ")
        assert ("readings at the poses that it was calibrated from" in text.headline) == (again > 1)
    assert new.measurements.joint_noise == JOINT_NOISE


# figures


def test_a_ratio_and_its_spread():
    rng = np.random.default_rng(0)
    made = improvement_ratio(np.abs(10 * rng.normal(size=400)), np.abs(rng.normal(size=400)))
    assert made.low < 10 < made.high
    assert made.sigma == pytest.approx(0.5, rel=0.2)  # sqrt(2/400) / sqrt 2 of both, times ten
    assert not made.better or made.low > 1


def test_a_promise_is_uniform_in_chance_and_finds_what_is_common():
    rng = np.random.default_rng(1)
    noise = np.diag(np.tile([1.0, 4.0, 0.25], 10))
    draws = rng.normal(size=(300, 30)) * np.sqrt(np.diag(noise))
    tests = [promise(row.reshape(10, 3), noise, 0 * noise) for row in draws]
    assert abs(np.mean([t.chance for t in tests]) - 0.5) < 4 * 0.289 / np.sqrt(300)
    off = promise(draws[0].reshape(10, 3) + np.array([0, 0, 1.0]), noise, 0 * noise)
    assert off.usual
    assert not off.steady
    assert np.argmax(np.abs(off.common / off.common_sigma)) == 2


def test_poses_that_are_hardly_seen_hardly_count():
    values, sigma = np.array([[1.0], [100.0], [np.nan]]), np.array([[1.0], [1e4], [1.0]])
    assert weighed_mean_and_rms(values, sigma)[1][0] == pytest.approx(1.0, abs=1e-3)


# paths


def test_straightness():
    along = np.linspace(0, 1, 9)[:, None] * [0.1, 0.2, 0.05]
    assert straightness(along).largest < 1e-15
    normal = np.array([2.0, -1.0, 0.0]) / np.sqrt(5)
    bent = along + 1e-3 * (np.arange(9) % 2 * 2 - 1)[:, None] * normal
    value = straightness(bent)
    assert value.rms == pytest.approx(1e-3, rel=0.02)
    assert value.rms <= value.largest < 1.2e-3


# regions and hold-outs


def test_regions_are_whole_named_and_the_same_again():
    rng = np.random.default_rng(4)
    machine = load_mechanism("gough-stewart")
    shifts = np.repeat([[0, 0, 0.3], [0.2, 0, 0.3], [0, 0, 0.5]], 5, axis=0)
    poses = pose(
        rotation(1e-3 * rng.normal(size=(15, 3))), shifts + 1e-3 * rng.normal(size=(15, 3))
    )
    points = points_of_poses(machine, poses)
    rows = np.arange(100, 115)
    values = regions(points, rows, 3)
    assert sorted(np.concatenate([r.rows for r in values])) == sorted(rows)
    assert {len(r.rows) for r in values} == {5}
    names = {tuple(r.rows // 5): r.name for r in values}
    assert names[(21,) * 5].startswith("towards +x")
    assert "high" in names[(22,) * 5]
    assert np.array_equal(clusters(points, 3), clusters(points.copy(), 3))
    assert len(set(spread(points, 3) // 5)) == 3


def test_the_choice_of_held_out_points_does_not_hang_on_rounding():
    """Clusters of two points, whose middle is equally far from both."""
    rng = np.random.default_rng(3)
    points = np.repeat(np.eye(6)[:4], 2, axis=0) + 1e-2 * rng.normal(size=(8, 6))
    choice = spread(points, 4)
    for _ in range(20):
        assert np.array_equal(spread(points + 1e-12 * rng.normal(size=(8, 6)), 4), choice)


def test_held_out_regions_know_nothing_of_their_readings(hexapod):
    nominal, _, estimate, data = hexapod
    region = chosen(nominal, estimate, data, 5)
    value = hold_out(nominal, data, estimate, region)
    assert list(value.left_out.rows) == list(region.rows)
    assert not value.estimate.configurations[region.rows].any()
    spoiled = data.joints.copy()
    spoiled[region.rows] += 1e-3
    other = hold_out(nominal, replace(data, joints=spoiled), estimate, region)
    assert np.allclose(other.estimate.machine.values, value.estimate.machine.values, atol=1e-9)
    shift = other.left_out.calibrated.residuals - value.left_out.calibrated.residuals
    assert np.abs(shift - 1e-3).max() < 1e-4


def test_regions_judged_together(hexapod):
    nominal, _, estimate, data = hexapod
    count = by_regions(nominal, data, estimate, 3)
    assert sum(len(item.left_out.rows) for item in count) == estimate.configurations.sum()
    verdict = validation_verdict(None, count, nominal, data)
    assert verdict.usable, verdict
    assert "of regions that it did not see" in verdict.headline


def test_poor_extrapolation_is_reported(hexapod):
    nominal, _, estimate, data = hexapod
    item = hold_out(nominal, data, estimate, chosen(nominal, estimate, data, 4))
    far = replace(item, left_out=replace(item.left_out, after=5 * item.left_out.after))
    (warning,) = validation_verdict(None, (far,), nominal, data).warnings
    assert warning.startswith("Extrapolation is poor where the platform is spread")


@pytest.mark.parametrize("n", [0, 13, 24])
def test_how_many_to_hold_out(hexapod, n):
    nominal, _, estimate, data = hexapod
    with raises(InputError, found=str(n), expected="1 to 12, for 24 poses seen"):
        chosen(nominal, estimate, data, n)


def test_too_few_configurations_to_hold_out(hexapod):
    nominal, _, estimate, data = hexapod
    few = SimpleNamespace(configurations=np.arange(24) < 3, state=estimate.state)
    with raises(InputError, found="3 poses seen"):
        chosen(nominal, few, data, 1)


def imaged_again(estimate, data):
    """The first 22 poses of an estimate, which differ, each three times."""
    rng = np.random.default_rng(1)
    joints = np.tile(data.joints[:22], (3, 1))
    joints += data.joint_noise * rng.normal(size=joints.shape)
    poses = np.tile(estimate.state.T_base_platform[:22], (3, 1, 1))
    poses[:, :3, 3] += 3e-6 * rng.normal(size=(len(poses), 3))
    whole = SimpleNamespace(
        configurations=np.ones(len(poses), dtype=bool),
        state=SimpleNamespace(T_base_platform=poses),
    )
    return whole, replace(data, joints=joints)


def test_a_pose_under_several_names_is_held_out_whole(hexapod):
    nominal, _, estimate, data = hexapod
    whole, again = imaged_again(estimate, data)
    out = chosen(nominal, whole, again, 5).rows
    assert list(np.unique(out % 22, return_counts=True)[1]) == [3] * 5
    count = by_region(nominal, whole, again, 4)
    assert sum(len(region.rows) for region in count) == 66
    for region in count:
        assert set(np.unique(region.rows % 22, return_counts=True)[1]) == {3}
    with raises(InputError, found="12", expected="1 to 11, for 22 poses seen"):
        chosen(nominal, whole, again, 12)


def test_the_report_states_the_number_of_poses_held_out(hexapod):
    nominal, _, estimate, data = hexapod
    item = hold_out(nominal, data, estimate, chosen(nominal, estimate, data, 4))
    joints = data.joints.copy()

    def text():
        session = SimpleNamespace(
            machine=nominal,
            joints=joints,
            joint_noise=data.joint_noise,
            document={"joints": {"columns": nominal.joint_names}},
        )
        return " ".join(held_out_part(item, session).terminal_text)

    assert text().startswith("On 4 configurations held out")
    joints[item.region.rows[1]] = joints[item.region.rows[0]] + data.joint_noise
    assert text().startswith("On 4 configurations of 3 poses held out")


# the commands


def of_two_stations(session):
    """The session without its third station and the configurations that it alone observes."""
    only(session, "station1", "station2")
    visible = {path.stem for name in ("station1", "station2") for path in images(session, name)}
    head, *rows = (session / "joints.csv").read_text().splitlines()
    rows = [row for row in rows if row.partition(",")[0] in visible]
    (session / "joints.csv").write_text("\n".join([head, *rows]) + "\n")
    return session


@pytest.fixture(scope="module")
def saved_result(demo, tmp_path_factory):
    """Two of the demonstration's stations calibrated without three configurations, and
    validated.
    """
    folder = tmp_path_factory.mktemp("validate")
    session = of_two_stations(shutil.copytree(demo.session, folder / "session"))
    made = run("calibrate", session, "--holdout", 3, "-o", folder / "c", "--json")
    value = run("validate", folder / "c", session, "-o", folder / "v", "--json")
    return SimpleNamespace(folder=folder, made=made, result=value)


def test_calibrate_with_some_held_out(saved_result):
    out = saved_result.made.json["holdout"]
    assert len(out["left_out"]["configurations"]) == 3
    assert_keys("calibrate --json", saved_result.made.json)
    document = json.loads((saved_result.folder / "c" / "calibration.json").read_text())
    unused = [c["name"] for c in document["configurations"] if not c["used"]]
    assert unused == out["left_out"]["configurations"]
    assert document["holdout"] == out
    report = page_text(page_document((saved_result.folder / "c" / "report.html").read_text()))
    for station in document["session"]["stations"].values():
        names = [Path(image).stem for image in station["photographs"]]
        used = len(names) - len({*names} & {*unused})
        values = f"{used} of {len(names)}" if used < len(names) else f"{used}"
        assert f"{station['camera']}, pinhole, {values} images" in report
    assert "held out, the calibrated machine predicts" in report
    assert not any("did not take part" in w for w in saved_result.made.json["verdict"]["warnings"])


def test_the_worst_image_comes_first_and_bars_lead_to_images(saved_result):
    page = page_document((saved_result.folder / "v" / "validation.html").read_text())
    (block,) = page_blocks(page, "images", "photographs")
    bars = page_blocks(page, "panels", "readings")[0]["plots"][0]["marks"][0]["points"]
    worst = max(bars, key=lambda bar: bar["y"])["x"]
    assert block["images"][0]["key"].endswith(f"/{worst}")
    of_images = {image["key"].partition("/")[2] for image in block["images"]}
    assert of_images == {bar["x"] for bar in bars}
    assert all(image["webp"] for image in block["images"])


def test_validate_on_what_was_held_out(saved_result, demo):
    assert saved_result.result.err == ""
    result = saved_result.result.json
    assert_keys("validate --json", result)
    out = saved_result.made.json["holdout"]["left_out"]["configurations"]
    assert result["new_data"]["configurations"] == out
    assert set(result["known_configurations"]).isdisjoint(out)
    assert result["repeated_configurations"] == []
    assert (
        result["exit_code"] == saved_result.result.code == (0 if result["verdict"]["usable"] else 1)
    )
    page = page_document((saved_result.folder / "v" / "validation.html").read_text())
    assert page["verdict"]["headline"] == result["verdict"]["headline"]
    (panels,) = page_blocks(page, "panels")
    bars = next(mark["points"] for mark in panels["plots"][0]["marks"] if mark["mark"] == "bars")
    assert [bar["x"] for bar in bars] == out
    worst = max(bars, key=lambda bar: bar["y"])
    assert worst["key"] == f"configuration:{worst['x']}"
    (sentence, *_) = page_blocks(page, "paragraph", "readings")
    assert f"Worst is configuration {worst['x']}," in sentence["text"]
    # the stage and the table begin there
    (stage,) = page_blocks(page, "space", "configurations")
    (table,) = page_blocks(page, "table", "configurations")
    keys = [pose["key"] for pose in stage["poses"]]
    assert keys[0] == worst["key"]
    assert keys == [row["key"] for row in table["rows"]]
    (points,) = stage["points"]
    assert list(points["keys"]) == keys
    assert points["sizes"][0] == max(points["sizes"]) == 1
    assert json.loads((saved_result.folder / "v" / "validation.json").read_text())["new_data"]
    del demo


def test_validate_in_words(saved_result, session):
    of_two_stations(session)
    path = "\npaths: {ruler: ['0000', '0001', '0002']}\n"
    (session / "session.yaml").write_text((session / "session.yaml").read_text() + path)
    done = run("validate", saved_result.folder / "c", session, "--regions", 2)
    assert "The calibrated machine" in done.out
    assert "Straight paths" in done.out
    assert "each left out once" in " ".join(done.out.split())
    assert (session / "validation" / "validation.html").is_file()


def test_poses_that_the_calibration_used_are_known_by_their_readings(demo):
    """Within the readings' noise, in any order, and what was held out is none of them."""
    saved, session = load(demo.calibration), load_session(demo.session)
    rows = np.arange(len(session.joints))
    off = np.where(rows % 2, 2.0, 2e3)[:, None] * session.joint_noise
    anew = replace(session, joints=(session.joints + off)[::-1])
    assert np.array_equal(repeated_rows(saved, anew), (rows % 2 == 1)[::-1])
    unused = replace(saved, used=rows < 4)
    assert np.array_equal(repeated_rows(unused, session), rows < 4)


def test_the_nominal_model_is_recovered(saved_result, demo):
    """Held-out regions must not influence the calibration through the nominal model."""
    from pkmcal.judge.validate import nominal_of

    drawn = load_mechanism(demo.session / "mechanism.yaml")
    values = nominal_of(load(saved_result.folder / "c"))
    assert np.array_equal(values.parameters.nominal, drawn.parameters.nominal)
    assert np.array_equal(values.values, drawn.values)
    assert np.array_equal(values.parameters.free_matrix(), drawn.parameters.free_matrix())


def test_the_same_images(demo, session):
    done = run("validate", demo.calibration, session, "--json")
    assert (done.code, done.json["code"]) == (2, "session.not_new")
    assert "--holdout N" in done.json["next_step"]
    lines = (session / "joints.csv").read_text().splitlines()
    (session / "joints.csv").write_text("\n".join([lines[0], *(line + "1" for line in lines[1:])]))
    again = run("validate", demo.calibration, session, "--json")
    assert again.json == done.json  # identified by their content, under any names


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("leg", "axis", "axis1, axis2, axis3, axis4, axis5 and axis6"),
        ("leg6", "axis6", "leg1, leg2, leg3, leg4, leg5 and axis6"),
    ],
)
def test_sessions_that_do_not_belong(demo, session, old, new, found):
    replaced(session / "joints.csv", old, new)
    done = run("validate", demo.calibration, session, "--json")
    assert (done.code, done.json["code"]) == (2, "calibration.another_machine")
    assert (done.json["where"], done.json["found"]) == ("joints.csv, line 1", found)


def test_another_machine(demo, session):
    from pkmcal.files import read_yaml, yaml_text

    document = read_yaml(session / "mechanism.yaml").data
    document["legs"][2]["base"]["center"][0] += 0.05
    (session / "mechanism.yaml").write_text(yaml_text(document))
    done = run("validate", demo.calibration, session, "--json")
    assert (done.code, done.json["code"]) == (2, "calibration.another_machine")
    assert "legs[3].base.center.x" in done.json["expected"]


def test_an_output_folder_with_other_things(demo, session):
    done = run("validate", demo.calibration, session, "-o", session, "--json")
    assert (done.code, done.json["code"]) == (2, "output.foreign_files")


def test_no_calibration_there(session):
    done = run("validate", session, session, "--json")
    assert (done.code, done.json["code"]) == (2, "calibration.missing")


def test_what_is_advised_where_too_little_was_seen():
    """More configurations do not help legs on cranks, for their edges need the readings."""
    delta, hexapod = load_mechanism("delta"), load_mechanism("gough-stewart")
    alone = SimpleNamespace(edges=[1], on_platform=np.zeros(0, dtype=bool))
    error = too_little(delta, alone)
    assert error.exit_code == 2
    assert "all legs on cranks or sliders" in error.found
    assert "board on the platform" in error.expected
    with_board = SimpleNamespace(edges=[1], on_platform=np.ones(1, dtype=bool))
    for machine, measured_alone in ((hexapod, alone), (delta, with_board)):
        assert too_little(machine, measured_alone).exit_code == 1
