"""Silhouettes of a whole machine on the edges of one image."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from conftest import FEW_IMPUTATIONS
from page_documents import page_text
from pkmcal.boards.views import Boards
from pkmcal.calibration import handheld, refinement
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.calibration.camera_refinement import edges_by_camera
from pkmcal.calibration.camera_responses import _normal_turn
from pkmcal.calibration.localization import platform_poses, read_images
from pkmcal.calibration.refinement import (
    REFINEMENT,
    RefinementResult,
    _scatter_of,
    _variance,
    imputation_variance,
)
from pkmcal.geometry.rigid import angle_between, inverse, perturb, pose, rotation
from pkmcal.identify.bundle import BundleSolution, bundle
from pkmcal.identify.verdict import POLISHED_SHADING
from pkmcal.measurements import Observation
from pkmcal.mechanisms import load_mechanism
from pkmcal.observe.image_localization import finest_view, refine_local
from pkmcal.observe.pose_likelihood import LIKELIHOOD_OPTIONS
from pkmcal.observe.predict import edge_points, legs_in_camera
from pkmcal.observe.silhouettes import silhouette_edges
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.report.calibration import outcome_of
from pkmcal.session.load import load_session
from pkmcal.simulation import Settings
from pkmcal.simulation.truth import load_truth
from pkmcal.web.report_page import report_document
from rendered import rendered
from test_handheld import at_truth

SETTINGS = Settings(configurations=4, repeats=1, handheld=True, tolerance=0.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("silhouettes") / "session"
    rendered(out, load_mechanism("gough-stewart"), camera_of_size((640, 480)), SETTINGS, seed=3)
    return out


@pytest.fixture(scope="module")
def views(folder):
    """Each image's view, with a machine that is known exactly, and its true pose."""
    session = load_session(folder)
    poses, truth = platform_poses(session), load_truth(folder, session.machine)
    images = read_images(session)
    views = [finest_view(session.machine, p, session.joints, poses) for p in images]
    return list(zip(views, truth.T_camera_base, strict=True))


def off_truth(view, T, edges):
    """Outward errors (n, 2) of edges, in the middle and at the end, in their standard
    deviations.
    """
    legs = legs_in_camera(view.machine, T, view.poses, view.joints)
    points = edge_points(view.machine, view.camera, legs, view.tubes, 2)
    tubes = view.tubes
    number = {
        key: e
        for e, key in enumerate(zip(tubes.leg, tubes.tube, tubes.side, strict=True))
    }  # fmt: skip
    e = [number[key] for key in zip(edges.leg, edges.tube, edges.side, strict=True)]
    off = np.einsum("nij,ni->nj", edges.basis, points.normal[0, e] - edges.normal)
    return np.linalg.solve(np.linalg.cholesky(edges.covariance), off[..., None])[..., 0]


def test_silhouettes_lie_on_the_machine(views):
    """From a pose a few pixels off they give the true one, within their standard deviations."""
    rng = np.random.default_rng(0)
    results = []
    for view, T in views:
        near = perturb(T, rng.normal(size=6) * np.repeat([1e-3, 1e-3], 3))
        look = silhouette_edges(view, near, 7)
        edges = look.edges
        assert np.all(edges.station == 7)
        assert np.all(edges.coarse)
        assert len(look.points) == len(look.point_edge)
        assert set(look.point_edge.tolist()) == set(range(len(edges)))
        results.append(off_truth(view, T, edges))
    off = np.concatenate(results)
    assert len(off) > 40
    # stated with what scatters at most; a machine that is known well is closer
    assert 0.1 < np.sqrt(np.median(np.sum(off**2, axis=1)) / 1.386) < 1
    assert np.mean(np.sum(off**2, axis=1) > 9.2) < 0.05


def test_silhouettes_say_how_they_depend_on_the_camera(views):
    """As their pixels' rays turn with its parameters, so do the planes through them."""
    view, T = views[0]
    edges = silhouette_edges(view, T, 0, refine_camera=True)
    by_camera = edges.edges.by_intrinsics
    in_view = Observation(edges.edges, (), edges.points, edges.point_edge, T[None])
    by_rays = edges_by_camera(in_view, [view.camera])
    size = np.linalg.norm(by_rays[:, 0], axis=-1)
    off = np.linalg.norm((by_camera - by_rays)[:, 0], axis=-1)
    # pixels weigh by how surely they are the machine's, rays all the same
    assert np.median(off / size) < 0.05


def test_coarse_edges_say_nothing_of_how_light_is_coded(views):
    """Silhouettes of edges that could not be measured do not depend on the response."""
    view, T = views[0]
    edges = silhouette_edges(view, T, 0).edges
    measured = replace(edges, coarse=np.arange(len(edges)) % 2 == 1)
    shifted = replace(edges, normal=edges.normal + 1e-3 * edges.basis[..., 0])
    direction = _normal_turn(measured, replace(shifted, coarse=np.arange(len(edges)) % 3 == 2))[
        ..., 0
    ]
    shares = (np.arange(len(edges)) % 2 == 0) & (np.arange(len(edges)) % 3 < 2)
    np.testing.assert_allclose(
        direction[shares], np.broadcast_to([1e-3, 0], (shares.sum(), 2)), atol=1e-12
    )
    assert not direction[~shares].any()


@pytest.mark.parametrize("axis", range(3))
def test_a_place_that_is_off_by_degrees_is_found_again(views, axis):
    view, T = views[1]
    turn = rotation(np.radians(6.0) * np.eye(3)[axis])
    middle = view.machine.base_centers().mean(axis=0) + np.array([0.0, 0.0, 0.15])
    away = T @ pose(turn, middle - turn @ middle)
    scatter = LIKELIHOOD_OPTIONS.last_reach / 4
    (value, _), (there, here) = refine_local(view, np.stack([away, T]), scatter)
    assert np.degrees(angle_between(value, T)) < 0.7
    eye = inverse(np.stack([value, T]))[:, :3, 3]
    assert np.linalg.norm(eye[0] - eye[1]) < 0.02
    assert there == pytest.approx(here, rel=0.03)
    # a pose's result does not depend on those beside it
    (alone,), _ = refine_local(view, away[None], scatter)
    assert np.degrees(angle_between(value, alone)) < 0.05


@pytest.fixture(scope="module")
def calibration(folder):
    case = at_truth(folder)
    return calibrate_session(case.session, case=case)


def test_edges_that_could_not_be_measured_are_found_whole(calibration):
    """In a hand-held image: once each, measured or coarse, and not among the rejected."""
    value = calibration.observation
    edges = value.edges
    assert 0 < edges.coarse.sum() < (~edges.coarse).sum()
    each = np.stack([edges.station, edges.leg, edges.tube, edges.side], axis=1)
    assert len(np.unique(each, axis=0)) == len(edges)
    given_up = {
        (r.station, r.leg, r.tube, r.side) for r in value.rejected if "disagree" not in r.reason
    }
    assert not given_up & set(map(tuple, each.tolist()))
    assert set(value.point_edge.tolist()) == set(range(len(edges)))
    # and distinguished
    values = outcome_of(calibration)
    rows = json.loads(values.texts["calibration.json"])["residuals"]
    coarse = [row[rows["columns"].index("coarse")] for row in rows["edges"]]
    assert coarse == edges.coarse.tolist()
    count = int(edges.coarse.sum())
    text = f"{len(edges) - count} edges measured and {count} from silhouettes"
    page = page_text(report_document(values).model_dump(mode="json"))
    assert text in page
    # the variance between measurement passes is in the standard deviations, and in the message
    variance = calibration.measurements.imputation_covariance
    assert 0.02 < variance < 2
    assert calibration.estimate.statistics.look_scatter == pytest.approx(np.sqrt(variance))
    assert f"results scatter by {np.sqrt(variance):.1f} of the deviations" in page


@pytest.fixture(scope="module")
def tripod_calibration(beside):
    """For the images of the camera on the tripod alone."""
    return calibrate_session(beside[0].parent / "tripod", options=FEW_IMPUTATIONS)


@pytest.mark.slow
def test_looks_scatter_by_their_variance_in_that_of_noise(tripod_calibration):
    """Machines that scatter as noise lets them have one, twice as far apart they have four."""
    calibration = tripod_calibration
    machine, state = calibration.session.machine, calibration.estimate.state
    measurements = replace(calibration.measurements, imputation_covariance=0.0)
    estimate = bundle(machine, measurements, state)
    again = bundle(machine, replace(measurements, imputation_covariance=1.0), state)
    n = len(estimate.state.theta)
    noise = (again.joint_covariance - estimate.joint_covariance)[:n, :n]
    value, vectors = np.linalg.eigh(noise)
    half = vectors * np.sqrt(np.maximum(value, 0.0))
    drawn = estimate.state.theta + np.random.default_rng(0).normal(size=(300, n)) @ half.T
    changes = drawn - estimate.state.theta
    assert _variance(changes, estimate) == pytest.approx(1, rel=0.1)
    assert _variance(2 * changes, estimate) == pytest.approx(4, rel=0.1)


@pytest.fixture(scope="module")
def tripod_solution(tripod_calibration):
    """Solution of an estimate from its last measurement pass."""
    value = tripod_calibration
    return BundleSolution.of(value.session.machine, value.measurements, value.estimate.state)


def turns_of(calibration, solution, shading, images):
    """Result of the last measurement pass, with its edges shaded by so many px, as light moves
    them.
    """
    estimate = calibration.estimate
    noise = replace(estimate.edge_noise, shading=np.full_like(estimate.edge_noise.shading, shading))
    return RefinementResult(
        calibration.observation,
        calibration.measurements,
        replace(estimate, edge_noise=noise),
        calibration.cameras,
        images=images,
        solution=solution,
        options=FEW_IMPUTATIONS,
    )


def passes_from_likely_machines(calibration, value):
    visible = SimpleNamespace(session=calibration.session, boards=Boards())
    return imputation_variance(visible, value, np.random.default_rng(0), lambda *_: None)


@pytest.mark.parametrize(("times", "remeasured"), [(0.9, False), (1.1, True)])
def test_painted_legs_on_a_tripod_are_not_looked_for_again(
    tripod_calibration, tripod_solution, times, remeasured
):
    images = read_images(tripod_calibration.session)
    value = turns_of(tripod_calibration, tripod_solution, times * POLISHED_SHADING, images)
    ended = passes_from_likely_machines(tripod_calibration, value)
    assert (ended is value) != remeasured
    assert (ended.measurements.imputation_covariance > 0) == remeasured


def test_where_no_look_ends_as_much_again_as_noise_is_believed(tripod_calibration, tripod_solution):
    """In images without content no measurement pass finds an edge."""
    empty = [
        replace(p, images=[np.full_like(image, 90) for image in p.images])
        for p in read_images(tripod_calibration.session)
    ]
    value = turns_of(tripod_calibration, tripod_solution, 2 * POLISHED_SHADING, empty)
    ended = passes_from_likely_machines(tripod_calibration, value)
    assert ended.estimate.statistics.look_scatter == 1


@pytest.fixture(scope="module")
def beside(folder, tmp_path_factory):
    """Hand-held images beside a camera on a tripod, and their true poses."""
    out = tmp_path_factory.mktemp("beside")
    tripod = replace(SETTINGS, stations=1, handheld=False)
    machine, camera = load_mechanism("gough-stewart"), camera_of_size((640, 480))
    rendered(out / "tripod", machine, camera, tripod, seed=3)
    shutil.copytree(folder, out / "both")
    shutil.copytree(out / "tripod" / "images", out / "both" / "images", dirs_exist_ok=True)
    first, second = (yaml.safe_load((out / name / "session.yaml").read_text())
                     for name in ("both", "tripod"))  # fmt: skip
    first["stations"] |= second["stations"]
    (out / "both" / "session.yaml").write_text(yaml.safe_dump(first, sort_keys=False))
    assert (out / "both" / "joints.csv").read_text() == (out / "tripod" / "joints.csv").read_text()
    truths = [load_truth(out / name, machine) for name in ("both", "tripod")]
    return out / "both", np.concatenate([truth.T_camera_base for truth in truths])


def test_of_a_camera_on_a_tripod_the_first_image_stands_for_all(beside):
    """Silhouettes are matched in one image of a pose: edges of others are elsewhere."""
    session = load_session(beside[0])
    images, T = read_images(session), beside[1]
    assert [len(p.images) for p in images] == [1, 1, 1, 1, 4]
    rough = perturb(T, 0.01 * np.random.default_rng(5).normal(size=(5, 6)))
    stations = [
        replace(one, T_camera_base=rough[k]) if one.handheld else one
        for k, one in enumerate(session.stations)
    ]
    session = replace(session, stations=tuple(stations))
    case = handheld.localize_case(session, images, Boards(), np.random.default_rng(0))
    scene = case.scene
    assert [len(p.images) for p in case.images] == [1, 1, 1, 1, 4]
    assert sorted(scene.edges) == [0, 1, 2, 3, 4]
    for k, p in enumerate(images):
        assert set(scene.edges[k].configuration.tolist()) == {p.configuration[0]}
    # and lie there where the machine truly is
    one = images[4].select(np.arange(1))
    poses = platform_poses(session)
    view = finest_view(session.machine, one, session.joints, poses)
    off = off_truth(view, T[4], scene.edges[4])
    assert np.median(np.abs(off)) < 1


def test_without_images_by_hand_none_is_searched(tripod_calibration):
    session = tripod_calibration.session
    rng = np.random.default_rng(0)
    value = handheld.localize(session, read_images(session), Boards(), rng)
    assert value.leg_localization is not None
    assert value.places == {}


def test_machines_as_likely_have_their_edges_near(calibration):
    """In pairs to both sides; places, focal lengths and machine are drawn together, so that no leg
    is predicted far from where it is.
    """
    estimate, session = calibration.estimate, calibration.session
    rng = np.random.default_rng(0)
    drawn = list(refinement._as_likely(session, estimate, 6, rng))
    away = np.stack([one.state.theta - estimate.state.theta for one in drawn])
    assert len(drawn) == 6
    np.testing.assert_allclose(away[::2], -away[1::2], atol=1e-4)
    for one in drawn:
        cameras = calibration.cameras.updated(one)
        case = [replace(p, camera=cameras.at_station(p.station)) for p in read_images(session)]
        passes = refinement._measurement_pass(session, case, one, {}, 1.0, True)
        shifted = [station_edges.shift for station_edges in passes]
        assert 0.01 < np.median(shifted) < 0.4


def test_a_machine_that_does_not_settle_is_refused(tripod_calibration):
    """Change of the machine by the last measurement pass, in its standard deviations."""
    results = turns_of(tripod_calibration, None, 0.0, ())
    assert list(results._replace(change=0.9 * REFINEMENT.settled_change).reasons) == []
    (reason,) = results._replace(change=2.5).reasons
    assert reason.code == "estimate.unsettled"
    assert reason.facts["change"] == 2.5


def test_few_coarse_edges_do_not_determine_their_scatter():
    """A few that lie well by chance would count for more than all that was measured."""
    rows = 100
    estimate = SimpleNamespace(
        edge_residuals=np.full((rows, 2), 0.01), edge_weights=np.ones(rows)
    )  # fmt: skip
    assert _scatter_of(np.arange(rows) < 2, estimate) == 1
    assert _scatter_of(np.zeros(rows, dtype=bool), estimate) == 1
    assert _scatter_of(np.ones(rows, dtype=bool), estimate) == pytest.approx(0.01)


def test_edges_of_two_looks_are_matched(views):
    """By position, whatever the order; edges of one pass only have no partner."""
    edges = silhouette_edges(views[0][0], views[0][1], 0).edges
    shuffled = np.random.default_rng(0).permutation(len(edges))[2:]
    mine, theirs = edges.same_as(edges.select(shuffled))
    assert sorted(mine.tolist()) == sorted(shuffled.tolist())
    assert np.array_equal(shuffled[theirs], mine)
    elsewhere = replace(edges, station=edges.station + 1)
    assert [len(part) for part in edges.same_as(elsewhere)] == [0, 0]
    assert [len(part) for part in edges.same_as(edges.select(shuffled[:0]))] == [0, 0]
