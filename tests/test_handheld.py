"""Hand-held images: the format, EXIF, and a session in which each image has a pose of its own."""

import json
import re
import shutil
from dataclasses import replace
from io import BytesIO
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from conftest import FEW_IMPUTATIONS
from faults import raises, replaced
from pkmcal.boards.views import Boards
from pkmcal.calibration import handheld
from pkmcal.calibration.calibrate import better_refined, calibrate_session, worse_refined
from pkmcal.calibration.case import Case, PriorScene
from pkmcal.calibration.handheld import (
    CAMERA_TURNED_REASON,
    EDGES_DISAGREE_REASON,
    few_legs_reason,
    inconsistent_poses,
    without_stations,
)
from pkmcal.calibration.localization import platform_poses, read_images
from pkmcal.calibration.localization_cache import (
    image_name,
    remember_image,
    remember_session,
    remembered_session,
    session_name,
)
from pkmcal.calibration.pose_scoring import (
    EvaluatedPose,
    evaluate_poses,
    register_images,
    rescore_poses,
)
from pkmcal.calibration.results import calibration_document
from pkmcal.checks.check import check_session
from pkmcal.errors import InputError, ResultError
from pkmcal.files import Exif, open_image, read_exif, with_exif
from pkmcal.files.cache import cache_folder
from pkmcal.geometry.rigid import (
    angle_between,
    apply,
    look_at,
    perturb,
    pose,
    pose_difference,
    rotation,
)
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.gauge import default_gauge
from pkmcal.judge.new_data import measured_new_data
from pkmcal.measurements import OWN_SHADING, SHADING_SIGMA
from pkmcal.measurements.effects import FOCAL_EXCESS, FOCAL_SIGMA, SHADING
from pkmcal.mechanisms import load_mechanism
from pkmcal.observe import legs
from pkmcal.observe.distance_tables import distance_tables
from pkmcal.observe.image_localization import (
    PoseHypotheses,
    finest_view,
    localize_image,
    localize_near,
    log_prior_by_hand,
    symmetric_poses,
)
from pkmcal.observe.images import decode
from pkmcal.observe.pose_likelihood import StationView, likelihood_from
from pkmcal.observe.station_localization import LOCALIZATION_OPTIONS
from pkmcal.observe.tubes import TUBE_CHART_OPTIONS, tube_chart
from pkmcal.outcome import Verdict
from pkmcal.outcome.finding import Level
from pkmcal.outcome.progress import no_progress
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.placement.stations import rough_poses
from pkmcal.report.calibration import outcome_of
from pkmcal.session.exif import camera_by_exif
from pkmcal.session.load import load_session
from pkmcal.simulation import Settings
from pkmcal.simulation.truth import load_truth
from rendered import rendered

SESSION = """\
pkmcal: 1
mechanism: gough-stewart
joints: {file: joints.csv, noise: 3.0e-6}
stations:
  phone:
    camera: cameras/phone.yaml
    images: images/phone/{configuration}-{repeat}.jpg
    observe: legs
    handheld: true
"""
CAMERA = "model: pinhole\nimage_size: [8, 6]\nfocal: [9.0, 9.0]\ncenter: [3.5, 2.5]\n"
JOINTS = """\
configuration,leg1,leg2,leg3,leg4,leg5,leg6
0000,0.36,0.37,0.38,0.39,0.40,0.41
0001,0.46,0.45,0.44,0.43,0.42,0.40
"""
EASIEST = 0
"""The simulated image with the most visible legs."""
NONE = np.zeros((0, 4, 4))
PICTURE = np.arange(48, dtype=np.uint8).reshape(6, 8) * 5


def jpeg(path, exif=None, picture=PICTURE):
    path.parent.mkdir(parents=True, exist_ok=True)
    ok, data = cv2.imencode(".jpg", picture)
    assert ok
    path.write_bytes(data.tobytes() if exif is None else with_exif(data.tobytes(), exif))
    return path


@pytest.fixture
def folder(tmp_path):
    """Two configurations, one of them with images from two places."""
    (tmp_path / "cameras").mkdir()
    (tmp_path / "session.yaml").write_text(SESSION)
    (tmp_path / "cameras" / "phone.yaml").write_text(CAMERA)
    (tmp_path / "joints.csv").write_text(JOINTS)
    for name in ("0000-1", "0000-2", "0001-1"):
        jpeg(tmp_path / "images" / "phone" / f"{name}.jpg", Exif(6, 26.0))
    return tmp_path


# EXIF


def exif_of(data):
    return read_exif(open_image(BytesIO(data), "a.jpg"))


def test_exif_is_read_as_it_was_written(tmp_path):
    data = jpeg(tmp_path / "a.jpg").read_bytes()
    assert exif_of(data) == Exif(1, None)
    assert exif_of(with_exif(data, Exif(8, 26.0))) == Exif(8, 26.0)
    assert exif_of(with_exif(data, Exif(3, None))) == Exif(3, None)


def test_exif_of_either_byte_order(tmp_path):
    """A segment as telephones write it in little-endian, built by hand from the standard."""

    def entry(tag, kind, value):
        return b"".join(
            n.to_bytes(size, "little") for n, size in ((tag, 2), (kind, 2), (1, 4), (value, 4))
        )

    first = (2).to_bytes(2, "little") + entry(0x0112, 3, 6) + entry(0x8769, 4, 38) + bytes(4)
    own = (1).to_bytes(2, "little") + entry(0xA405, 3, 28) + bytes(4)
    block = b"Exif\0\0II*\0" + (8).to_bytes(4, "little") + first + own
    plain = jpeg(tmp_path / "a.jpg").read_bytes()
    data = plain[:2] + b"\xff\xe1" + (len(block) + 2).to_bytes(2, "big") + block + plain[2:]
    assert exif_of(data) == Exif(6, 28.0)


@pytest.mark.parametrize("cut", [0, 8, 14, 20, 30, 40])
def test_broken_exif_counts_as_absent(tmp_path, cut):
    """Bytes of the segment behind `cut` are zeros."""
    whole = with_exif(jpeg(tmp_path / "a.jpg").read_bytes(), Exif(6, 26.0))
    length = int.from_bytes(whole[4:6])
    data = whole[: 12 + cut] + bytes(length - 8 - cut) + whole[4 + length :]
    assert exif_of(data) in (Exif(1, None), Exif(6, None))


# the format


def test_each_image_by_hand_is_a_station(folder):
    session = load_session(folder)
    names = ["phone-0000-1", "phone-0000-2", "phone-0001-1"]
    assert [station.name for station in session.stations] == names
    for station in session.stations:
        assert station.entry == "phone"
        assert station.handheld
        assert len(station.images) == 1
        assert station.T_camera_base is None
        assert station.camera_file == "cameras/phone.yaml"
    written = session.document["stations"]["phone"]["photographs"]
    assert written == [f"images/phone/{name}.jpg" for name in ("0000-1", "0000-2", "0001-1")]


def test_a_pose_of_a_camera_by_hand(folder):
    posed = "handheld: true\n    pose: {position: [1, 0, 0], look_at: [0, 0, 0]}"
    replaced(folder / "session.yaml", "handheld: true", posed)
    with raises(InputError, found="handheld: true, and a pose") as caught:
        load_session(folder)
    assert caught.value.where.endswith("stations.phone.pose")


def test_a_board_alone_by_hand(folder):
    replaced(folder / "session.yaml", "observe: legs", "observe: board")
    replaced(folder / "session.yaml", "stations:", "board: cameras/phone.yaml\nstations:")
    with raises(InputError, found="board") as caught:
        load_session(folder)
    assert caught.value.where.endswith("stations.phone.observe")
    assert caught.value.expected.startswith("legs, or [legs, board]")


def test_two_stations_of_one_name(folder):
    jpeg(folder / "other" / "0001.jpg")
    replaced(
        folder / "session.yaml",
        "stations:",
        "stations:\n  phone-0001-1: {camera: cameras/phone.yaml,"
        ' images: "other/{configuration}.jpg", observe: legs}',
    )
    with raises(InputError, found="phone-0001-1") as caught:
        load_session(folder)
    assert caught.value.where.endswith("stations")


# cameras by EXIF, and rotated images


def test_a_camera_by_exif(folder):
    replaced(folder / "session.yaml", "cameras/phone.yaml", "exif")
    station = load_session(folder).stations[0]
    assert station.from_exif
    assert station.camera.image_size == (8, 6)
    # a 26 mm lens has the same view along its image's diagonal as on film of 36 x 24 mm
    np.testing.assert_allclose(station.camera.parameters[:2], 26 * 10 / np.hypot(36, 24))
    np.testing.assert_allclose(station.camera.parameters[2:4], [3.5, 2.5])
    sigma = np.sqrt(np.diag(station.camera.covariance))
    assert 0.02 < sigma[0] / station.camera.parameters[0] < 0.05


def test_an_image_without_a_focal_length(folder):
    replaced(folder / "session.yaml", "cameras/phone.yaml", "exif")
    jpeg(folder / "images/phone/0000-2.jpg", Exif(6, None))
    with raises(InputError, where="images/phone/0000-2.jpg") as caught:
        load_session(folder)
    assert "FocalLengthIn35mmFilm" in caught.value.found


def exif_jpeg(path, picture=PICTURE, **tags):
    """JPEG file with EXIF entries by their names in the standard, written by Pillow."""
    from PIL import ExifTags, Image

    entries = Image.Exif()
    for name, value in tags.items():
        entries.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base[name].value] = value
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path, exif=entries)
    return path


CANON = {
    "FocalLength": 6.2, "FocalPlaneXResolution": 2260.0, "FocalPlaneResolutionUnit": 2,
    "ExifImageWidth": 8, "ExifImageHeight": 6,
}  # fmt: skip
"""A focal length of 551.68 px as Canon writes it; without a sensor of 7 mm, only for a file of
640x480 pixels."""


@pytest.mark.parametrize(
    ("unit", "density"), [(2, 2260.0), (3, 2260 / 2.54), (4, 2260 / 25.4), (None, 2260.0)]
)
@pytest.mark.parametrize("scale", [1, 2])
def test_the_focal_length_by_the_focal_plane(tmp_path, unit, density, scale):
    """In every unit, an inch by default; a resized image has fewer pixels per radian."""
    picture = np.zeros((480 // scale, 640 // scale), np.uint8)
    tags = {**CANON, "ExifImageWidth": 640, "ExifImageHeight": 480}
    tags |= {"FocalPlaneXResolution": density, "FocalPlaneResolutionUnit": unit}
    tags = {name: value for name, value in tags.items() if value is not None}
    path = exif_jpeg(tmp_path / "a.jpg", picture, **tags)
    camera = camera_by_exif([(path, "a.jpg")], "session.yaml")
    np.testing.assert_allclose(camera.focal, 6.2 * 2260 / 25.4 / scale, rtol=1e-6)


@pytest.mark.parametrize("absent", ["FocalLength", "FocalPlaneXResolution", "ExifImageWidth"])
def test_an_incomplete_focal_plane_names_what_is_absent(tmp_path, absent):
    path = exif_jpeg(tmp_path / "a.jpg", **{n: v for n, v in CANON.items() if n != absent})
    with pytest.raises(InputError) as caught:
        camera_by_exif([(path, "a.jpg")], "session.yaml")
    word = absent.replace("ExifImageWidth", "PixelXDimension")
    missing, _, present = caught.value.found.partition(", only ")
    assert word in missing
    assert word not in present
    assert present


def test_a_focal_plane_of_no_sensor_is_refused(tmp_path):
    """2260 pixels per inch of an image of 8 x 6 pixels are a sensor of 0.1 mm."""
    files = [(exif_jpeg(tmp_path / "a.jpg", **CANON), "a.jpg")]
    with raises(InputError, where="a.jpg") as caught:
        camera_by_exif(files, "s.yaml")
    assert caught.value.found.startswith("0.112 mm")


@pytest.mark.parametrize(("shape", "cropped"), [
    ((440, 480), True), ((480, 640), False), ((640, 480), False), ((240, 320), False),
    ((720, 960), False), ((451, 601), False), ((480, 632), True),
])  # fmt: skip
def test_a_cropped_image_gives_no_focal_length(tmp_path, shape, cropped):
    """EXIF's size is that of the captured image, 640 x 480: turned or resized is not cropped."""
    tags = {"FocalLengthIn35mmFilm": 27, "ExifImageWidth": 640, "ExifImageHeight": 480}
    path = exif_jpeg(tmp_path / "a.jpg", np.zeros(shape, np.uint8), **tags)
    files = [(path, "a.jpg")]
    if cropped:
        found = f"{shape[1]}x{shape[0]} pixels, of 640x480 by EXIF"
        with raises(InputError, where="a.jpg", found=found):
            camera_by_exif(files, "session.yaml")
    else:
        focal = 27 * np.hypot(*shape) / np.hypot(36, 24)
        np.testing.assert_allclose(camera_by_exif(files, "session.yaml").focal, focal)


def test_images_by_different_lenses(folder):
    replaced(folder / "session.yaml", "cameras/phone.yaml", "exif")
    jpeg(folder / "images/phone/0001-1.jpg", Exif(6, 52.0))
    found = "52 mm at 8x6, where images/phone/0000-1.jpg has 26 mm at 8x6"
    with raises(InputError, where="images/phone/0001-1.jpg", found=found):
        load_session(folder)


def test_the_sensors_picture_is_the_size_of_most(tmp_path):
    files = [
        (jpeg(tmp_path / "a.jpg", Exif(1, 26.0)), "a.jpg"),
        (jpeg(tmp_path / "b.jpg", Exif(1, 26.0)), "b.jpg"),
        (jpeg(tmp_path / "c.jpg", Exif(1, 26.0), np.rot90(PICTURE)), "c.jpg"),
    ]
    assert camera_by_exif(files, "session.yaml").image_size == (8, 6)


@pytest.mark.parametrize(("orientation", "quarters"), [(None, 1), (6, -1), (8, 1)])
def test_a_turned_image_is_turned_back(tmp_path, orientation, quarters):
    """Orientation by EXIF; by default a portrait image of a landscape sensor was turned
    clockwise.
    """
    portrait = np.rot90(PICTURE, -1)
    exif = None if orientation is None else Exif(orientation, 26.0)
    path = jpeg(tmp_path / "a.jpg", exif, portrait)
    stored = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    np.testing.assert_array_equal(decode(path, (8, 6), "a.jpg"), np.rot90(stored, quarters))


def test_a_turned_image_is_reported(folder):
    jpeg(folder / "images/phone/0000-2.jpg", Exif(1, 26.0), np.rot90(PICTURE))
    (warning,) = load_session(folder).warnings
    assert warning.startswith("images/phone/0000-2.jpg: turned by a quarter against its camera")


# a simulated session, and what is estimated from it


SETTINGS = Settings(configurations=3, repeats=1, handheld=True, tolerance=0.0, finish="matte")


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Three hand-held images of a machine with nominal geometry, with focal lengths that
    breathe.
    """
    folder = tmp_path_factory.mktemp("byhand") / "session"
    machine = load_mechanism("gough-stewart")
    rendered(folder, machine, camera_of_size((640, 480)), SETTINGS, seed=7)
    return folder


def test_a_simulated_session_by_hand_loads(simulated):
    session = load_session(simulated)
    truth = load_truth(simulated, session.machine)
    names = [f"phone-000{k}-1" for k in range(3)]
    assert [station.name for station in session.stations] == list(truth.stations) == names
    assert session.warnings == ()
    assert np.ptp(truth.focal_scale) > 1e-3
    np.testing.assert_array_equal(truth.images, [[0, 0], [1, 1], [2, 2]])


def test_simulated_images_say_how_they_were_held(simulated):
    """After the rotation that EXIF requests the platform is above the base."""
    session = load_session(simulated)
    truth = load_truth(simulated, session.machine)
    query = {1: (0, -1), 3: (0, 1), 6: (-1, 0), 8: (1, 0)}  # direction of up in the stored image
    for station, T in zip(session.stations, truth.T_camera_base, strict=True):
        exif = exif_of(station.images[0].path.read_bytes())
        assert T[:2, 2] @ query[exif.orientation] > np.cos(np.pi / 4) * np.linalg.norm(T[:2, 2])
        # of the lens, whatever it was focused at: 30.505, of which 0.02 % less would be 30
        assert exif.focal_35mm == round(705 / 1000 * np.hypot(36, 24))


def test_places_by_hand_are_drawn_apart_and_rolled():
    """With few images too: one to three of a configuration, each from its own place."""
    machine, camera = load_mechanism("gough-stewart"), camera_of_size((400, 300))
    places = rough_poses(machine, (camera,) * 24, np.random.default_rng(0))
    at = np.array([place.position for place in places])
    apart = np.linalg.norm(at[:, None] - at, axis=-1) + 9 * np.eye(24)
    assert apart.min() > 0.02
    up = np.array([place.T_camera_base()[:2, 2] for place in places])
    roll = np.abs(np.degrees(np.arctan2(up[:, 0], -up[:, 1])))
    held_upright = np.abs(roll - 90) < 16
    assert np.all(held_upright | (roll < 16))
    assert 3 <= held_upright.sum() <= 14


def at_truth(folder, off=2e-3):
    """The case of a session whose hand-held images are localized nearly where they were taken."""
    session = load_session(folder)
    truth = load_truth(folder, session.machine).T_camera_base
    near = perturb(truth, off * np.random.default_rng(1).normal(size=(len(truth), 6)))
    return Case(session, read_images(session), Boards(), PriorScene.as_drawn(session, near))


@pytest.fixture(scope="module")
def breathed(simulated, tmp_path_factory):
    """Calibration of a machine that is known exactly, so that images determine their focal lengths
    as well as possible.
    """
    folder = tmp_path_factory.mktemp("breathed") / "session"
    shutil.copytree(simulated, folder)
    text = (folder / "mechanism.yaml").read_text()
    (folder / "mechanism.yaml").write_text(
        re.sub(r"(?m)^tolerance:.*$", "tolerance: {center: 1e-5, offset: 1e-5, radius: 1e-5}", text)
    )
    case = at_truth(folder)
    calibration = calibrate_session(case.session, case=case, options=FEW_IMPUTATIONS)
    return calibration, load_truth(folder, load_mechanism("gough-stewart"))


def test_a_rejected_image_is_counted_named_and_shown(breathed):
    """On the terminal, in the report and in the documents; it was dropped from the count."""
    calibration, _ = breathed
    session = calibration.session
    again = replace(session.stations[1], name="phone-0001-2")
    whole = replace(session, stations=(*session.stations, again))
    tried = {3: calibration.estimate.state.T_camera_base[1]}
    fewer = whole.without({3: EDGES_DISAGREE_REASON}, tried)
    outcome = outcome_of(replace(calibration, session=fewer))
    (card,) = [card for card in outcome.figures if card.question == "What is it based on?"]
    assert card.values == (("3 of 4", "images"),)
    file = "images/phone/0001-1.jpg"
    (rows,) = [one.text for one in outcome.findings]
    assert rows == fewer.rejected[0].finding.text
    assert rows.startswith(f"{file}: left out, for {EDGES_DISAGREE_REASON}.")
    entry = {
        "file": file, "station": "phone-0001-2", "configuration": "0001",
        "reason": EDGES_DISAGREE_REASON,
    }  # fmt: skip
    assert outcome.summary["photographs"] == 4
    assert outcome.summary["rejected_photographs"] == [entry]
    assert json.loads(outcome.texts["calibration.json"])["rejected_photographs"] == [entry]
    (part,) = [part for part in outcome.parts if part.name == "photographs"]
    *_, block = [one for one in part.blocks if one.kind == "images"]
    (image,) = block.images
    assert image.group == "phone-0001-2"
    # where it was tried
    (overlay,) = image.overlays
    assert [layer.name for layer in overlay.layers] == ["edges", "joints"]
    assert all(layer.shapes for layer in overlay.layers)
    assert image.caption == f"rejected, for {EDGES_DISAGREE_REASON}"
    assert len(image.webp) > 1000


def test_the_better_of_estimated_intrinsics_and_those_of_the_files(breathed):
    """An option never makes a result worse: what may be used, keeps more, fits better."""
    results, _ = breathed
    results = replace(results, verdict=Verdict(True, "Good."))
    fewer = replace(results, session=results.session.without({2: EDGES_DISAGREE_REASON}))
    refused = replace(results, verdict=Verdict(False, "Bad."))
    statistics = results.estimate.statistics
    worse = replace(statistics, chi2=10 * statistics.chi2, chi2_edges=10 * statistics.chi2_edges)
    misfit = replace(results, estimate=replace(results.estimate, statistics=worse))
    assert worse_refined(results, results) is None
    rejects = worse_refined(fewer, results)
    assert rejects.code == "camera.refinement_rejects"
    assert (rejects.facts["kept"], rejects.facts["of"], rejects.facts["by_files"]) == (2, 3, 3)
    for bad in (fewer, refused, misfit):
        assert worse_refined(bad, results)
        assert worse_refined(results, bad) is None
        taken = better_refined(lambda bad=bad: bad, lambda: results)
        assert taken.session == results.session
        assert taken.estimate is results.estimate
        (warning,) = taken.verdict.findings
        assert warning.code.startswith("camera.refinement_")
        assert "--refine-camera" in warning.text
        assert better_refined(lambda: results, lambda bad=bad: bad) is results
    assert better_refined(lambda: fewer, lambda: refused) is fewer  # first of all, it may be used

    def failed():
        raise ResultError("the search has diverged")

    (warning,) = better_refined(failed, lambda: results).verdict.findings
    assert warning.code == "camera.refinement_failed"
    assert "the search has diverged" in warning.text
    (remark,) = better_refined(lambda: results, failed).verdict.findings
    assert (remark.code, remark.level) == ("camera.files_intrinsics_failed", Level.NOTE)
    with raises(ResultError, what="the search has diverged"):
        better_refined(failed, failed)


@pytest.mark.slow
def test_images_that_are_held_out_are_not_misplaced(tmp_path):
    """The estimate without silhouettes rejects all of their edges, and does not determine their
    poses.
    """
    settings = replace(SETTINGS, configurations=4)
    folder, machine = tmp_path / "session", load_mechanism("gough-stewart")
    rendered(folder, machine, camera_of_size((480, 360)), settings, seed=7)
    case = at_truth(folder)
    calibration = calibrate_session(case.session, case=case, holdout=1)
    assert len(calibration.session.stations) == 4
    assert calibration.session.warnings == ()
    assert calibration.estimate.configurations.sum() == 3


def test_too_few_configurations_to_hold_out_are_refused_before_images_are_read(searched):
    steps = []
    with raises(InputError, what="there are too few configurations to hold any out"):
        calibrate_session(searched[0], holdout=2, progress=lambda step, _: steps.append(step))
    assert "Reading images" not in steps


def test_focal_lengths_are_found_within_their_deviations(breathed):
    calibration, truth = breathed
    stations = calibration_document(calibration)["stations"]
    values = np.array([station["focal_scale"] for station in stations])
    sigma = np.array([station["sigma_focal_scale"] for station in stations])
    assert np.all(sigma <= FOCAL_SIGMA)  # no data take away what is known beforehand
    assert sigma.min() < 0.99 * FOCAL_SIGMA
    assert np.all(np.abs(values - truth.focal_scale) < 3.5 * sigma)


def test_normals_turn_with_the_focal_length_as_stated(searched):
    """The same image measured with a camera whose focal lengths are larger by a thousandth."""
    session, images, _, truth = searched
    p, excess = images[EASIEST], 1e-3
    T, pose = truth.T_camera_base[EASIEST], truth.T_base_platform[[EASIEST]]
    wider = replace(p.camera, parameters=p.camera.parameters + excess * p.camera.focal_part)
    first, other = (
        legs.measure(replace(p, camera=camera), session.machine, T, pose, 0.7, refine_camera=True)
        for camera in (p.camera, wider)
    )
    same = [
        int(np.flatnonzero(hit)[0])
        if (hit := (other.edges.leg == e.leg[k]) & (other.edges.tube == e.tube[k])
            & (other.edges.side == e.side[k])).any()
        else -1
        for e in [first.edges] for k in range(len(e))
    ]  # fmt: skip
    mine = np.flatnonzero(np.array(same) >= 0)
    turned = other.edges.normal[np.array(same)[mine]] - first.edges.normal[mine]
    turned = np.einsum("nji,nj->ni", first.edges.basis[mine], turned)[:, 0]
    stated = (first.edges.by_intrinsics[mine] @ p.camera.focal_part)[:, 0] * excess
    assert np.abs(stated).max() > 1e-4
    # by least absolute deviations, for an edge may take another highlight the second time
    slopes = turned / stated
    order = np.argsort(slopes)
    share = np.cumsum(np.abs(stated)[order])
    assert slopes[order][np.searchsorted(share, share[-1] / 2)] == pytest.approx(1.0, abs=0.1)


def test_edges_determine_focal_lengths_as_the_derivative_predicts(breathed):
    """Derivatives of the rows by an image's focal length, against differences of the rows."""
    calibration, _ = breathed
    assembled = assemble(
        calibration.session.machine,
        calibration.measurements,
        default_gauge(calibration.session.machine),
    )
    state = batch_of(calibration.session.machine, assembled, calibration.estimate.state)
    problem, u = assembled.problem, assembled.problem.unknowns
    linear = problem.linearize(state)
    step = 1e-3 * FOCAL_SIGMA
    for s in range(3):
        change = np.zeros((1, u.count))
        change[0, u.of_code(FOCAL_EXCESS).start + s] = step
        shifted = problem.retract(state, change, np.zeros((1, 3, 6)))
        slope = (problem.residuals(shifted).value - problem.residuals(state).value) / 1e-3
        here = FOCAL_SIGMA * linear.by_shared[..., u.of_code(FOCAL_EXCESS).start + s]
        np.testing.assert_allclose(slope[linear.usable], here[linear.usable], atol=1e-6)
        assert np.abs(here).max() > 0.1


def test_a_images_edges_are_no_lines_of_their_own(breathed):
    """If each edge is its station's only one, its shading is no unknown: the common part of a
    line's edges is noise like the rest.
    """
    calibration, _ = breathed
    machine = calibration.session.machine
    assembled = assemble(machine, calibration.measurements, default_gauge(machine))
    assert assembled.problem.unknowns.columns(SHADING).size == 0
    plain = replace(calibration.measurements, shaded=False)
    noise = [
        np.linalg.inv(assemble(machine, m, default_gauge(machine)).problem.data.whiten[0, 0, 0])
        for m in (calibration.measurements, plain)
    ]
    first = int(np.flatnonzero(calibration.measurements.edges.configuration == 0)[0])
    shift = np.hypot(SHADING_SIGMA, OWN_SHADING) * calibration.measurements.edges.shift[first]
    grown = noise[0] @ noise[0].T - noise[1] @ noise[1].T
    np.testing.assert_allclose(grown, np.outer(shift, shift), rtol=1e-6, atol=1e-18)


# recognition


@pytest.fixture(scope="module")
def searched(simulated):
    """The session, its images, the platform's poses and the truth."""
    session = load_session(simulated)
    truth = load_truth(simulated, session.machine)
    return session, read_images(session), platform_poses(session), truth


def view_of(session, p, poses):
    """Inputs of a search in one image."""
    tables = distance_tables(p.images)
    return StationView(session.machine, p.camera, p.configuration, session.joints, poses, tables)


def localized(searched, faults):
    """Cache a localization of the session in which images are where they were taken, each with the
    probability of a rival, and those with more than one in a hundred not accepted.
    """
    session, images, _, truth = searched
    unplaced = PriorScene.as_drawn(session, np.full((len(faults), 4, 4), np.nan))
    places, T_camera_base = {}, truth.T_camera_base.copy()
    for k, wrong in enumerate(faults):
        ratios = np.array([9 + np.log(1 / wrong - 1), 9.0])
        places[k] = PoseHypotheses(np.stack([T_camera_base[k], np.eye(4)]), ratios, 1.0)
        if wrong > 0.01:
            T_camera_base[k] = np.nan
    name = session_name(session, [p.station for p in images], Boards(), unplaced)
    remember_session(name, (places, unplaced._replace(T_camera_base=T_camera_base)))
    return name


def localize_case(searched):
    session, images, *_ = searched
    return handheld.localize_case(session, images, Boards(), np.random.default_rng(0))


def posed(folder, words):
    replaced(folder / "session.yaml", "handheld: true", f"handheld: true\n    {words}")


def test_a_single_image_has_a_pose(folder):
    place = "{position: [0, -1, 0.5], look_at: [0, 0, 0.2]}"
    posed(folder, f"poses: {{0000-2: {place}}}")
    first, second, third = load_session(folder).stations
    assert (first.T_camera_base, third.T_camera_base) == (None, None)
    np.testing.assert_allclose(second.T_camera_base, look_at([0, -1, 0.5], [0, 0, 0.2], [0, 0, 1]))


def test_a_pose_of_an_image_that_is_not_there_is_refused(folder):
    posed(folder, "poses: {0000-3: {position: [0, -1, 0.5], look_at: [0, 0, 0.2]}}")
    with pytest.raises(InputError) as caught:
        load_session(folder)
    assert caught.value.where.endswith("stations.phone.poses.0000-3")


def test_a_board_on_the_base_serves_images_by_hand(folder):
    """Each image has a pose of its own, so one entry is many stations."""
    board = SESSION.replace("observe: legs", "observe: [legs, board]")
    text = board + "board: {file: board.yaml, fixed_to: base}\n"
    (folder / "session.yaml").write_text(text)
    (folder / "board.yaml").write_text("type: charuco\n")
    assert not any("board" in values for values in load_session(folder).warnings)


def test_unsure_images_are_left_out_and_reported(searched):
    localized(searched, [1e-4, 0.3, 1e-4])
    results = localize_case(searched)
    assert [s.name for s in results.session.stations] == ["phone-0000-1", "phone-0002-1"]
    assert [p.station for p in results.images] == [0, 1]
    truth = searched[3].T_camera_base
    np.testing.assert_array_equal(results.scene.T_camera_base, truth[[0, 2]])
    (rejected,) = results.session.rejected
    assert rejected.station.name == "phone-0001-1"
    assert "probability 0.30" in rejected.finding.facts["reason"]


def test_places_are_believed_while_all_together_leave_little_doubt():
    """The scored images' share of the probability of error that a session may have."""
    one = {
        k: PoseHypotheses(np.stack([np.eye(4)] * 2), np.array([np.log(1 / fault - 1), 0.0]), 1.0)
        for k, fault in enumerate([0.02, 0.3, 0.001, 0.02, 0.012])
    }
    assert handheld._sure(one, 5) == [2, 4, 0]
    assert handheld._sure(one, 10) == [2, 4]
    assert handheld._sure({}, 5) == []


def test_a_pose_is_not_believed_that_fits_as_wrong_ones_of_other_images_do():
    """The correct pose may be missing among the hypotheses; a board or a person excludes that."""
    scores = [[20.0, 10.0], [25.0, 11.0], [18.0, 9.0], [8.0, 1.0], [8.0]]
    one = {
        k: PoseHypotheses(np.stack([np.eye(4)] * len(score)), np.array(score), 1.0)
        for k, score in enumerate(scores)
    }
    assert one[3].rival_probability < 1e-3
    assert handheld._sure(one, 5) == [1, 0, 2]
    assert sorted(handheld._sure(one, 5, apart={3, 4})) == [0, 1, 2, 3, 4]


def stated(searched, numbers=(0, 1, 2)):
    """The session with rough poses of some images."""
    session, images, poses, truth = searched
    rough = perturb(truth.T_camera_base, 0.03 * np.random.default_rng(5).normal(size=(3, 6)))
    stations = [
        replace(station, T_camera_base=rough[k]) if k in numbers else station
        for k, station in enumerate(session.stations)
    ]
    return replace(session, stations=tuple(stations)), images, poses, truth


def test_poses_by_hand_place_images(searched):
    results = localize_case(stated(searched))
    assert not results.session.rejected
    off = pose_difference(results.scene.T_camera_base, searched[3].T_camera_base)
    assert np.degrees(np.linalg.norm(off[:, :3], axis=1)).max() < 4
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.1


def test_a_pose_by_hand_joins_images_that_are_searched(searched):
    """Whose poses by themselves are cached, and scored with all images."""
    session, images, poses, truth = stated(searched, [1])
    for k in (0, 2):
        alone = PoseHypotheses(truth.T_camera_base[k : k + 1], np.array([20.0]), 1.0)
        remember_image(image_name(session, session.machine, k), alone)
    results = localize_case((session, images, poses, truth))
    assert not results.session.rejected
    off = pose_difference(results.scene.T_camera_base, truth.T_camera_base)
    assert np.degrees(np.linalg.norm(off[:, :3], axis=1)).max() < 4
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.1


def test_an_image_in_which_no_leg_can_be_measured_is_left_out(searched):
    """However well its silhouettes match, as of a shaken camera: it determines no machine."""
    session, images, *rest = stated(searched)
    blurred = [cv2.GaussianBlur(images[1].images[0], (0, 0), 3.0)]
    images = [images[0], replace(images[1], images=blurred), images[2]]
    results = localize_case((session, images, *rest))
    assert [s.name for s in results.session.stations] == ["phone-0000-1", "phone-0002-1"]
    assert sorted(results.scene.edges) == [0, 1]
    (rejected,) = results.session.rejected
    assert rejected.finding.facts["reason"] == few_legs_reason(session.machine)


def test_legs_are_measured_where_an_image_is_and_not_elsewhere(searched):
    session, images, poses, truth = searched
    p = images[EASIEST]
    there = PriorScene(session.machine, truth.T_camera_base, poses)
    assert not handheld._too_few_legs(there, p)
    turn = pose(rotation(np.array([0.0, 0.0, np.radians(40.0)])), np.zeros(3))
    elsewhere = there._replace(T_camera_base=truth.T_camera_base @ turn)
    assert handheld._too_few_legs(elsewhere, p)


def test_check_reports_which_images_are_sure(simulated, searched):
    localized(searched, [1e-4, 0.3, 1e-4])
    check = check_session(simulated)
    assert [station.recognised for station in check.stations] == [True, False, True]
    assert check.stations[0].legs > 2
    rejected = [one.facts["station"] for one in check.findings if one.code == "rejected.image"]
    assert rejected == ["phone-0001-1"]
    assert "station.not_recognised" not in {one.code for one in check.findings}
    assert "images.no_forecast" in {one.code for one in check.findings}  # by two images


def test_the_same_images_are_searched_once(searched):
    """Cached poses, edges and rejections are those of the search; other data have another name."""
    session, images, _, _ = searched = stated(searched)
    first, again = localize_case(searched), localize_case(searched)
    assert len(first.scene.edges) == 3
    np.testing.assert_array_equal(again.scene.T_camera_base, first.scene.T_camera_base)
    np.testing.assert_array_equal(again.scene.machine.values, first.scene.machine.values)
    for k, edges in first.scene.edges.items():
        np.testing.assert_array_equal(again.scene.edges[k].normal, edges.normal)
        np.testing.assert_array_equal(again.scene.edges[k].coarse, edges.coarse)
    (path,) = cache_folder().glob("session-*.npz")
    stations, unplaced = (
        [p.station for p in images],
        PriorScene.as_drawn(session, np.full((3, 4, 4), np.nan)),
    )
    assert session_name(session, stations, Boards(), unplaced) == path.stem
    noisier = replace(session, joint_noise=2 * session.joint_noise)
    warmer = replace(session, temperature=np.array([20.0, 21.0, 22.0]))
    separate = tuple(
        replace(station, camera_file=f"{k}.yaml") for k, station in enumerate(session.stations)
    )
    for other in (noisier, warmer, replace(session, stations=separate)):
        assert session_name(other, stations, Boards(), unplaced) != path.stem
    # a single image is searched at the pose by its readings, whatever their temperature
    np.testing.assert_array_equal(warmer.forward.T_base_platform, session.forward.T_base_platform)
    machine = session.machine
    assert image_name(warmer, machine, 0) == image_name(session, machine, 0)
    boards = Boards(tolerance=0.01)
    assert session_name(session, stations, boards, unplaced) != path.stem
    # a file of something else under the right name
    np.savez(path, images=np.arange(3))
    assert remembered_session(path.stem, session.machine) is None


@pytest.mark.slow
def test_new_data_of_a_calibrated_machine_use_the_same_poses(searched):
    """Which `check` and `calibrate` cached, by the session's nominal model; readings of the
    calibration at the session's own poses are no rivals of these.
    """
    session = searched[0]
    name = localized(searched, [1e-4, 1e-4, 1e-4])
    machine = session.machine.with_values(session.machine.values + 1e-6)
    others = session.joints + 0.01
    saved = SimpleNamespace(
        machine=machine,
        document={"stations": []},
        joints=np.concatenate([others, session.joints]),
        used=np.ones(6, dtype=bool),
    )
    value = measured_new_data(saved, session, 0, no_progress)
    assert value.session.machine is machine
    assert len(value.session.stations) == 3
    np.testing.assert_array_equal(value.session.earlier_joints, others)
    # nothing was searched
    assert [path.stem for path in cache_folder().glob("*.npz")] == [name]


def test_no_image_by_hand_is_localized(searched):
    localized(searched, [0.3, 0.3, 0.3])
    with pytest.raises(InputError) as caught:
        localize_case(searched)
    assert caught.value.where.endswith("stations.phone")
    assert "probability 0.30" in caught.value.found


def test_images_of_one_configuration_are_localized(searched):
    localized(searched, [0.3, 1e-4, 0.3])
    with pytest.raises(InputError) as caught:
        localize_case(searched)
    assert caught.value.found.startswith("0001;")


def test_an_image_in_a_wrong_place_is_found_out(breathed):
    """An image whose edges the estimate rejects, or whose camera it moves away, is rejected."""
    calibration, _ = breathed
    session, measurements = calibration.session, calibration.measurements
    estimate, T = calibration.estimate, calibration.estimate.state.T_camera_base
    assert inconsistent_poses(session, measurements, estimate, T) == {}
    weights = estimate.edge_weights.copy()
    weights[measurements.edges.station == 1] *= 0.4
    given_up = replace(estimate, edge_weights=weights)
    wrong = inconsistent_poses(session, measurements, given_up, T)
    assert wrong == {1: EDGES_DISAGREE_REASON}
    # nor do three legs, none of which another one contradicts
    edges = measurements.edges
    fewer = edges.select((edges.station != 2) | (edges.leg < 3))
    mine = (edges.station != 2) | (edges.leg < 3)
    of_three = replace(estimate, edge_weights=estimate.edge_weights[mine])
    assert inconsistent_poses(session, replace(measurements, edges=fewer), of_three, T) == {
        2: EDGES_DISAGREE_REASON
    }
    # a consistent board determines its pose
    visible = SimpleNamespace(
        edges=measurements.edges, poses=SimpleNamespace(station=np.array([1]))
    )
    with_board = replace(given_up, pose_weights=np.ones(1))
    assert inconsistent_poses(session, visible, with_board, T) == {}
    turn = np.array([[0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0], [0.2, 0, 0, 0, 0, 0]])
    assert inconsistent_poses(session, measurements, estimate, perturb(T, turn)) == {
        2: CAMERA_TURNED_REASON
    }
    images = read_images(session)
    scene = PriorScene.as_drawn(session, T)
    case = Case(session, images, Boards(), scene)
    rest = without_stations(case, wrong, edges, estimate)
    assert [s.name for s in rest.session.stations] == ["phone-0000-1", "phone-0002-1"]
    # the others are where the estimate has them, by the edges that it was made from
    np.testing.assert_array_equal(rest.scene.T_camera_base, T[[0, 2]])
    assert {k: len(results) for k, results in rest.scene.edges.items()} == {
        k: (edges.station == old).sum() for k, old in enumerate([0, 2])
    }
    assert "too few of its edges agree" in rest.session.warnings[-1]


def test_tubes_stand_out_of_a_chart():
    """A bright bar is a pair of its width and direction, and the rarest structure in the image."""
    image = np.full((300, 400), 60, np.uint8)
    cv2.line(image, (100, 220), (300, 80), 200, 10, cv2.LINE_AA)
    chart = tube_chart(image, camera_of_size((400, 300)))
    clear = chart.surprisal.max(axis=(2, 3))
    wide = int(chart.width_number(np.array(10.0)))
    normal = round(np.arctan2(200, 140) % np.pi * TUBE_CHART_OPTIONS.directions / np.pi)
    assert clear[wide, normal] > TUBE_CHART_OPTIONS.steps * np.log(20)
    assert (
        clear[wide, (normal + TUBE_CHART_OPTIONS.directions // 2) % TUBE_CHART_OPTIONS.directions]
        == 0
    )


@pytest.mark.slow
def test_one_image_is_found_from_nothing(searched):
    """Ten seconds: all poses about the machine, for the easiest of the three images."""
    session, images, poses, truth = searched
    k = EASIEST
    p = images[k]
    view = view_of(session, p, poses)
    value = localize_image(view, p.images[0])
    off = pose_difference(value.T_camera_base[0], truth.T_camera_base[k])
    assert value.rival_probability < LOCALIZATION_OPTIONS.rival
    assert np.degrees(np.linalg.norm(off[:3])) < 4
    assert np.linalg.norm(off[3:]) < 0.1


@pytest.mark.parametrize("k", range(3))
def test_one_image_is_localized_near_a_pose_by_hand(searched, k):
    """Also where the search everywhere prefers another place."""
    session, images, poses, truth = searched
    rough = perturb(truth.T_camera_base[k], np.array([0.05, -0.04, 0.06, 0.03, -0.02, 0.05]))
    view = view_of(session, images[k], poses)
    value = localize_near(view, images[k].images[0], rough)
    off = pose_difference(value.T_camera_base[0], truth.T_camera_base[k])
    assert np.degrees(np.linalg.norm(off[:3])) < 4
    assert np.linalg.norm(off[3:]) < 0.1


def test_turns_of_a_machine_onto_itself(searched):
    """A hexapod has equal thirds: two other poses with the same appearance."""
    session, images, poses, truth = searched
    p = images[0]
    view = view_of(session, p, poses)
    same = symmetric_poses(view, truth.T_camera_base[:1])
    assert len(same) == 2
    base = session.machine.base_centers()
    points = apply(same[:, None], base)
    first = apply(truth.T_camera_base[0], base)
    for turned in points:
        apart = np.linalg.norm(turned[:, None] - first, axis=-1)
        assert np.all(apart.min(axis=1) < 0.06)
        assert np.all(apart.argmin(axis=1) != np.arange(6))


def test_a_pose_by_hand_is_as_likely_as_with_another_leg_for_the_first(searched):
    """Within the hand's error it is a normal density; elsewhere one in ten remains."""
    session, images, poses, truth = searched
    view, true, sigma = view_of(session, images[0], poses), truth.T_camera_base[0], 0.1
    same = symmetric_poses(view, true[None])
    ends = session.machine.ends_at(view.joints, view.poses)
    middle = np.concatenate([ends.a[0], ends.b[0]]).mean(axis=0)

    def turned(angle):
        turn = rotation(np.array([0.0, 0.0, angle]))
        return true @ pose(turn, middle - turn @ middle)

    far = true.copy()
    far[2, 3] += 100 * sigma * np.linalg.norm(far[:3, 3])
    others = np.stack([true, *same, turned(2 * sigma), far])
    nats = log_prior_by_hand(view, true, others, sigma)
    np.testing.assert_allclose(nats[:3], nats[0], atol=0.01)
    assert abs(nats[0] - nats[3] - 2.0) < 0.01
    assert abs(nats[4] - np.log(0.1)) < 1e-9
    # against all rotations, and directions and distances over the middle of the image
    camera = images[0].camera
    (fx, fy, cx, cy), distortion = camera.parameters[:4], camera.parameters[4:]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    x, y = np.array(camera.image_size) - 1
    edges = np.array([[0, y / 2], [x, y / 2], [x / 2, 0], [x / 2, y]])
    rays = cv2.convertPointsToHomogeneous(cv2.undistortPoints(edges, matrix, distortion))[:, 0]
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    width, height = np.arccos(rays[0] @ rays[1]), np.arccos(rays[2] @ rays[3])
    anywhere = 8 * np.pi**2 * (0.4 * width) * (0.4 * height) * np.log(1.5 / 0.3)
    peak = multivariate_normal(np.zeros(6), sigma**2 * np.eye(6)).pdf(np.zeros(6))
    assert abs(nats[0] - np.log(0.3 * peak * anywhere + 0.1)) < 0.01


def test_a_similar_pose_is_distinguished_by_the_machine_there(searched):
    """A search holds the place and those from which the machine is turned onto itself for equal."""
    session, images, poses, truth = searched
    p = images[1]
    view = view_of(session, p, poses)
    true = truth.T_camera_base[1]
    places = np.concatenate([symmetric_poses(view, true[None]), true[None]])
    equal = PoseHypotheses(places, np.full(len(places), 20.0), 1.0)
    drawn = PriorScene(session.machine, np.full((3, 4, 4), np.nan), poses)
    count, _ = rescore_poses(session, p, drawn, equal, NONE)
    assert equal.rival_probability == 0.5
    assert count.rival_probability < 1e-3
    assert np.degrees(angle_between(count.T_camera_base[0], true)) < 4
    # one place alone is weighed against chance
    one = PoseHypotheses(true[None], np.array([20.0]), equal.unit)
    alone, _ = rescore_poses(session, p, drawn, one, NONE)
    # a pose from other images is scored as well
    values, _ = rescore_poses(
        session,
        p,
        drawn,
        PoseHypotheses(equal.T_camera_base[1:], equal.log_likelihood_ratio[1:], equal.unit),
        true[None],
    )
    assert np.degrees(angle_between(values.T_camera_base[0], true)) < 2
    assert alone.rival_probability < 1e-3


def evidence_there(reference_values, view):
    """Log-likelihood ratio of the third image about its pose by the marginal prior."""
    return likelihood_from(reference_values.view_in(view), reference_values.T_camera_base[None])


def test_images_join_what_is_known(searched):
    """A board of the same machine costs the other images little; with another's readings it does
    not fit.
    """
    session, images, poses, truth = searched
    at = {p.station: p for p in images}
    places = dict(enumerate(truth.T_camera_base[:2]))
    drawn = PriorScene(session.machine, np.full((3, 4, 4), np.nan), poses)
    names = register_images(session, at, drawn, places, Boards())
    assert sorted(names.edges) == [0, 1]
    T = truth.T_camera_base[2]
    view = finest_view(session.machine, at[2], session.joints, poses)
    nowhere = perturb(np.eye(4), np.array([np.pi, 0, 0, 0, 0, 0])) @ T
    near = perturb(T[None], np.array([[0.02, 0, 0, 0, 0, 0]]))[0]
    right, none, beside = evaluate_poses(session, names, 2, np.stack([T, nowhere, near]), view)
    assert len(right.edges) > 6
    # half the squares of its edges' residuals, two numbers each
    assert right.cost < len(right.edges)
    assert none.code == "measurements.none"
    # a pose of a batch has the result that it has alone
    (alone,) = evaluate_poses(session, names, 2, near[None], view)
    np.testing.assert_allclose(beside.T_camera_base, alone.T_camera_base, atol=1e-5)
    assert beside.cost == pytest.approx(alone.cost, rel=1e-3)
    assert len(beside.edges) == len(alone.edges)
    other = replace(view, configuration=at[0].configuration)
    (wrong,) = evaluate_poses(session, names, 2, T[None], other)
    assert isinstance(wrong, EvaluatedPose)
    assert evidence_there(right, view) > 3 * evidence_there(wrong, other)


@pytest.mark.slow
def test_no_pose_is_scored_twice(searched):
    session, images, poses, truth = searched
    at = {p.station: p for p in images}
    drawn = PriorScene(session.machine, np.full((3, 4, 4), np.nan), poses)
    numbers = register_images(
        session, at, drawn, dict(enumerate(truth.T_camera_base[:2])), Boards()
    )
    true = truth.T_camera_base[2:]
    hypotheses = PoseHypotheses(np.concatenate([true, true]), np.array([20.0, 20.0]), 1.0)
    one, queries = rescore_poses(session, at[2], numbers, hypotheses, true)
    again, both = rescore_poses(session, at[2], numbers, hypotheses, true, queries)
    assert len(both.cost) == len(queries.cost)
    np.testing.assert_array_equal(again.T_camera_base, one.T_camera_base)


def test_a_board_on_the_base_weighs_places_together(searched):
    """Two images prefer poses with the same appearance, each another one; the board is in one place
    only.
    """
    truth = searched[3].T_camera_base
    turns = [
        pose(rotation(np.radians(a) * np.array([0.0, 0.0, 1.0])), np.zeros(3)) for a in (120, 240)
    ]
    hypotheses = {
        k: PoseHypotheses(np.stack([T @ turn, T]), np.array([20.0, 19.0]), 1.0)
        for k, (T, turn) in enumerate(zip(truth, (*turns, turns[0]), strict=True))
    }
    T_base_board = perturb(np.eye(4), np.array([0.1, 0.2, 0.3, 0.05, 0.0, 0.02]))
    boards = Boards({
        k: SimpleNamespace(stood=SimpleNamespace(T_camera_board=T @ T_base_board))
        for k, T in enumerate(truth[:2])
    })  # fmt: skip
    rows = handheld._on_board(hypotheses, boards)
    assert sorted(rows) == [0, 1]  # the third does not show it
    for k, one in rows.items():
        assert one.rival_probability < 1e-6
        assert angle_between(one.T_camera_base[0], truth[k]) < 1e-6
    # an image without edges gets its pose from the board
    hypotheses[1] = PoseHypotheses(truth[1:2] @ turns[0], np.array([-5.0]), 1.0)
    assert (
        angle_between(handheld._on_board(hypotheses, boards)[1].T_camera_base[1], truth[1]) < 1e-6
    )
    assert handheld._on_board(hypotheses, boards.of(np.array([2]))) == {}
