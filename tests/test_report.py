"""The report's views, numbers and overlays, against a case made by hand."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pkmcal import wording
from pkmcal.arrays import enlargement
from pkmcal.calibration.results import base_camera_covariance
from pkmcal.geometry.cylinders import contour_point
from pkmcal.geometry.rigid import apply, perturb, pose_difference
from pkmcal.identify.centres import free_of_gauge, joint_centres
from pkmcal.identify.parameter_estimates import parameter_estimates
from pkmcal.identify.tool import pose_by_parameters, tool_error
from pkmcal.observe import overlays
from pkmcal.observe.overlays import EDGE_CURVE_POINTS, STRAIGHT_CURVE_DEVIATION
from pkmcal.observe.predict import legs_in_camera
from pkmcal.outcome import Verdict
from pkmcal.outcome.finding import wrong
from pkmcal.report import parameters, pictures, provenance, residuals
from pkmcal.report.calibration import report_of
from test_report_case import OUTWARD, RADIUS, Case, calibration, edges_of, make_case


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> Case:
    return make_case(tmp_path_factory.mktemp("session"))


# ------------------------------------------------------------------ words and numbers


@pytest.mark.parametrize(
    ("sigma", "places"), [(0.034, 3), (0.0996, 2), (0.0994, 3), (1.2, 1), (34.0, 0), (0.0, 3)]
)
def test_sigma_has_two_significant_digits(sigma, places):
    assert wording.decimals(sigma) == places


def test_numbers_have_a_true_minus_and_no_negative_zero():
    assert wording.number(-1.25, 1) == "−1.2"
    assert wording.number(-0.0004, 3) == "0.000"
    assert wording.number(0.5, 1, signed=True) == "+0.5"
    assert wording.number(float("nan"), 2) == "–"
    assert wording.percent(0.9999) == "99 %"


# ------------------------------------------------------------------ parameters


def findings_of(case):
    e = case.estimate
    return parameter_estimates(case.session.machine.values, e.machine, e.covariance, e.data_share)


def test_table_rows_carry_value_change_and_sigma(case):
    table = parameters.parameter_table(findings_of(case), "")
    names = [column.name for column in table.columns]
    rows = {row.name: dict(zip(names, row.cells, strict=True)) for row in table.rows}
    row = rows["legs[2].base.center.x"]
    k = case.session.machine.parameters.index("legs[2].base.center.x")
    after = case.estimate.machine.values[k] * 1e3
    assert (row["σ"], row["Unit"], row["Nominal"]) == ("0.034", "mm", "269.300")
    assert row["Calibrated"] == f"{after:.3f}"
    assert row["Change"] == f"{after - 269.3:+.3f}".replace("-", "−")
    assert rows["legs[1].base.center.y"]["Source"] == "frame"
    assert rows["legs[1].base.center.y"]["σ"] == "–"
    assert rows["legs[4].tubes[1].radius"]["Source"].startswith("nominal")
    assert rows["legs[4].platform.center.z"]["Source"].startswith("data")


def with_covariance(estimate, covariance):
    """The estimate with another covariance of its parameters."""
    joint = estimate.joint_covariance.copy()
    joint[: len(covariance), : len(covariance)] = covariance
    return replace(estimate, joint_covariance=joint)


def test_the_row_of_chi2_is_of_the_noise_as_stated(case):
    s = case.estimate.statistics
    noisy = replace(
        s, chi2=1040.0, chi2_edges=940.0, chi2_joints=60.0, chi2_drawing=40.0, chi2_poses=0.0,
        dof=1000.0, noise_scale=7.0, pose_scale=1.0, reading_scale=1.0,
    )  # fmt: skip
    refused = Verdict(
        False,
        "Not to be used.",
        (wrong("data.misfit", group="edges", names=["edges"], scale=5.0),),
    )
    estimate = replace(case.estimate, statistics=noisy)
    value = report_of(calibration(case.session, case.observation, estimate, refused))
    (card,) = (card for card in value.figures if card.question.startswith("Does the model"))
    assert card.values == (("46.16", "χ² per degree of freedom"),)  # 0.94 * 49 + 0.1
    assert "1.04 after the edges' stated noise was multiplied by 7.00" in card.note
    assert value.summary["figures"]["chi2_per_freedom"] == pytest.approx(46.16)
    plain = replace(noisy, noise_scale=1.0)
    estimate = replace(estimate, statistics=plain)
    value = report_of(calibration(case.session, case.observation, estimate, refused))
    (card,) = (card for card in value.figures if card.question.startswith("Does the model"))
    assert card.values == (("1.04", "χ² per degree of freedom"),)
    assert "multiplied" not in card.note


def test_what_can_hardly_be_distinguished_is_stated_in_words(case):
    covariance = case.estimate.covariance.copy()
    i, j = (case.session.machine.parameters.index(f"legs[6].{p}")
            for p in ("platform.center.z", "length.offset"))  # fmt: skip
    covariance[i, j] = covariance[j, i] = -0.98 * covariance[i, i]
    estimate = with_covariance(case.estimate, covariance)
    (text,) = parameters.bound_together(estimate)
    assert text.startswith("Leg 6 platform centre z and leg 6 length offset move together")
    assert "their sum is known far better" in text


# ------------------------------------------------------------------ uncertainty


def test_pose_covariance_agrees_with_forward_kinematics(case):
    machine, state = case.estimate.machine, case.estimate.state
    by = pose_by_parameters(machine, case.session.joints[:1], state.T_base_platform[:1])[0]
    got = by @ case.estimate.covariance @ by.T
    sigma = np.sqrt(np.diag(case.estimate.covariance))
    columns = []
    for k in range(sigma.size):  # one parameter at a time by its own standard deviation
        shifted = machine.with_values(machine.values + sigma * (np.arange(sigma.size) == k))
        start = state.T_base_platform[0]
        forward_kinematics = shifted.forward(case.session.joints[:1], start)[0]
        columns.append(pose_difference(forward_kinematics, start))
    expected = np.transpose(columns) @ np.array(columns)
    np.testing.assert_allclose(got, expected, rtol=0.01, atol=1e-3 * np.abs(expected).max())


def test_uncertainty_does_not_depend_on_the_frame(case):
    machine = case.estimate.machine
    index = machine.layout.base[0].index[:, :3]
    shift = np.zeros(len(machine.values))
    shift[index[:, 0]] = 1e-3  # a common shift of the base along x: a frame change
    shifted = with_covariance(case.estimate, case.estimate.covariance + np.outer(shift, shift))
    once, twice = (free_of_gauge(e.machine, e.covariance) for e in (case.estimate, shifted))
    np.testing.assert_allclose(once, twice, atol=1e-6 * once.max())


def test_nominal_model_is_laid_over_before_the_change_is_reported(case):
    session, estimate = case.session, case.estimate
    turned = np.array([0.01, -0.02, 0.03, 0.1, 0.2, 0.3])
    nominal, values = session.machine, session.machine.values.copy()
    index = nominal.layout.base[0].index[:, :3]
    values[index] = apply(perturb(np.eye(4), turned), values[index])
    base, platform = joint_centres(nominal, nominal.with_values(values), estimate.covariance)
    assert np.abs(base.change).max() < 1e-12
    assert np.abs(platform.change).max() < 1e-12
    tool = tool_error(nominal, estimate.machine, estimate.covariance,
                      estimate.state.T_base_platform[[1, 3]], session.joints[[1, 3]])  # fmt: skip
    assert (tool.position > 1e-5).all()
    assert (tool.off_position > 1e-4).all()


def test_errors_are_enlarged_by_a_round_factor():
    assert enlargement(np.full(12, 2e-3), 0.05) == 20
    assert enlargement(np.full(12, 2e-3), 0.11) == 50
    assert enlargement(np.full(12, 1.0), 0.1) == 1


def test_camera_position_sigma(case):
    T, sigma = case.estimate.state.T_camera_base[0], np.array([1e-4] * 3 + [2e-4] * 3)
    rng = np.random.default_rng(0)
    shifted = perturb(T, sigma * rng.normal(size=(20000, 6)))
    places = -(np.swapaxes(shifted[:, :3, :3], 1, 2) @ shifted[:, :3, 3:])[..., 0]
    got = base_camera_covariance(T, np.diag(sigma**2))[3:, 3:]
    # 20 000 draws leave 1 % on a standard deviation
    np.testing.assert_allclose(np.sqrt(np.diag(got)), places.std(axis=0), rtol=0.03)


# ------------------------------------------------------------------ edges and images


def test_outward_shift_is_found_in_pixels(case):
    edges, estimate = case.observation.edges, case.estimate
    numbers = case.session.camera_of_station
    got = residuals.outward_shift(edges, estimate, case.session.joints, numbers)
    np.testing.assert_allclose(got, OUTWARD, atol=2e-3)  # second order in the shift


def test_edges_are_drawn_where_the_camera_sees_them(tmp_path):
    case = make_case(tmp_path, n_poses=1, n_stations=1)
    estimate, session = case.estimate, case.session
    T, state = session.stations[0].camera, estimate.state
    edges = edges_of(
        estimate.machine, state.T_camera_base, state.T_base_platform, session.joints, 0.0
    )
    in_view = replace(case.observation, edges=edges)
    curves = pictures.edge_curves(calibration(session, in_view, estimate), np.arange(len(edges)), 0)
    legs = legs_in_camera(
        estimate.machine, state.T_camera_base[0], state.T_base_platform[0], session.joints[0]
    )
    assert len(edges) > 15
    for n, curve in enumerate(curves):
        leg, radius = edges.leg[n], np.array(RADIUS[int(edges.tube[n])])
        along = np.linspace(*edges.span[n], EDGE_CURVE_POINTS)
        in_view = contour_point(legs.a[leg], legs.u[leg], edges.normal[n], radius, along)
        np.testing.assert_allclose(curve, T.project(in_view), atol=1e-6)


def test_joints_are_drawn_where_the_camera_sees_them(case):
    session, estimate = case.session, case.estimate
    base, platform = joint_centres(session.machine, estimate.machine, estimate.covariance)
    shot = album_of(case).images[0]
    names = shot.title.split(" / ")
    s = [station.name for station in session.stations].index(names[0])
    k = session.configurations.index(names[1])
    T_camera_base, pose = estimate.state.T_camera_base[s], estimate.state.T_base_platform[k]
    project = session.stations[s].camera.project
    layers = {layer.name: layer.shapes for layer in shot.overlays[0].layers}
    assert len(layers["joints"]) == len(layers["nominal"]) == 12
    for ring, cross in zip(layers["joints"], layers["nominal"], strict=True):
        at_base = "base joint" in ring.tip
        side, T = (base, T_camera_base) if at_base else (platform, T_camera_base @ pose)
        leg = int(ring.key.removeprefix("leg:"))
        new, old = (
            project(apply(T, points[leg - 1])) for points in (side.calibrated, side.nominal)
        )
        assert cross.key == ring.key
        np.testing.assert_allclose(ring.at, new, atol=0.051)  # one decimal is written
        np.testing.assert_allclose(cross.at, old, atol=0.051)


def test_straight_curves_are_two_points_and_bent_ones_are_kept():
    x = np.linspace(0, 100, 13)
    line, bent = np.stack([x, 2 * x], -1), np.stack([x, 1e-3 * x * x], -1)
    begun, point = line.copy(), np.full((13, 2), np.nan)
    begun[:4], point[7] = np.nan, line[7]
    curves = np.stack([line, bent, begun, np.where(x[:, None] < 50, bent, np.nan), point])
    value = overlays.straightened(curves)
    assert value[0] == line[[0, -1]].tolist()
    assert value[1] == bent.tolist()
    assert value[2] == line[[4, -1]].tolist()
    assert value[3] == bent[x < 50].tolist()
    assert value[4] == [line[7].tolist()]


def album_of(case: Case, largest=pictures.ALBUM_SIZE, **changed) -> pictures.Album:
    """The case's images with another observation or estimate."""
    observation, estimate = (
        changed.get(name, getattr(case, name)) for name in ("observation", "estimate")
    )
    centres = joint_centres(case.session.machine, estimate.machine, estimate.covariance)
    shifts = np.zeros(len(observation.edges))
    value = calibration(case.session, observation, estimate)
    return pictures.album(value, shifts, centres, largest)


def test_pictures_are_sorted_by_their_residuals_those_of_no_use_first(case):
    edges = case.observation.edges
    white = np.ones((len(edges), 2))
    white[(edges.station == 1) & (edges.configuration == 3)] = 5
    white[(edges.station == 2) & (edges.configuration == 4)] = 0.1
    retained = ~((edges.station == 0) & (edges.configuration == 2))
    estimate = replace(
        case.estimate,
        edge_residuals=white[retained],
        edge_weights=case.estimate.edge_weights[retained],
    )
    observation = replace(case.observation, edges=edges.select(retained))
    display = album_of(case, observation=observation, estimate=estimate).images
    named = [tuple(shot.title.split(" / ")) for shot in display]
    assert len(set(named)) == len(named) == 15
    assert named[:2] == [("front0", "c2"), ("front1", "c3")]
    assert named[-1] == ("front2", "c4")
    assert "nothing in use" in display[0].caption
    assert "residuals 5.00\N{NO-BREAK SPACE}σ" in display[1].caption


def test_edges_that_were_left_out_are_drawn_with_their_reason(case):
    shots = {shot.title: shot for shot in album_of(case).images}
    (line,) = next(
        layer.shapes
        for layer in shots["front0 / c0"].overlays[0].layers
        if layer.name == "rejected"
    )
    assert line.tip == "Leg 3, tube 2, right edge, not used: seen over 3.5 mm only"
    # beside where the machine itself shows that edge, as far as a curve is drawn straight
    state = case.estimate.state
    exact = edges_of(
        case.estimate.machine, state.T_camera_base[:1], state.T_base_platform[:1],
        case.session.joints, 0.0,
    )  # fmt: skip
    one = np.flatnonzero((exact.leg == 2) & (exact.tube == 1) & (exact.side == 0))
    in_view = replace(case.observation, edges=exact)
    curve = pictures.edge_curves(calibration(case.session, in_view, case.estimate), one, 0)[0]
    at = np.linspace(0, len(line.points) - 1, 4000)
    x, y = (np.interp(at, range(len(line.points)), c) for c in zip(*line.points, strict=True))
    away = np.hypot(curve[:, :1] - x, curve[:, 1:] - y).min(axis=1)
    assert away[1:-1].max() < STRAIGHT_CURVE_DEVIATION
    assert "too dark" in shots["front1 / c3"].caption


def test_as_many_images_are_shown_as_there_is_room_for(case):
    seven = pictures.AlbumSize(images=7)
    display = album_of(case, seven)
    part = pictures.section(case.session, display)
    (block,) = [one for one in part.blocks if one.kind == "images"]
    assert [one.title for one in block.images] == [one.title for one in display.images]
    assert len(block.images) == 7
    assert "7 of 15 images" in part.blocks[0].text
    large = [len(shot.webp) for shot in display.images]
    few = album_of(case, replace(seven, characters=sum(large) * 9 // 10)).images
    size = [len(shot.webp) for shot in few]
    assert len(few) == 7
    assert 0 < sum(a < b for a, b in zip(size, large, strict=True)) < 7  # in fewer pixels
    assert sum(size) <= sum(large) * 9 // 10
    fewer = album_of(case, replace(seven, characters=min(size) * 3)).images
    assert 0 < len(fewer) < 7


def test_rejections_are_grouped_by_reason(case):
    first, second = provenance.reasons(case.session, case.observation.rejected)
    assert (first.count, first.text) == (2, "seen over … mm only")
    assert first.cases[0] == ("front0 / c0", "leg 3 tube 2 right: seen over 3.5 mm only")
    assert second.cases == (("front1 / c3", "whole image"),)


def test_a_group_that_stands_out_is_named(case):
    edges = case.observation.edges
    white = case.estimate.edge_residuals.copy()
    white[edges.station == 2] *= 4
    estimate = replace(case.estimate, edge_residuals=white)
    shifts = np.zeros(len(edges))
    remarks = residuals.remarks(case.session, edges, estimate, shifts)
    assert any("station front2" in text for text in remarks)
    shifts[(edges.leg == 1) & (edges.tube == 0) & (edges.side == 1)] = -0.2
    (text,) = residuals.remarks(case.session, edges, case.estimate, shifts)
    assert "leg 2 tube 1 left by −0.20 px" in text


def test_expected_rms_holds_nineteen_of_twenty():
    rng = np.random.default_rng(3)
    for n in (4, 40):
        low, high = residuals.expected_rms(n)
        valid = np.sqrt(np.mean(rng.normal(size=(20000, n)) ** 2, axis=1))
        assert np.mean((valid > low) & (valid < high)) == pytest.approx(0.95, abs=0.01)


def test_a_session_is_called_by_its_folder_or_the_one_around_it(case):
    assert replace(case.session, folder=Path("/x/mine")).called == "session mine"
    assert replace(case.session, folder=Path("/x/mine/session")).called == "session mine"


def test_the_table_can_be_taken_along(case):
    estimate, nominal = case.estimate, case.session.machine
    part = parameters.section(nominal, estimate)
    (block,) = (block for block in part.blocks if block.kind == "downloads")
    texts = {file.name: file.content for file in block.files}
    assert set(texts) == {"parameters.csv", "parameters.json"}
    rows = list(csv.DictReader(texts["parameters.csv"].splitlines()))
    table = estimate.machine.parameters
    assert [row["name"] for row in rows] == list(table.names)
    assert [float(row["value"]) for row in rows] == estimate.machine.values.tolist()
    assert [float(row["drawing"]) for row in rows] == nominal.values.tolist()
    sigma = np.sqrt(np.diag(estimate.covariance))
    np.testing.assert_allclose([float(row["sigma"]) for row in rows], sigma, atol=1e-9)
    again = json.loads(texts["parameters.json"])["parameters"]
    assert [row["sigma"] for row in again] == [float(row["sigma"]) for row in rows]
