"""Distances between two tool positions: read, checked, estimated, reported."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

import distance_sessions
import printers
from conftest import run
from document_keys import assert_keys
from page_documents import page_document
from pkmcal.boards.views import Boards
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.calibration.camera_refinement import refinement_of
from pkmcal.calibration.holdout import select
from pkmcal.calibration.localization import prior_station_poses
from pkmcal.calibration.machine_source import load_source
from pkmcal.calibration.refinement import identify_poses
from pkmcal.errors import InputError
from pkmcal.exporters.contract import make_export
from pkmcal.identify.bundle import bundle
from pkmcal.identify.tool import pose_by_parameters
from pkmcal.session.load import load_session
from test_heights import flat, pasted

BUILT = printers.Settings(radius=105.6, angle=(210.3, 329.8, 90.0), rod=(270.3, 269.8, 270.1))
ENDS = (0.8, -0.5, 0.4)


@pytest.fixture(scope="module")
def true():
    return printers.machine(BUILT, endstops=ENDS)


@pytest.fixture(scope="module")
def kit(true, tmp_path_factory):
    """Heights at thirteen points, and eighteen distances between thirteen marks."""
    return distance_sessions.write(
        tmp_path_factory.mktemp("printer"), true, np.random.default_rng(1)
    )


@pytest.fixture(scope="module")
def measured(kit):
    return calibrate_session(kit)


def stretch_sigma(estimate):
    """Standard deviation of the stretch along the bed by an estimate's covariance."""
    xy = 1e-3 * printers.bed(30)
    T = np.broadcast_to(np.eye(4), (30, 4, 4)).copy()
    T[:, :2, 3] = xy
    by = pose_by_parameters(estimate.machine, estimate.machine.inverse(T), T)[:, 3:5]
    xy = xy - xy.mean(axis=0)
    row = np.einsum("ni,nip->p", xy, by) / np.sum(xy**2)
    return float(np.sqrt(row @ estimate.covariance @ row))


def test_heights_alone_leave_the_size_open_and_distances_determine_it(
    kit, measured, true, tmp_path
):
    for name in ("session.yaml", "mechanism.yaml", "joints.csv", "poses.csv"):
        (tmp_path / name).write_text((kit / name).read_text())
    text = (kit / "session.yaml").read_text()
    (tmp_path / "session.yaml").write_text(text[: text.index("\ndistances:")])
    alone = calibrate_session(tmp_path)
    assert alone.session.heights_alone
    assert not measured.session.heights_alone
    assert measured.verdict.usable
    # in words: what heights leave to the nominal model, and with distances nothing of it
    assert alone.verdict.of("bed.sideways")
    assert not measured.verdict.of("bed")
    assert measured.identification.bed is None
    # a radius 0.6 mm off makes a bed 0.6 % too small
    before = distance_sessions.stretch(true, measured.session.machine)
    after = distance_sessions.stretch(true, measured.machine)
    assert abs(before) > 5e-3
    assert stretch_sigma(alone.estimate) > 5e-4
    assert abs(after) < 4 * stretch_sigma(measured.estimate) < 4e-4
    assert stretch_sigma(measured.estimate) < stretch_sigma(alone.estimate) / 8


@pytest.mark.slow
def test_deviations_hold(tmp_path):
    """Fifteen printers: the error of the size over its deviation, and the distances' chi-square."""
    rng = np.random.default_rng(7)
    z, chi2, dof = [], 0.0, 0.0
    for k in range(15):
        off = replace(
            printers.Settings(),
            radius=105 + rng.normal(),
            angle=tuple(np.array(printers.Settings().angle) + np.rad2deg(rng.normal(size=3) / 105)),
            rod=tuple(270 + 0.5 * rng.normal(size=3)),
        )
        true = printers.machine(off, endstops=tuple(rng.normal(size=3)))
        (tmp_path / str(k)).mkdir()
        kit = distance_sessions.write(tmp_path / str(k), true, rng)
        session = load_session(kit)
        boards, held = Boards(), refinement_of(session, False)
        T = prior_station_poses(session, boards)
        estimate = identify_poses(session, boards, T, held, lambda _text, _share: None).estimate
        z.append(distance_sessions.stretch(true, estimate.machine) / stretch_sigma(estimate))
        s = estimate.statistics
        chi2, dof = chi2 + s.chi2_links * s.link_scale**2, dof + s.dof_links
    assert np.mean(np.square(z)) == pytest.approx(1, abs=4 * np.sqrt(2 / 15))
    assert 8 * 15 < dof < 18 * 15
    assert chi2 / dof == pytest.approx(1, abs=4 * np.sqrt(2 / dof))


def test_distances_alone_calibrate_a_size(kit, true, tmp_path):
    """Without a station: the nominal model's shape, and the size by the distances."""
    for name in ("mechanism.yaml", "joints.csv", "distances.csv"):
        (tmp_path / name).write_text((kit / name).read_text())
    text = (kit / "session.yaml").read_text()
    a, b = text.index("stations:"), text.index("\ndistances:")
    (tmp_path / "session.yaml").write_text(text[:a] + text[b:])
    result = calibrate_session(tmp_path)
    assert result.estimate.statistics.n_links == 18
    after = distance_sessions.stretch(true, result.machine)
    assert abs(after) < 4 * stretch_sigma(result.estimate) < 2e-3


def test_a_wrong_distance_is_rejected_and_named(kit, true, tmp_path):
    """Read 0.4 mm too long, twenty deviations."""
    for path in kit.iterdir():
        if path.is_file():
            (tmp_path / path.name).write_text(path.read_text())
    rows = (kit / "distances.csv").read_text().splitlines()
    ends, _, value = rows[5].rpartition(",")
    rows[5] = f"{ends},{float(value) + 0.4}"
    (tmp_path / "distances.csv").write_text("\n".join(rows))
    result = calibrate_session(tmp_path)
    assert np.flatnonzero(result.estimate.link_weights < 0.5).tolist() == [4]
    first, second = ends.split(",")
    assert any(f"{first} to {second}" in text for text in result.verdict.warnings)
    after = distance_sessions.stretch(true, result.machine)
    assert abs(after) < 4 * stretch_sigma(result.estimate)


@pytest.fixture(scope="module")
def calibrated_kit(kit):
    """Output of the command; the result is beside the session."""
    done = run("calibrate", kit)
    assert done.code == 0, done.out + done.err
    return done


def test_commands_say_what_was_measured(kit, calibrated_kit):
    done = run("check", kit)
    assert done.code == 0, done.out + done.err
    assert "18 distances between 13 configurations" in done.out
    assert "31 of 31" in calibrated_kit.out
    assert "heights and distances" in calibrated_kit.out
    saved = json.loads((kit / "calibration" / "calibration.json").read_text())
    assert saved["statistics"]["n_links"] == pytest.approx(18, abs=0.5)
    assert_keys("calibration.json of distances", saved)
    rows = saved["residuals"]["distances"]
    assert len(rows) == 18
    names = [c["name"] for c in saved["configurations"]]
    at = dict(zip(saved["residuals"]["link_columns"], rows[0], strict=True))
    assert (names[at["from"] - 1], names[at["to"] - 1]) == ("m00", "m01")
    assert at["value"] == pytest.approx(0.04, rel=0.05)
    assert {target["name"] for target in saved["targets"]} == {"probe", "distances"}
    page = page_document((kit / "calibration" / "report.html").read_text(encoding="utf-8"))
    assert "distances" in [section["name"] for section in page["sections"]]


def test_too_few_distances_to_show_a_wrong_one(true, tmp_path, measured):
    """Three determine the size and leave nothing over; eighteen check each other."""
    pairs = [(7, 10), (8, 11), (9, 12)]
    kit = distance_sessions.write(tmp_path, true, np.random.default_rng(3), pairs=pairs)
    few = calibrate_session(kit)
    assert few.estimate.statistics.dof_links < 0.3
    assert few.verdict.usable
    assert any("one of the distances is wrong" in text for text in few.verdict.warnings)
    assert not any("one of the distances is wrong" in text for text in measured.verdict.warnings)


@pytest.mark.usefixtures("calibrated_kit")
def test_what_is_exported_has_the_bed_at_zero_and_the_size_right(kit, true):
    """Klipper's values by heights and distances: flat, level, at Z 0, and of the measured size."""
    (text,) = make_export(load_source(kit / "calibration"), "klipper").files.values()
    z = flat(true, pasted(text))
    assert np.std(z) < 0.015
    assert abs(np.mean(z)) < 0.015


@pytest.mark.parametrize(("error", "code"), [(0.06, "data.scatter"), (0.3, "data.misfit")])
def test_distances_that_disagree_with_the_machine(kit, tmp_path, error, code):
    """Further errors (mm) of distances whose stated noise is 0.03 mm."""
    shutil.copytree(kit, tmp_path / "kit")
    table = tmp_path / "kit/distances.csv"
    head, *rows = table.read_text().splitlines()
    rng = np.random.default_rng(2)
    values = [row.rsplit(",", 1) for row in rows]
    wrong = [f"{ends},{float(value) + error * rng.normal():.3f}" for ends, value in values]
    table.write_text("\n".join([head, *wrong]) + "\n")
    verdict = calibrate_session(tmp_path / "kit").verdict
    (misfit,) = verdict.of("data")
    assert (misfit.code, misfit.facts["names"]) == (code, ["distances"])
    assert verdict.usable == (code == "data.scatter")


def test_held_out_configurations_take_their_distances_with_them(measured):
    """An estimate without some configurations has the distances between the others alone."""
    whole = measured.measurements
    keep = np.ones(len(measured.session.joints), dtype=bool)
    keep[np.unique(whole.link_ends)[:3]] = False
    part = select(whole, keep)
    between = keep[whole.link_ends].all(axis=1)
    assert 0 < between.sum() < len(between)
    np.testing.assert_array_equal(part.link_ends, whole.link_ends[between])
    estimate = bundle(measured.session.machine, part, measured.estimate.state)
    assert len(estimate.link_weights) == between.sum()


def fault(kit, folder, **files):
    """The error of the session with other files."""
    for path in kit.iterdir():
        if path.is_file():
            (folder / path.name).write_text(path.read_text())
    for name, text in files.items():
        (folder / name.replace("_", ".")).write_text(text)
    with pytest.raises(InputError) as caught:
        prior_station_poses(load_session(folder), Boards())
    return caught.value


HEAD = "from,to,distance [mm]\n"


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        (HEAD + "m00,m01,40.1\nm00,m99,40.1\n", "line 3", "m99"),
        (HEAD + "m00,m00,40.1\n", "line 2", "m00 twice"),
        (HEAD + "m00,m01,-40.1\n", "line 2, column distance", "-0.0401 m"),
        (HEAD + "m00,m01,0\n", "line 2, column distance", "0 m"),
        ("from,to,distance\nm00,m01,40.1\n", "line 2, column distance", "40.1 m"),
        (HEAD + "m00,m01,forty\n", "line 2, column distance", "forty"),
        (HEAD + "m00,,40.1\n", "line 2", "to"),
        (HEAD + "m00,m01\n", "line 2", "2 cells"),
        ("from,to,distance [deg]\nm00,m01,40\n", "line 1, column distance", "angle"),
        ("from,to,length [mm]\nm00,m01,40\n", "line 1", "length"),
        ("configuration,distance\nm00,40\n", "line 1", "from,to"),
        ("from;to;distance\nm00;m01;40\n", "line 1", "from;to;distance"),
        ("from,to,distance [mm],sigma [mm]\nm00,m01,40,0\n", "line 2, column sigma", "0 m"),
        ("from,to,distance [mm],sigma\nm00,m01,40,0.2\n", "line 2, column sigma", "0.2 m"),
        ("", "distances.csv", "empty"),
        (HEAD, "distances.csv", "no rows"),
        # all in inches: a machine that is twenty-five times as large
        (HEAD + "m00,m01,1.57\nm00,m07,2.95\n", "distances.csv", "unit"),
    ],
)
def test_faults_of_the_table(kit, tmp_path, text, line, words):
    error = fault(kit, tmp_path, distances_csv=text)
    assert line in error.where
    assert "distances.csv" in error.where
    assert words in str(error)


@pytest.mark.parametrize(
    ("new", "words"),
    [
        ("distances:\n  file: distance.csv\n  noise: 0.02 mm\n", "distance.csv"),
        ("distances:\n  file: distances.csv\n  noise: 0.2\n", "size"),
        ("distances:\n  file: distances.csv\n  noise: 1 deg\n", "deg"),
        ("distances:\n  file: distances.csv\n  noise: -1 mm\n", "noise"),
        ("distances: distances.csv\n", "distances"),
        ("distance:\n  file: distances.csv\n", "distances"),
    ],
)
def test_faults_of_the_key(kit, tmp_path, new, words):
    text = (kit / "session.yaml").read_text()
    error = fault(kit, tmp_path, session_yaml=text[: text.index("\ndistances:")] + "\n" + new)
    assert words in str(error)


def test_each_row_may_have_its_own_deviation(kit, tmp_path):
    for path in kit.iterdir():
        if path.is_file():
            (tmp_path / path.name).write_text(path.read_text())
    text = "from,to,distance [mm],sigma [um]\nm00,m01,40,20\nm01,m00,40.01,30\n"
    (tmp_path / "distances.csv").write_text(text)
    (links,) = load_session(tmp_path).links
    np.testing.assert_allclose(links.sigma, [20e-6, 30e-6], rtol=1e-12)
    np.testing.assert_allclose(links.value, [0.04, 0.04001], rtol=1e-12)
    assert links.configuration.tolist() == [
        links.configuration[0].tolist(),
        links.configuration[0, ::-1].tolist(),
    ]
