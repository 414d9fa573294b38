"""[A] 4.3 reproduced with errata's settings: a reduced study here, the full one with -m slow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pkmcal.geometry.rigid import dot
from pkmcal.identify.axis_measurements import (
    AxisNoise,
    as_edges,
    from_coordinates,
    to_coordinates,
)
from pkmcal.papers.paper_a import (
    BOUND,
    END_EFFECTOR_QUANTITIES,
    JOINT,
    METHODS,
    PARAMETER_GROUPS,
    HexapodByAxes,
    converged,
    hexapod_with_held_radii,
    joint_from_readings,
    parameters_by_group,
    start_off_nominal,
    thirty,
)
from pkmcal.studies import engine
from pkmcal.studies.simulated import Noise
from pkmcal.studies.statistics import covered, mean, rms_over_runs
from pkmcal.studies.tasks import Batch


def study(runs, seed=20020, **setting):
    return engine.run(HexapodByAxes(**setting), runs, seed)


@pytest.fixture(scope="module")
def reduced():
    return study(runs=75)


def millimetres(accuracy):
    return 1e3 * np.array([accuracy[name].value for name in PARAMETER_GROUPS])


def test_joint_estimate_reaches_its_bound(reduced):
    joint_rms, bound = (reduced.of(name)["parameters"].value for name in ("joint", "bound"))
    assert joint_rms < 1.05 * bound
    assert 1e3 * joint_rms == pytest.approx(0.039, abs=0.004)
    # each group too; 75 runs leave 6 % or so
    ratio = millimetres(reduced.of("joint")) / millimetres(reduced.of("bound"))
    np.testing.assert_allclose(ratio, 1, atol=0.15)


def test_chi2_is_its_degrees_of_freedom(reduced):
    chi2 = reduced.values("chi2", JOINT)
    assert chi2.mean() == pytest.approx(1, abs=0.02)
    assert 0.95 < np.median(chi2) < 1.05
    assert converged(reduced) == 75


def test_what_it_states_is_what_it_errs_by(reduced):
    """Intervals of 95 % hold 95 of 100 errors, and smaller ones as many as they promise."""
    value = reduced.samples[JOINT,]
    errors, sigma = value.values["parameters"], value.sigma["parameters"]
    assert sigma.shape == errors.shape == (75, 30)
    for share in (0.5, 0.95):
        inside = mean(covered(errors, sigma, share))
        assert abs(inside.value - share) < 3.5 * inside.error + 0.005
        assert inside.error < 0.03


def test_the_table_of_errata(reduced):
    """RMSE in mm of Axy, Az, Bxy, Bz, q0. Depth as printed equals the nominal error."""
    expected = {
        "four steps as printed": [0.077, 1.79, 0.100, 1.62, 0.198],
        "four steps": [0.061, 0.181, 0.086, 0.146, 0.170],
        "joint": [0.034, 0.063, 0.021, 0.032, 0.060],
        "bound": [0.034, 0.060, 0.020, 0.030, 0.059],
    }
    for name, values in expected.items():
        # depth as printed is the nominal error, whose size the paper does not state; the others
        # within the accuracy of 75 runs, three times 5 %, and of the bound by the cameras' height:
        # 6 %
        rtol = 0.35 if "printed" in name else 0.06 if name == "bound" else 0.2
        np.testing.assert_allclose(millimetres(reduced.of(name)), values, rtol=rtol)


def test_end_effector(reduced):
    """[A] eq. 20, mean at random readings: 2.6 mm, 0.27 mm and 0.091 mm in errata; over 3000
    runs here 3.0 mm, 0.25 mm and 0.0899 mm, 0.0140 degrees.
    """

    def error(method, name):
        return reduced.of(method)[name].value

    shifted = "displacement"
    assert 1e3 * error("four steps as printed", shifted) == pytest.approx(3.0, abs=0.5)
    assert 1e3 * error("four steps", shifted) == pytest.approx(0.25, abs=0.03)
    assert 1e3 * error("joint", shifted) == pytest.approx(0.0899, abs=0.012)
    assert np.degrees(error("joint", "orientation")) == pytest.approx(0.0140, abs=0.0018)
    # frames by all centres instead of three: what a user of the tool would see
    assert error("joint", "displacement_registered") < 0.75 * error("joint", shifted)


def test_the_bound_has_its_own_end_effector(reduced):
    """Errors drawn from the bound move the end-effector as far as the joint estimate's."""
    joint, bound = (reduced.of(name)["displacement"] for name in (JOINT, BOUND))
    assert abs(joint.value - bound.value) < 3 * np.hypot(joint.error, bound.error)
    assert bound.error < 0.75 * joint.error


def test_depth_as_printed_is_that_of_the_nominal_model(reduced):
    """Products of distances do not determine depth; the nominal error stays, to the micrometre."""
    nominal, printed = (reduced.of(name) for name in ("drawing", "four steps as printed"))
    assert printed["base_z"].value == pytest.approx(nominal["base_z"].value, rel=1e-3)
    assert printed["platform_z"].value == pytest.approx(nominal["platform_z"].value, rel=1e-3)
    assert printed["base_xy"].value < nominal["base_xy"].value / 10


def test_standard_errors_are_the_scatter_of_studies():
    """Eight small studies scatter by each one's standard error."""
    studies = [study(runs=12, poses=6, seed=seed).of(JOINT) for seed in range(8)]
    names = (*PARAMETER_GROUPS, *END_EFFECTOR_QUANTITIES)
    values = np.array([[s[name].value for name in names] for s in studies])
    message = np.array([[s[name].error for name in names] for s in studies]).mean(axis=0)
    ratio = values.std(axis=0, ddof=1) / message
    # chi of seven degrees of freedom over its root: 0.29 to 1.87 in 99.8 of 100
    assert np.all((ratio > 0.29) & (ratio < 1.87)), ratio


def test_a_batch_depends_on_its_own_seed_alone():
    """Any batch can be done again, anywhere, and gives the study's very runs."""
    import pickle

    setting = HexapodByAxes(poses=4, batch=3)
    whole = engine.run(setting, 7, 3)
    last = pickle.loads(pickle.dumps(engine.batches(setting, 7, 3)[-1]))
    data = setting.draw(last)
    again = setting.judge(last, data, setting.solve(last, data))
    for name in METHODS:
        values = again[name,].values["parameters"]
        np.testing.assert_array_equal(values, whole.values("parameters", name)[6:])


def test_the_thirty_parameters():
    """Frames by centres 1, 3 and 5: their six coordinates vanish, and distances remain."""
    machine = hexapod_with_held_radii()
    actual_names = thirty(machine)
    assert len(set(actual_names.names)) == 30
    assert {"A3 x", "A5 y", "B5 x", "q6"} <= set(actual_names.names)
    assert not {"A1 x", "A3 y", "A5 z"} & set(actual_names.names)
    value = dict(zip(actual_names.names, actual_names.nominal, strict=True))
    centres = machine.base_centers()
    assert value["A3 x"] == pytest.approx(np.linalg.norm(centres[2] - centres[0]))
    assert np.hypot(value["A5 x"], value["A5 y"]) == pytest.approx(
        np.linalg.norm(centres[4] - centres[0])
    )
    # rows are unit and independent: an RMSE by them is one of lengths
    np.testing.assert_allclose(actual_names.rows @ actual_names.rows.T, np.eye(30), atol=1e-12)


def test_groups_of_parameters():
    """An error of one group shows in that one only."""
    machine = hexapod_with_held_radii()
    names = thirty(machine).names
    errors = np.zeros((4, 30))
    errors[:, [names.index(n) for n in ("B2 z", "B4 z", "B6 z")]] = 1e-3
    results = {
        name: rms_over_runs(errors[:, at]) for name, at in parameters_by_group(machine).items()
    }
    assert list(results) == list(PARAMETER_GROUPS)
    assert [s.value for s in results.values()] == pytest.approx([0, 0, 0, 1e-3, 0])
    assert rms_over_runs(errors).value == pytest.approx(1e-3 * np.sqrt(3 / 30))
    assert max(s.error for s in results.values()) == 0


@pytest.fixture(scope="module")
def near():
    return study(runs=30, seed=5)


@pytest.mark.parametrize("error", [pytest.param(0.005, marks=pytest.mark.slow), 0.02])
def test_thirty_of_thirty_starts(near, error):
    """Without the four steps: stations a few degrees, parameters up to 20 mm off."""
    value = study(runs=30, start_error=error, seed=5)
    assert converged(value) == 30
    for name in (*PARAMETER_GROUPS, *END_EFFECTOR_QUANTITIES):
        there, here = (s.of("joint")[name] for s in (value, near))
        assert there.value == pytest.approx(here.value, rel=1e-5)
    assert near.of(JOINT)["steps"].value < value.of(JOINT)["steps"].value


def test_accuracy_grows_with_the_square_root_of_the_poses():
    rms = [study(runs=25, poses=poses, seed=6).of("joint")["parameters"].value for poses in (8, 32)]
    assert rms[0] / rms[1] == pytest.approx(2, rel=0.25)


def test_extreme_leg_lengths_pay():
    """Design: they halve the offsets' standard deviation against random poses."""
    rms = [
        study(runs=25, extreme=extreme, seed=7).of("bound")["offset"].value
        for extreme in (True, False)
    ]
    assert rms[1] / rms[0] == pytest.approx(2, rel=0.35)


def test_noise_free_measurements_give_the_truth():
    none = AxisNoise(1e-10, 1e-10, 1e-11, 1e-11)
    tiny = HexapodByAxes(poses=4, noise=none, joint_noise=1e-13)
    data = tiny.draw(Batch("hexapod", 3, np.random.SeedSequence(8)))
    stated = replace(data, noise=Noise(3e-6, axis=AxisNoise().sigma()))
    start = start_off_nominal(stated, np.zeros_like(data.theta))
    np.testing.assert_allclose(joint_from_readings(stated, start).theta, data.theta, atol=2e-9)


def test_axis_coordinates_round_trip():
    rng = np.random.default_rng(9)
    a, b = rng.normal(size=(2, 50, 3)) + np.array([0, 0, 4.0])
    a[:, 1], b[:, 1] = np.abs(a[:, 1]) + 0.2, -np.abs(b[:, 1]) - 0.2
    u, point, _, _ = from_coordinates(to_coordinates(a, b))
    d = (b - a) / np.linalg.norm(b - a, axis=-1, keepdims=True)
    np.testing.assert_allclose(u, d, atol=1e-12)
    np.testing.assert_allclose(np.cross(point - a, d), 0, atol=1e-12)
    np.testing.assert_allclose(point[:, 1], 0)


def test_axis_as_edges_is_the_same_measurement():
    """Whitened residuals of the two edges are the axis's coordinates over their deviations,
    up to a turn, whatever the radius: their length is the same."""
    rng = np.random.default_rng(10)
    sigma = AxisNoise().sigma()
    axis = np.stack(
        [
            0.3 * rng.normal(size=30),
            0.3 * rng.normal(size=30),
            0.2 * rng.normal(size=30),
            0.9 + 0.1 * rng.normal(size=30),
        ],
        axis=-1,
    )
    shifted = axis + 1e-3 * sigma * rng.normal(size=axis.shape)
    for radius in (0.005, 0.014, 0.05):
        r = np.full(30, radius)
        basis, whiten = as_edges(axis, sigma, r)
        normal = pair_normals(shifted, r)
        rows = (np.swapaxes(basis, -1, -2) @ normal[..., None]).reshape(30, 4)
        rows = (whiten @ rows[..., None])[..., 0]
        np.testing.assert_allclose(rows, (shifted - axis) / sigma, rtol=0.02, atol=2e-5)


def pair_normals(axis, radius):
    from pkmcal.geometry.cylinders import edge_normal_jacobians

    u, point, _, _ = (x[:, None] for x in from_coordinates(axis))
    n = edge_normal_jacobians(point, point + u, radius[:, None], np.arange(2)).n
    np.testing.assert_allclose(dot(n, point), -radius[:, None] * np.ones(2), atol=1e-12)
    return n


@pytest.mark.slow
def test_the_full_study():
    """Two hundred runs, as the report prints them."""
    full = study(runs=200)
    assert converged(full) == 200
    joint, bound = (full.of(name) for name in ("joint", "bound"))
    assert joint["parameters"].value < 1.05 * bound["parameters"].value
    assert joint["chi2"].value == pytest.approx(1, abs=0.01)
