"""Identifiable and unidentifiable directions: too few legs, cameras without shared legs, poor
motions.

Never a confident wrong result: either the truth is within the stated standard deviations, however
large, or the verdict refuses, with the reason in words.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from faults import raises
from pkmcal.errors import ResultError
from pkmcal.geometry.rigid import look_at, perturb
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.bundle import bundle
from pkmcal.identify.covariance import Information, identifiability
from pkmcal.identify.gauge import default_gauge, freedoms, generators, in_gauge
from pkmcal.identify.methods.four_step import four_step
from pkmcal.identify.start import start_state
from pkmcal.identify.state import State
from pkmcal.identify.unidentified import explain, observed_legs
from pkmcal.identify.verdict import assess
from pkmcal.measurements import Measurements, Observation
from pkmcal.mechanisms import load_mechanism
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.placement.edges import EdgeNoise, simulate_edges
from pkmcal.placement.stations import default_stations
from pkmcal.simulation import Settings, true_machine
from test_identify_scene import exact
from test_joint_machines import JOINT_NOISE, Session, camera

LARGEST = 1.9
"""Mean of some 42 squared normal deviates that is exceeded once in a thousand times."""


def hexapod():
    return exact("gough-stewart")


def without_radii(machine):
    table = machine.parameters
    radii = tuple(n for n, k in zip(table.names, table.kinds, strict=True) if k == "radius")
    return replace(machine, parameters=table.with_roles(fixed=radii))


def visible_to(session, legs):
    """The session's measurements where station s sees only legs[s]."""
    edges = session.measurements.edges
    keep = np.array([j in legs[s] for j, s in zip(edges.leg, edges.station, strict=True)])
    return replace(session.measurements, edges=edges.select(keep))


def rank_test(machine, measurements, state):
    """The rank test at a state."""
    assembled = assemble(machine, measurements, default_gauge(machine))
    info = Information(assembled.problem, batch_of(machine, assembled, state))
    return identifiability(info, machine)


def surprise(machine, value, state):
    """Squared errors by the whole covariance, per freedom: 1 is expected, frames left out."""
    truth = in_gauge(machine, state, default_gauge(machine))
    error = value.machine.values - machine.parameters.unit_axes(truth.theta)
    sigma = np.sqrt(np.diag(value.covariance))
    free = sigma > 1e-9
    correlation = value.covariance[np.ix_(free, free)] / np.outer(sigma[free], sigma[free])
    values, vectors = np.linalg.eigh(correlation)
    above_limit = values > 1e-9 * values[-1]
    z = vectors[:, above_limit].T @ (error[free] / sigma[free])
    return float(np.mean(z**2 / values[above_limit]))


def verdict(measurements, value):
    nothing = np.zeros((0, 2)), np.zeros(0, dtype=int)
    observation = Observation(measurements.edges, (), *nothing, value.state.T_camera_base)
    observed = observed_legs(
        measurements.edges, value.edge_weights, measurements.n_stations, value.machine.n_legs
    )
    values = identifiability(value.linearized.info, value.machine)
    return assess(observation, value, explain(values, value, observed))


def test_six_turns_of_a_3_upus_axes_are_unknown_and_nothing_else():
    """Errata: a common rotation of each leg's v = v'; with free radii their scale is the seventh.

    The seventh: a platform that only translates determines the legs' directions, not their
    positions; so distances follow from the tubes' radii.
    """
    machine = exact("3-upu")
    for radii, lost in ((False, 6), (True, 7)):
        drawn = machine if radii else without_radii(machine)
        session = Session(drawn, settings=Settings(stations=2, configurations=8, tolerance=0.0))
        count = rank_test(drawn, session.measurements, session.state())
        assert len(count.unidentified) == lost
        frames = generators(machine.layout, machine.values) @ freedoms(drawn)
        unknown = np.linalg.qr(np.concatenate([frames, count.basis.T], axis=1))[0]
        common = common_turns(machine)
        residual = common - unknown @ (unknown.T @ common)
        assert np.abs(residual).max() < 1e-6
        # six more than the frames: with the radii known, these are all
        assert np.linalg.matrix_rank(np.concatenate([frames, common], axis=1)) == 12 + 6


def common_turns(machine):
    """Both rotations of each leg's pair of axes, (P, 6)."""
    columns = []
    for leg in range(machine.n_legs):
        for turn in np.linalg.svd(machine.base_axes()[leg][None])[2][1:]:
            column = np.zeros(len(machine.parameters))
            column[machine.layout.base_axis[leg]] = turn
            column[machine.layout.platform_axis[leg]] = turn
            columns.append(column)
    return np.stack(columns, axis=1)


def test_one_camera_sees_four_legs_of_six():
    """Readings of all six, and the pose from the four, determine the two without images."""
    machine = hexapod()
    session = Session(machine, stations=1, configurations=20)
    measurements = visible_to(session, [[0, 1, 2, 3]])
    value = rank_test(machine, measurements, session.state())
    # for the two legs without images only the tubes are unidentified, two parameters each
    names = {n for d in value.unidentified for n in d.names}
    assert len(value.unidentified) == 4
    assert names == {f"legs[{j}].tubes[{t}].radius" for j in (5, 6) for t in (1, 2)}
    estimate = bundle(machine, measurements, session.guess(np.random.default_rng(0), measurements))
    assert surprise(machine, estimate, session.state()) < LARGEST
    assert verdict(measurements, estimate).usable


@pytest.mark.parametrize("board", [False, True])
def test_three_cameras_that_share_no_leg(board):
    """Two configurations a camera leave their places to each other open; a board closes that."""
    machine = hexapod()
    boards = ("base",) if board else ()
    session = Session(machine, stations=3, configurations=2, boards=boards)
    measurements = visible_to(session, [[0, 1], [2, 3], [4, 5]])
    count = rank_test(machine, measurements, session.state())
    assert len(count.unidentified) == (0 if board else 12)
    estimate = bundle(machine, measurements, session.guess(np.random.default_rng(0), measurements))
    if not board:
        refused = verdict(measurements, estimate)
        assert not refused.usable
        assert "never seen together" in " ".join(refused.reasons)


def test_three_cameras_that_share_no_leg_and_the_four_steps():
    """[A] 3.3: they need shared legs or a board; the joint estimate needs only configurations."""
    machine = hexapod()
    for boards in ((), ("base",)):
        settings = Settings(stations=2, configurations=15, shared=True, joint_noise=JOINT_NOISE)
        session = Session(machine, stations=2, boards=boards, settings=settings)
        measurements = visible_to(session, [[0, 2, 4], [1, 3, 5]])
        if boards:
            state = four_step(machine, measurements)
            error = normalised_steps(machine, state, session.state())
            assert error < 0.01
        else:
            with raises(ResultError, code="method.stations_apart"):
                four_step(machine, measurements)
        guess = session.guess(np.random.default_rng(0), measurements)
        estimate = bundle(machine, measurements, guess)
        assert surprise(machine, estimate, session.state()) < LARGEST
        assert verdict(measurements, estimate).usable


def normalised_steps(machine, state, truth):
    """RMS (m) of the base centres by the four steps."""
    gauge = default_gauge(machine)
    index = np.concatenate([g.index[:, :3] for g in machine.layout.base])
    values, true = (in_gauge(machine, s, gauge).theta[index] for s in (state, truth))
    return np.sqrt(np.mean((values - true) ** 2))


def measured(machine, poses, T_camera_base, seed=0):
    """A true machine in given poses, with cameras at given places; its measurements and state."""
    rng = np.random.default_rng(seed)
    true = true_machine(machine, 1.0, rng)
    noise = EdgeNoise(shift=0.1, tilt=0.1)
    edges, joints = simulate_edges(
        true, T_camera_base, camera(), poses, noise, rng, joint_noise=JOINT_NOISE
    )
    n = len(T_camera_base)
    measurements = Measurements(edges, joints, JOINT_NOISE, n, np.zeros(n, dtype=int))
    return measurements, State(true.values, T_camera_base, poses)


def steps(n, column, size):
    out = np.zeros((n, 6))
    out[:, column] = np.linspace(-size, size, n)
    return out


def heave(machine):
    return perturb(machine.home(), steps(12, 5, 0.05))


def one_leg_moving(machine):
    joints = np.repeat(machine.inverse(machine.home()[None]), 12, axis=0)
    joints[:, 2] += np.linspace(-0.04, 0.04, 12)
    return machine.forward(joints)


def one_configuration(machine):
    return machine.home()[None]


def wide(machine):
    return perturb(machine.home(), np.random.default_rng(3).normal(size=(12, 6)) * 0.04)


def around(machine):
    places = default_stations(machine, (camera(),) * 2, np.random.default_rng(3))
    return np.stack([place.T_camera_base() for place in places])


def along_a_leg(machine):
    """A camera on the first leg's line: that leg is a disc in its images."""
    home = machine.home()
    ends = limb_ends(machine.layout, machine.values, machine.inverse(home[None])[0], home)
    eye = ends.a[0] + 3 * (ends.b[0] - ends.a[0])
    return look_at(eye, ends.a[0], np.array([0, 1.0, 0]))[None]


def upright(document):
    """Legs upright, so parallel to the images' columns while the platform only heaves."""
    for k, leg in enumerate(document["legs"]):
        place = [0.2 * np.cos(k * np.pi / 3), 0.2 * np.sin(k * np.pi / 3), 0.0]
        leg["base"]["center"] = leg["platform"]["center"] = [float(x) for x in place]
    document["home"] = {"position": [0, 0, 0.4]}
    return document


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
@pytest.mark.parametrize(
    ("poses", "places"),
    [(heave, around), (one_leg_moving, around), (one_configuration, around), (wide, along_a_leg)],
)
def test_poor_data_give_large_deviations_or_a_refusal(poses, places, seed):
    machine = hexapod()
    measurements, truth = measured(machine, poses(machine), places(machine), seed)
    rough = np.random.default_rng(seed).normal(size=(len(truth.T_camera_base), 6))
    rough = perturb(truth.T_camera_base, rough * np.repeat([0.02, 0.01], 3))
    fit = bundle(machine, measurements, start_state(machine, measurements, rough))
    assert surprise(machine, fit, truth) < LARGEST


def test_upright_legs_that_only_heave_are_refused(tmp_path):
    import yaml

    path = tmp_path / "upright.yaml"
    path.write_text(yaml.safe_dump(upright(hexapod().to_document())))
    machine = load_mechanism(path)
    places = [np.array([0.9 * np.cos(a), 0.9 * np.sin(a), 0.2]) for a in (0.2, 2.4)]
    target, up = np.array([0, 0, 0.2]), np.array([0, 0, 1.0])
    stations = np.stack([look_at(place, target, up) for place in places])
    measurements, _ = measured(machine, heave(machine), stations)
    fit = bundle(machine, measurements, start_state(machine, measurements, stations))
    refused = verdict(measurements, fit)
    assert not refused.usable
    (singular,) = refused.of("configurations.singular")
    assert (singular.facts["number"], singular.facts["of"]) == (12, 12)
    assert "one direction each" in " ".join(refused.warnings)


def test_one_configuration_is_refused():
    machine = hexapod()
    measurements, truth = measured(machine, one_configuration(machine), around(machine))
    fit = bundle(machine, measurements, start_state(machine, measurements, truth.T_camera_base))
    assert not verdict(measurements, fit).usable
