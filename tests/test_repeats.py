"""Repeated images: one edge of several, their scatter as noise, and [A] Table 1 from them."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace

import numpy as np
import pytest

import pkmcal
from conftest import FEW_IMPUTATIONS, run
from faults import raises
from pkmcal.api.check import CheckResult
from pkmcal.calibration.calibrate import Calibration, calibrate_session
from pkmcal.errors import InputError
from pkmcal.files import json_text
from pkmcal.geometry.cylinders import tangent_basis
from pkmcal.geometry.rigid import dot, look_at, perturb
from pkmcal.identify.axis_measurements import to_coordinates
from pkmcal.judge.against_truth import compare_with_truth
from pkmcal.judge.repeatability import (
    Cylinders,
    RepeatStudy,
    _station_row,
    _StationEdges,
    axis_coordinates,
    by_ends,
    fit_motions,
    repeat_findings,
    require_repeats,
    scatter_of_repeats,
    study_repeats,
)
from pkmcal.measurements import concatenate
from pkmcal.mechanisms import load_mechanism
from pkmcal.observe.legs import StationEdges
from pkmcal.observe.predict import legs_in_camera
from pkmcal.observe.repeats import (
    combine_repeats,
    groups_of,
    mean_covariance,
    mean_edges,
    pixel_units,
    repeat_scatter,
    same_edges,
)
from pkmcal.outcome import Level
from pkmcal.placement.configurations import draw_configurations
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.placement.edges import EdgeNoise, simulate_edges
from pkmcal.session.load import load_session
from pkmcal.simulation import Settings, load_truth
from rendered import rendered

CAMERA = camera_of_size((640, 480))
STATION = look_at(np.array([0.1, -0.9, 0.25]), np.array([0.0, 0.0, 0.2]), np.array([0, 0, 1.0]))


@pytest.fixture(scope="module")
def machine():
    return load_mechanism("gough-stewart")


@pytest.fixture(scope="module")
def poses(machine):
    return draw_configurations(machine, 40, 0.5, np.random.default_rng(1))[0]


def edges_of(machine, poses, T_camera_base=STATION, shift=0.1):
    """All edges of a station; those of one seed differ only by the machine's motion."""
    noise = EdgeNoise(shift=shift, tilt=shift)
    rng = np.random.default_rng(3)
    return simulate_edges(machine, T_camera_base[None], CAMERA, poses, noise, rng)[0]


def turned(edges, turn):
    """Edges whose normals are turned by (N, 2) rad in their tangent bases."""
    normal = edges.normal + (edges.basis @ turn[..., None])[..., 0]
    normal /= np.sqrt(dot(normal, normal))[:, None]
    return replace(edges, normal=normal, basis=tangent_basis(normal, edges.basis[..., 0]))


def repeated(edges, n, pixels, rng):
    """n repeats of every edge, each with its own noise of (shift, tilt) in pixel units."""
    scale = pixel_units(edges) * pixels
    return concatenate(
        [turned(edges, scale * rng.standard_normal((len(edges), 2))) for _ in range(n)]
    )


def look_of(edges):
    """Edges of one station with one point for each edge, which encodes the edge's number."""
    number = np.arange(len(edges))
    points = np.stack([number, number], axis=1).astype(float)
    return StationEdges(edges, (), points, number, 0.7, 0.1)


def keys(edges):
    return np.stack([edges.configuration, edges.leg, edges.tube, edges.side], axis=1)


# groups


def test_medians_and_exchanges_stay_inside_their_group():
    rng = np.random.default_rng(0)
    key, values = rng.integers(0, 9, 200), rng.standard_normal((200, 3))
    groups = groups_of(key)
    medians = groups.median(values)
    for k, name in enumerate(np.unique(key)):
        assert np.allclose(medians[k], np.median(values[key == name], axis=0))
    exchanged = groups.exchanged(rng)
    assert sorted(exchanged) == list(range(200))
    assert np.array_equal(key[exchanged], key)
    assert np.mean(exchanged == np.arange(200)) < 0.2


# one edge of several


def test_a_look_without_repeats_is_left_as_it_is(machine, poses):
    edges = look_of(edges_of(machine, poses[:3]))
    assert combine_repeats(edges) is edges


def test_repeats_become_one_edge_at_their_mean_and_keep_their_points(machine, poses):
    edges = edges_of(machine, poses[:6])
    look = look_of(repeated(edges, 5, 0.02, np.random.default_rng(0)))
    one = combine_repeats(look)
    assert np.array_equal(keys(one.edges), keys(edges.select(same_edges(edges).first)))
    assert not one.rejected
    number = one.points[:, 0].astype(int)
    assert np.array_equal(number, np.arange(len(look.edges)))
    assert np.array_equal(keys(one.edges)[one.point_edge], keys(look.edges)[number])
    assert np.allclose(dot(one.edges.normal, one.edges.normal), 1)
    cross = np.einsum("nij,ni->nj", one.edges.basis, one.edges.normal)
    assert np.abs(cross).max() < 1e-12
    off = np.einsum("nij,ni->nj", edges.basis, one.edges.normal - edges.normal)
    off /= pixel_units(edges) * 0.02 / np.sqrt(5)
    assert np.sqrt(np.mean(off**2)) == pytest.approx(1, abs=0.08)


def test_the_scatter_is_measured_by_leg(machine, poses):
    edges = edges_of(machine, poses)
    pixels = np.where(edges.leg == 2, 0.3, 0.05)[:, None]
    many = repeated(edges, 4, pixels, np.random.default_rng(0))
    groups = same_edges(many)
    values = np.sqrt(repeat_scatter(many, groups)[:, [0, 1], [0, 1]])
    values /= pixel_units(edges.select(same_edges(edges).first))
    leg = many.leg[groups.first]
    assert np.sqrt(np.mean(values[leg == 2] ** 2)) == pytest.approx(0.3, rel=0.06)
    assert np.sqrt(np.mean(values[(leg != 2)] ** 2)) == pytest.approx(0.05, rel=0.06)


@pytest.mark.parametrize(
    ("count", "share", "inside"),
    [
        (1, 0.4, True),
        *((10, share, share < 1) for share in (0.1, 0.4, 3.0)),
        *(pytest.param(count, share, share < 1, marks=pytest.mark.slow)
          for count, share in ((1, 0.1), (1, 3.0), (3, 0.1), (3, 0.4), (3, 3.0))),
    ],
)  # fmt: skip
def test_errors_agree_with_their_deviations_for_any_number_of_repeats(
    machine, poses, count, share, inside
):
    """Shading is common to all repeats. Scatter within the stated covariance: sensor noise; beyond
    it: a shaken camera. Single images of three configurations are beside the repeats.
    """
    exact = edges_of(machine, poses, shift=1e-9)
    pixels = 0.1 * np.sqrt([1 - share if inside else 1.0, share])
    rng = np.random.default_rng(5)
    shaded = turned(exact, pixel_units(exact) * pixels[0] * rng.standard_normal((len(exact), 2)))
    many = repeated(shaded, max(count, 3), pixels[1], rng)
    if count == 1:  # the scatter is known from other configurations
        first = np.arange(len(many)) < len(exact)
        many = many.select(first | (many.configuration < 10))
    unit = pixel_units(many) * 0.1
    many = replace(many, covariance=np.eye(2) * unit[:, :, None] ** 2)
    groups = same_edges(many)
    one = mean_edges(many, groups)
    exact = exact.select(same_edges(exact).first)
    counted = groups.count == count
    error = np.einsum("nij,ni->nj", one.basis, one.normal - exact.normal)[counted]
    white = np.linalg.solve(np.linalg.cholesky(one.covariance[counted]), error[..., None])
    assert np.sqrt(np.mean(white**2)) == pytest.approx(1, abs=0.05)


def test_between_noise_and_motion_half_of_the_stated_variance_is_the_least():
    share = np.geomspace(1e-3, 1e3, 200)
    scatter = share[:, None, None] * np.eye(2)
    stated = np.broadcast_to(np.eye(2), scatter.shape)
    endless = mean_covariance(stated, scatter, np.full(200, 10**9))[:, 0, 0]
    assert endless.min() == pytest.approx(0.5, abs=0.02)
    assert endless[-1] == pytest.approx(1, abs=1e-5)
    single = mean_covariance(stated, scatter, np.ones(200))[:, 0, 0]
    assert (single >= np.maximum(share, 1) - 1e-9).all()


def spoiled(many, rows, pixels):
    turn = np.zeros((len(many), 2))
    turn[rows, 0] = pixels * pixel_units(many)[rows, 0]
    return turned(many, turn)


def test_a_bad_repeat_is_left_out_and_reported(machine, poses):
    edges = edges_of(machine, poses[:6])
    many = repeated(edges, 5, 0.02, np.random.default_rng(0))
    good, bad = combine_repeats(look_of(many)), combine_repeats(look_of(spoiled(many, [7], 1.0)))
    (values,) = bad.rejected
    assert (values.configuration, values.leg, values.tube, values.side) == tuple(keys(many)[7])
    assert values.reason.startswith("a repeat lies 9.")
    assert values.reason.endswith("standard deviations from the others, which are used without it")
    assert 7 not in bad.points[:, 0]
    assert len(bad.points) == len(many) - 1
    off = np.linalg.norm(good.edges.normal - bad.edges.normal, axis=1)
    assert off.max() < 0.02 * pixel_units(edges)[:, 0].max()


def test_repeats_without_a_majority_are_left_out(machine, poses):
    edges = edges_of(machine, poses[:6])
    many = repeated(edges, 2, 0.02, np.random.default_rng(0))
    one = combine_repeats(look_of(spoiled(many, [7], 1.0)))
    (values,) = one.rejected
    assert values.reason.startswith("its repeats lie up to 4.9 ")
    assert values.reason.endswith("standard deviations off, and no majority agrees")
    assert len(one.edges) == len(edges) - 1
    assert len(one.points) == len(many) - 2


def test_an_edge_that_shows_now_and_then_is_left_out(machine, poses):
    edges = edges_of(machine, poses[:6])
    many = repeated(edges, 4, 0.02, np.random.default_rng(0))
    late = np.arange(len(many)) >= 2 * len(edges)
    one = combine_repeats(look_of(many.select(~((keys(many) == keys(many)[7]).all(axis=1) & late))))
    (values,) = one.rejected
    assert values.reason == "measured in only 2 of 4 repeats"
    assert len(one.edges) == len(edges) - 1


# what moves


def test_axis_coordinates_are_the_derivatives_of_the_papers():
    rng = np.random.default_rng(0)
    a = rng.uniform(-0.2, 0.2, (50, 3)) + np.array([0, 0, 1.0])
    b = a + rng.uniform(-0.3, 0.3, (50, 3)) + np.array([0, -0.5, 0])
    motion = 1e-6 * rng.standard_normal((50, 6))
    ahead, back = (to_coordinates(a + s * motion[:, :3], b + s * motion[:, 3:]) for s in (1, -1))
    assert np.allclose(axis_coordinates(motion, a, b), (ahead - back) / 2, rtol=0, atol=1e-12)


def test_a_leg_level_in_the_image_has_directions_only():
    a, b = np.array([[-0.2, 0.1, 1.0]]), np.array([[0.2, 0.1, 1.1]])
    change = axis_coordinates(np.full((1, 6), 1e-6) * np.arange(6), a, b)
    assert np.isfinite(change[:, :2]).all()
    assert np.isnan(change[:, 2:]).all()


def cylinders_of(machine, poses, edges):
    legs = legs_in_camera(machine, STATION, poses, machine.inverse(poses))
    radii = machine.radii()
    radius = np.array([radii[j][t] for j, t in zip(edges.leg, edges.tube, strict=True)])
    return Cylinders(
        legs.a[edges.configuration, edges.leg], legs.b[edges.configuration, edges.leg], radius
    )


def test_a_fitted_axis_is_where_the_leg_went(machine, poses):
    poses = poses[:6]
    both_poses = poses, perturb(poses, np.full(6, 1e-5))
    edges, shifted = (edges_of(machine, p, shift=1e-9) for p in both_poses)
    cylinders, other = (cylinders_of(machine, p, edges) for p in both_poses)
    assert np.array_equal(keys(edges), keys(shifted))
    turn = np.einsum("nij,ni->nj", edges.basis, shifted.normal - edges.normal)
    groups = groups_of(edges.configuration, edges.leg)
    whiten = np.broadcast_to(np.eye(2), (len(edges), 2, 2))
    fit = fit_motions(turn, by_ends(edges, edges.basis, cylinders), whiten, groups)
    sides = groups.total(edges.side[:, None] == np.array([0, 1]))
    both = (sides > 0).all(axis=1)
    first = groups.first
    value = axis_coordinates(fit.motion, cylinders.a[first], cylinders.b[first])[both]
    true = to_coordinates(other.a[first], other.b[first])
    true = (true - to_coordinates(cylinders.a[first], cylinders.b[first]))[both]
    finite = np.isfinite(value).all(axis=1)
    assert finite.sum() > 20
    assert np.abs(value - true)[finite].max() < 0.05 * np.abs(true[finite]).max()


def motion_look(machine, poses, edges, rng):
    """Edges of 6 repeats of all configurations; edges(repeat) gives those of one."""
    sets = [edges(r) for r in range(6)]
    common = set.intersection(*({tuple(k) for k in keys(e)} for e in sets))
    sets = [e.select(np.array([tuple(k) in common for k in keys(e)])) for e in sets]
    many = concatenate([repeated(e, 1, 0.02, rng) for e in sets])
    photo = np.repeat(np.arange(6), len(sets[0])) * len(poses) + many.configuration
    same = same_edges(many)
    reference = same.first[same.member]
    turn = np.einsum("nij,ni->nj", many.basis[reference], many.normal - many.normal[reference])
    turn -= same.mean(turn)[same.member]
    cylinders = cylinders_of(machine, poses, many)
    return _StationEdges(0, many, photo, cylinders, same, turn, many.basis[reference], 0)


def shaken_machine(machine, rng):
    """A machine whose legs' joints moved by a fifth of a millimetre, each by itself."""
    values = machine.values.copy()
    centres = machine.parameters.of_kind("center")
    values[centres] += 2e-4 * rng.standard_normal(values[centres].shape)
    return machine.with_values(values)


@pytest.mark.parametrize("cause", ["noise", "camera", "platform", "legs"])
def test_motion_between_repeats_is_detected(machine, poses, cause):
    poses, rng = poses[:5], np.random.default_rng(7)
    twist = np.repeat([5e-4, 5e-5], 3)

    def edges(_repeat):
        if cause == "camera":
            shifted = perturb(np.eye(4), twist * rng.standard_normal(6))
            return edges_of(machine, poses, shifted @ STATION)
        if cause == "platform":
            return edges_of(machine, perturb(poses, 3e-4 * rng.standard_normal((5, 6))))
        if cause == "legs":
            return edges_of(shaken_machine(machine, rng), poses)
        return edges_of(machine, poses)

    value = _station_row(motion_look(machine, poses, edges, rng), "front")
    assert value.cause == cause
    if cause == "noise":
        assert abs(value.camera) < 0.05
        assert abs(value.platform) < 0.05
        assert abs(value.legs) < 0.1
        assert value.shift == pytest.approx(0.02, rel=0.1)
        assert value.promised == pytest.approx(0.2, rel=0.5)
    else:
        assert getattr(value, cause) > 0.5


def test_two_edges_of_a_leg_say_nothing_of_its_motion(machine, poses):
    """They look like a motion however they scatter; identical repeats have none at all."""
    rng = np.random.default_rng(8)
    one_tube = edges_of(machine, poses[:5])
    one_tube = one_tube.select(one_tube.tube == 0)
    edges = motion_look(machine, poses[:5], lambda _repeat: one_tube, rng)
    count = _station_row(edges, "front")
    assert count.legs == 0.0
    assert count.cause == "noise"
    with np.errstate(all="raise"):
        still = _station_row(replace(edges, turn=0 * edges.turn), "front")
    assert (still.camera, still.platform, still.legs, still.cause) == (0.0, 0.0, 0.0, "noise")


def test_repeats_without_an_edge_in_common_are_no_accuracy():
    (finding,) = repeat_findings(())
    assert finding.level is Level.DOUBTFUL
    assert finding.text.startswith("No edge shows in two images")


# whole sessions


def simulated(folder, repeats, *, size=(400, 300), **more):
    settings = Settings(**{"stations": 2, "configurations": 4, "repeats": repeats, **more})
    nominal = load_mechanism("gough-stewart")
    return rendered(folder, nominal, camera_of_size(size), settings, seed=5)


@pytest.fixture(scope="module")
def repeats(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("repeats") / "session", 3)


def test_the_first_repeat_is_the_image_of_a_session_without(tmp_path):
    small = {"size": (120, 90), "stations": 1, "configurations": 2}
    single, repeats = (simulated(tmp_path / str(n), n, **small) for n in (1, 2))
    for path in sorted((single / "images" / "station1").iterdir()):
        first = repeats / "images" / "station1" / f"{path.stem}_1.png"
        second = repeats / "images" / "station1" / f"{path.stem}_2.png"
        assert path.read_bytes() == first.read_bytes()
        assert path.read_bytes() != second.read_bytes()
    assert "repeat" not in (single / "session.yaml").read_text()
    assert "repeats" not in (single / "truth.json").read_text()
    assert load_truth(repeats, load_session(repeats).machine).repeats == 2
    assert len(load_session(repeats).stations[0].images) == 4


def test_repeats_do_not_promise_more_than_they_hold(repeats, measured_repeats, tmp_path):
    """The standard deviations of one image's calibration, hardly less with four: the error is
    shading, the same in all of them.
    """
    single = tmp_path / "session"
    shutil.copytree(repeats, single)
    for path in single.glob("images/*/*_[234].png"):
        path.unlink()
    one, four = calibrate_session(single, options=FEW_IMPUTATIONS), measured_repeats.calibration
    sigma = [np.sqrt(np.diag(c.estimate.covariance)) for c in (one, four)]
    above_limit = sigma[0] > 1e-9
    assert 0.7 < np.median(sigma[1][above_limit] / sigma[0][above_limit]) < 1.1
    result = compare_with_truth(four, repeats)
    assert result.within / result.count > 0.85
    edges = four.observation.edges
    assert len(same_edges(edges).first) == len(edges)
    assert four.observation.point_edge.max() < len(edges)


@dataclass(frozen=True)
class Repeats:
    """The study of the repeats, and the calibration it is made of."""

    study: RepeatStudy
    calibration: Calibration


@pytest.fixture(scope="module")
def measured_repeats(repeats):
    calibration = calibrate_session(repeats, options=FEW_IMPUTATIONS)
    return Repeats(scatter_of_repeats(calibration), calibration)


@pytest.fixture
def with_repeats(measured_repeats, checked):
    """Result of ``check --repeat``; its other part is the demonstration's, not tested here."""
    return CheckResult.of(checked.result, repeat=True, repeats=measured_repeats.study)


def test_check_repeat_gives_table_1(with_repeats, checked):
    text = with_repeats.summary()
    assert with_repeats.exit_code == CheckResult.of(checked.result).exit_code
    assert "upper bound" in text
    row = next(line for line in text.splitlines() if line.startswith("[A] Table 1"))
    assert row.split()[3:] == ["0.05°", "0.06°", "0.05", "mm", "0.1", "mm"]
    assert "neither the camera nor the machine moves: sensor noise" in " ".join(text.split())
    assert "more repeats will hardly help" in " ".join(text.split())


def test_check_repeat_as_json(with_repeats, checked):
    plain, values = (
        json.loads(json_text(one.document))
        for one in (CheckResult.of(checked.result), with_repeats)
    )
    value = values["repeats"]
    assert "repeats" not in plain
    assert {k: v for k, v in values.items() if k != "repeats"} == plain
    assert value["paper"]["psi"] == pytest.approx(np.radians(0.05))
    legs = value["legs"]
    assert {(row["station"], row["leg"]) for row in legs} == {
        (f"station{s}", leg) for s in (1, 2) for leg in range(1, 7)
    }
    for name in ("psi", "theta", "x", "z", "shift", "tilt"):
        reference_values = [row[name] for row in legs if row[name] is not None]
        assert value["bound"][name] == max(reference_values)
    # a pixel's noise of a few grey levels' share: hundredths of a pixel an edge
    assert 0.005 < value["middle"]["shift"] < 0.08
    assert all(0 < row["promised"] < 1 for row in legs)
    assert [s["cause"] for s in value["stations"]] == ["noise", "noise"]


@pytest.mark.slow
def test_a_shaken_camera_is_reported(tmp_path, checked):
    shaken = {"shake": (3e-5, 5e-4), "stations": 1, "configurations": 3, "size": (360, 270)}
    folder = simulated(tmp_path / "session", 3, **shaken)
    result = CheckResult.of(checked.result, repeat=True, repeats=study_repeats(folder))
    assert result.exit_code == 1
    repeats = result.document["repeats"]
    (station,) = repeats["stations"]
    assert station["cause"] == "camera"
    assert station["camera"] > 0.7
    assert station["promised"] > 1
    text = repeats["findings"][0]["text"]
    assert "as if the camera moved: fix the camera" in text


def test_a_study_of_repeats_without_repeats_states_what_to_write(demo):
    with raises(InputError, code="session.no_repeats") as caught:
        study_repeats(demo.session)
    assert caught.value.expected.endswith("images/station1/{configuration}_{repeat}.png")
    assert "images/station1/0001_1.png" in caught.value.next_step


def test_check_repeat_without_repeats_is_refused_before_the_work(demo):
    shares = []
    with raises(InputError, code="session.no_repeats"):
        pkmcal.check(demo.session, repeat=True, progress=lambda _text, share: shares.append(share))
    assert max(shares) < 0.05


def test_repeats_are_asked_of_cameras_that_stand(demo):
    """Hand-held images have a pose each, and none in session.yaml."""
    session = load_session(demo.session)
    first, *rest = session.stations
    by_hand = replace(first, name="by hand/1", handheld=True)
    where = f"session.yaml, stations.{rest[0].name}.images"
    with raises(InputError, code="session.no_repeats", where=where):
        require_repeats(replace(session, stations=(by_hand, *rest)))
    for stations in ((by_hand,), ()):
        with raises(InputError, code="session.no_repeats", where="session.yaml, stations"):
            require_repeats(replace(session, stations=stations))


def test_check_repeat_of_a_broken_session_states_what_is_broken(session):
    (session / "joints.csv").unlink()
    values = run("check", session, "--repeat", "--json")
    assert values.code == 2
    assert values.json["repeats"] is None


def test_points_on_an_edge_project_where_the_turn_states(machine, poses):
    """Pixel units: a turn by one moves the edge's middle by about a pixel in the image."""
    edges = edges_of(machine, poses[:2], shift=1e-9)
    legs = legs_in_camera(machine, STATION, poses[:2], machine.inverse(poses[:2]))
    a, u = (v[edges.configuration, edges.leg] for v in (legs.a, legs.u))
    middle = a + edges.span.mean(axis=1)[:, None] * u
    ray = middle / np.linalg.norm(middle, axis=1)[:, None]
    shifted = turned(edges, pixel_units(edges) * [1.0, 0.0])
    offset = [np.arcsin(dot(e.normal, ray)) for e in (edges, shifted)]
    pixel = 1 / CAMERA.parameters[0]
    assert np.allclose(np.abs(offset[1] - offset[0]), pixel, rtol=0.4)
