"""``pkmcal watch`` from images: verdicts, files, and refusals."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from conftest import run
from document_keys import assert_keys
from page_documents import page_blocks, page_document, page_text
from pkmcal.api.watch import WatchResult
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.calibration.saved_calibration import CalibrationPrior, load
from pkmcal.cameras import load_camera
from pkmcal.files import csv_text, read_csv
from pkmcal.geometry.cylinders import tangent_basis
from pkmcal.identify.start import start_state
from pkmcal.judge import new_data
from pkmcal.judge.causes import magnification, magnified
from pkmcal.judge.changes import change
from pkmcal.judge.fixed_machine import Trust, change_evidence, hold
from pkmcal.judge.watch import watch_machine
from pkmcal.measurements import Measurements, Observation
from pkmcal.mechanisms import load_mechanism, mechanism_text
from pkmcal.placement.default_camera import default_camera
from pkmcal.placement.edges import EdgeNoise, simulate_edges
from pkmcal.placement.stations import StationPose
from pkmcal.report.calibration import save
from pkmcal.session.load import digests, load_session
from pkmcal.simulation import Settings, load_truth, simulate_session
from pkmcal.simulation.truth import draw_truth
from rendered import rendered


def imaged(folder, nominal, machine, camera, seed, **settings):
    """New images of a machine, beside its nominal model; the truth is not used otherwise."""
    wanted = {"stations": 1, "configurations": 4, "tolerance": 0.0, **settings}
    rendered(folder, machine, camera, Settings(**wanted), seed)
    (folder / "mechanism.yaml").write_text(mechanism_text(nominal))
    (folder / "truth.json").unlink()
    return folder


def changed(machine, name, by):
    values = machine.values.copy()
    values[machine.parameters.index(name)] += by
    return machine.with_values(values)


@pytest.fixture(scope="module")
def later(demo, tmp_path_factory):
    """New images of the demonstration's machine, unchanged and with another offset of leg 3.

    Images do not show an offset: with 2.5 mm more of it the same poses have readings that are as
    much less.
    """
    folder = tmp_path_factory.mktemp("watch")
    nominal = load_mechanism(demo.session / "mechanism.yaml")
    true = load_truth(demo.session, nominal).machine
    camera = load_camera(next((demo.session / "cameras").iterdir()))
    same = imaged(folder / "same", nominal, true, camera, 34)
    off = shutil.copytree(same, folder / "off")
    table = read_csv(same / "joints.csv")
    readings = table.values - 2.5e-3 * (np.arange(6) == 2)
    (off / "joints.csv").write_text(csv_text(table.columns, table.names, readings))
    return SimpleNamespace(folder=folder, same=same, off=off)


@pytest.fixture
def again(later, tmp_path):
    """A copy of the unchanged session, to spoil."""
    return shutil.copytree(later.same, tmp_path / "again")


@pytest.fixture
def calibration(demo, tmp_path):
    """A copy of the calibration, to spoil."""
    return shutil.copytree(demo.calibration, tmp_path / "calibration")


def spoiled(folder, what):
    """Change a calibration's document."""
    path = folder / "calibration.json"
    document = json.loads(path.read_text())
    what(document)
    path.write_text(json.dumps(document))


@pytest.fixture(scope="module")
def unchanged(demo, later):
    """Result of ``watch`` for the unchanged machine, and its folder."""
    folder = later.folder / "w"
    done = run("watch", demo.calibration, later.same, "-o", folder, "--json")
    return SimpleNamespace(folder=folder, run=done)


def test_an_unchanged_machine(unchanged):
    done = unchanged.run
    assert done.err == ""
    assert done.code == done.json["exit_code"] == 0
    assert_keys("watch --json", done.json)
    assert done.json["verdict"]["headline"].startswith(
        "Still as calibrated, as far as 4 new configurations can show: a change of any leg's length"
    )
    assert not done.json["changed"]
    assert [leg["legs"] for leg in done.json["legs"]] == [[k] for k in range(1, 7)]
    for leg in done.json["legs"]:
        assert 3 <= leg["dof"] <= 7
        assert leg["adjusted"] >= done.json["alpha"]
        assert 1e-4 < leg["detectable"]["zero"] < 2e-3
        assert leg["zero"]["unit"] == "m"
    assert done.json["known_configurations"] == []
    assert len(done.json["configurations"]) == 4
    page = page_document((unchanged.folder / "watch.html").read_text())
    assert page["verdict"]["headline"] == done.json["verdict"]["headline"]
    assert page["verdict"]["stamp"] == "Still as calibrated"
    tests, run_chart = (block["plots"] for block in page_blocks(page, "panels"))
    (bars,) = (mark for mark in tests[0]["marks"] if mark["mark"] == "bars")
    assert [bar["key"] for bar in bars["points"]] == [f"leg:{k}" for k in range(1, 7)]
    assert all(bar["y"] < 1 for bar in bars["points"])  # thresholds
    (dots,) = (mark for mark in run_chart[0]["marks"] if mark["mark"] == "dots")
    assert [dot["x"] for dot in dots["points"]] == done.json["configurations"]
    retained = json.loads((unchanged.folder / "watch.json").read_text())
    assert retained["pkmcal_watch"] == 1
    assert retained["legs"] == done.json["legs"]
    assert retained["runs"] == done.json["runs"]


def test_a_changed_machine_in_words(demo, later):
    done = run("watch", demo.calibration, later.off)
    assert done.code == 1
    text = " ".join(done.out.split())
    assert "The machine is not as calibrated: leg 3 has changed" in text
    assert "zero of leg 3's reading by +2." in text
    assert "Found from" in text
    page = page_document((later.off / "watch" / "watch.html").read_text())
    assert page["verdict"]["stamp"] == "Changed"
    tests, _ = (block["plots"] for block in page_blocks(page, "panels"))
    (bars,) = (mark for mark in tests[0]["marks"] if mark["mark"] == "bars")
    assert max(bars["points"], key=lambda bar: bar["y"])["key"] == "leg:3"


def test_one_folder_holds_the_history_of_a_machine(demo, later, unchanged, tmp_path):
    """Each later test adds its run; the same data again replace theirs."""
    folder = shutil.copytree(unchanged.folder, tmp_path / "watch")
    results = [[one["result"] for one in unchanged.run.json["runs"]]]
    for _ in range(2):
        printed = run("watch", demo.calibration, later.off, "-o", folder, "--json").json
        document = json.loads((folder / "watch.json").read_text())
        assert printed["runs"] == document["runs"]
        results.append([one["result"] for one in document["runs"]])
    first, second, again = results
    assert first == ["as_calibrated"]
    assert second == again == ["as_calibrated", "changed"]
    same, off = document["runs"]
    assert same["session"].endswith("same")
    assert same["share"] < 1 < off["share"]
    assert same["calibration"] == off["calibration"]
    zero = next(one for one in off["zeros"] if one["legs"] == [3])
    assert abs(zero["value"]) > zero["limit"] > zero["sigma"]
    plots = [
        plot
        for block in page_blocks(
            page_document((folder / "watch.html").read_text()), "panels", "history"
        )
        for plot in block["plots"]
    ]
    (dots,) = (mark for mark in plots[0]["marks"] if mark["mark"] == "dots")
    assert [dot["y"] for dot in dots["points"]] == pytest.approx(
        [same["share"], off["share"]], 1e-4
    )
    (limit,) = (mark for mark in plots[0]["marks"] if mark["mark"] == "rule")
    assert limit["at"] == 1


def test_runs_against_another_calibration_are_kept_and_not_drawn(demo, later, unchanged, tmp_path):
    folder = shutil.copytree(unchanged.folder, tmp_path / "watch")
    path = folder / "watch.json"
    document = json.loads(path.read_text())
    other = {**document["runs"][0], "calibration": "0" * 16, "result": "another_machine"}
    path.write_text(json.dumps({**document, "runs": [other]}))
    run("watch", demo.calibration, later.same, "-o", folder)
    assert len(json.loads(path.read_text())["runs"]) == 2
    page = page_document((folder / "watch.html").read_text())
    assert not page_blocks(page, "panels", "history")


ZERO = {"legs": [1], "unit": "m", "value": 0.0, "sigma": 1e-5, "limit": 3e-5}
RUN = {
    "time": "2026-01-31T12:00:00", "session": "s", "digest": "0", "calibration": "0",
    "configurations": 5, "result": "as_calibrated", "share": 0.5, "zeros": [ZERO],
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "place"),
    [
        ({"time": 3}, "time"),
        ({"time": "yesterday"}, "time"),
        ({"time": "2026-01-31T12:00:00+01:00"}, "time"),
        ({"zeros": [{**ZERO, "limit": 0.0}]}, "limit"),
        ({"zeros": [{**ZERO, "legs": []}]}, "legs"),
    ],
)
def test_a_history_that_cannot_be_read_is_refused_before_the_work(
    demo, later, tmp_path, change, place
):
    folder = tmp_path / "watch"
    folder.mkdir()
    (folder / "watch.json").write_text(json.dumps({"runs": [RUN]}))
    assert len(WatchResult.check_folder(folder)) == 1
    (folder / "watch.json").write_text(json.dumps({"runs": [{**RUN, **change}]}))
    done = run("watch", demo.calibration, later.same, "-o", folder, "--json")
    assert done.code == 2
    assert "watch.json" in done.json["where"]
    assert place in done.json["message"]


def test_configurations_that_the_calibration_used_are_left_out(demo, later, calibration):
    """Two of four are identified by the content of their images."""
    session = load_session(later.same)
    reference_values = list(session.configurations[:2])

    def listed(document):
        for entry, name in zip(document["configurations"], reference_values, strict=False):
            entry["photographs"] = digests(session)[name]

    spoiled(calibration, listed)
    value = watch_machine(calibration, session)
    assert value.as_dict()["known_configurations"] == reference_values
    saved = load(calibration)  # few new images are localized with its readings as well
    np.testing.assert_array_equal(value.session.earlier_joints, saved.joints[saved.used])
    assert value.as_dict()["configurations"] == list(session.configurations[2:])
    assert (
        f"made from configuration {reference_values[0]} and {reference_values[1]}"
        in value.verdict.warnings[0]
    )


def test_the_calibrations_own_session(demo, session):
    done = run("watch", demo.calibration, session, "--json")
    assert (done.code, done.json["code"]) == (2, "session.not_new")
    assert "new images" in done.json["next_step"]


def test_a_calibration_that_was_refused(again, calibration):
    def refused(document):
        document["verdict"] |= {"usable": False, "reasons": ["The lens is not this camera's."]}

    spoiled(calibration, refused)
    done = run("watch", calibration, again, "--json")
    assert (done.code, done.json["code"]) == (2, "calibration.refused")
    assert done.json["found"] == "The lens is not this camera's."


def test_another_machine(demo, again):
    other = load_mechanism(again / "mechanism.yaml")
    far = changed(other, "legs[3].base.center.x", 0.05)
    (again / "mechanism.yaml").write_text(mechanism_text(far))
    done = run("watch", demo.calibration, again, "--json")
    assert (done.code, done.json["code"]) == (2, "calibration.another_machine")


@pytest.mark.parametrize("alpha", ["0", "0.5", "nan"])
def test_a_share_of_false_alarms_that_makes_no_sense(demo, again, alpha):
    done = run("watch", demo.calibration, again, "--alpha", alpha, "--json")
    assert (done.code, done.json["where"], done.json["found"]) == (2, "--alpha", alpha)
    assert "0.2" in done.json["expected"]


def test_an_output_folder_with_other_things(demo, again):
    done = run("watch", demo.calibration, again, "-o", again, "--json")
    assert (done.code, done.json["code"]) == (2, "output.foreign_files")


def test_no_calibration_there(again):
    done = run("watch", again, again, "--json")
    assert (done.code, done.json["code"]) == (2, "calibration.missing")


# a camera that was left in place


@pytest.fixture(scope="module")
def stayed(demo, later):
    """New images by the demonstration's first camera, which nobody touched."""
    nominal = load_mechanism(demo.session / "mechanism.yaml")
    truth = load_truth(demo.session, nominal)
    camera = load_camera(next((demo.session / "cameras").iterdir()))
    place = StationPose.of(truth.T_camera_base[0])
    folder = later.folder / "stayed"
    imaged(folder, nominal, truth.machine, camera, 35, stations=(place,))
    assert load_session(folder).station_names == truth.stations[:1]
    return SimpleNamespace(folder=folder, name=truth.stations[0])


def test_a_camera_that_was_left_in_place_finds_less(demo, stayed, tmp_path):
    results = [
        run("watch", demo.calibration, stayed.folder, "-o", tmp_path / str(k), "--json", *more)
        for k, more in enumerate([(), ("--same-place", stayed.name)])
    ]
    assert [done.code for done in results] == [0, 0]
    assert results[0].json["same_place"] == []
    assert results[1].json["same_place"] == [stayed.name]
    assert results[1].json["moved_stations"] == []
    least = [np.mean([leg["detectable"]["zero"] for leg in done.json["legs"]]) for done in results]
    assert least[1] < 0.8 * least[0]
    moved_text, fixed_text = (
        page_text(page_document((tmp_path / name / "watch.html").read_text())) for name in "01"
    )
    assert f"Left in place: {stayed.name}" in fixed_text
    assert "Left in place" not in moved_text


def test_stations_are_numbered_without_images_that_were_not_placed(demo, stayed, monkeypatch):
    """As those by hand are; the camera that was left in place is then another one's number."""
    session = load_session(stayed.folder)
    lost = replace(session.stations[0], name="by hand/1")
    whole = replace(session, stations=(lost, *session.stations))

    def without_the_first(saved, session, *rest):
        return new_data.measured_new_data(saved, session.without({0: "no place"}), *rest)

    monkeypatch.setattr("pkmcal.judge.watch.measured_new_data", without_the_first)
    value = watch_machine(load(demo.calibration), whole, same_place=[stayed.name])
    assert value.same_place == (stayed.name,)
    assert not value.stations_moved
    assert not value.judged.changed
    assert [one.station.name for one in value.session.rejected] == ["by hand/1"]


@pytest.mark.slow
def test_a_camera_that_stands_elsewhere_is_reported(demo, later, stayed, tmp_path):
    """A camera decimetres away, far beyond the linear range: localized again, and no leg is
    reported.
    """
    done = run(
        "watch", demo.calibration, later.same, "--same-place", stayed.name, "-o", tmp_path / "w",
        "--json",
    )  # fmt: skip
    assert done.code == 0
    assert done.json["same_place"] == []
    assert [shifted["name"] for shifted in done.json["moved_stations"]] == [stayed.name]
    assert "does not stand where the calibration had it" in done.json["verdict"]["warnings"][0]


def test_a_station_that_is_none(demo, again, stayed, calibration):
    done = run("watch", demo.calibration, again, "--same-place", "attic", "--json")
    assert (done.code, done.json["where"], done.json["found"]) == (2, "--same-place", "attic")
    spoiled(calibration, lambda document: document.pop("station_covariance"))
    done = run("watch", calibration, again, "--same-place", stayed.name, "--json")
    assert (done.code, done.json["code"]) == (2, "calibration.no_covariance")


# the lens


def edges_through(camera, wrong, edges):
    """Edges as a camera shows them that another is taken for, with the pixels on them."""
    # the tangent plane at a normal is the plane of the edge's rays
    one, other = edges.basis[..., 0], edges.basis[..., 1]
    first = (np.abs(one[:, 2]) > np.abs(other[:, 2]))[:, None]
    ahead, offset = np.where(first, one, other), np.where(first, other, one)
    ahead = ahead * np.sign(ahead[:, 2:])
    rays = ahead[:, None] + np.array([-0.1, 0.0, 0.1])[:, None] * offset[:, None]
    pixels = camera.project(rays)
    values = wrong.ray(pixels)
    normal = np.cross(values[:, 0], values[:, 2])
    normal = normal / np.linalg.norm(normal, axis=1)[:, None]
    normal = normal * np.sign(np.sum(normal * edges.normal, axis=1))[:, None]
    visible = replace(edges, normal=normal, basis=tangent_basis(normal, values[:, 1]))
    at = np.repeat(np.arange(len(edges)), 3)
    none = np.zeros((1, 4, 4))
    return Observation(visible, (), pixels.reshape(-1, 2), at, none)


def test_a_cameras_magnification_is_reported():
    """Images by a lens that is 0.5 % longer than its file states: the change is recovered."""
    nominal, camera, longer = load_mechanism("gough-stewart"), default_camera(), 5e-3
    focal = camera.parameters.copy()
    focal[:2] *= 1 + longer
    real = replace(camera, parameters=focal)
    settings = Settings(stations=2, configurations=6, tolerance=0.0)
    truth = draw_truth(nominal, (camera,) * 2, settings, 4)
    edges, readings = simulate_edges(
        truth.machine, truth.T_camera_base, camera, truth.T_base_platform, EdgeNoise(),
        np.random.default_rng(4), images=truth.images,
    )  # fmt: skip
    cause, got = magnification(nominal, 0), []
    for through in (camera, real):
        observed = edges_through(through, camera, edges)
        data = Measurements(observed.edges, readings, 3e-6, 2, np.zeros(2, dtype=int))
        start = start_state(nominal, data, truth.T_camera_base)
        wide = magnified(data, observed, (camera, camera))
        exact = np.diag(np.full(len(nominal.parameters), 1e-12))
        count = change_evidence(
            hold(nominal, data, start, Trust.full(data), wide), CalibrationPrior(exact)
        )
        assert count.by.shape[1] == len(nominal.parameters) + 1
        got.append(change(count, cause))
    assert got[1].sigma[0] < longer / 4
    assert got[1].value[0] - got[0].value[0] == pytest.approx(longer, rel=0.05)


# images as large as a user's


@pytest.mark.slow
def test_half_a_millimetre_in_five_images(tmp_path):
    """Rendered at 800x600: five machines that did not change, and a leg's zero off by 0.5 mm."""
    nominal, camera = load_mechanism("gough-stewart"), default_camera()
    settings = Settings(stations=3, configurations=8)
    truth = simulate_session(tmp_path / "before", nominal, camera, settings, seed=11)
    save(calibrate_session(tmp_path / "before"), tmp_path / "calibration")
    retained = load(tmp_path / "calibration")
    for seed in range(5):
        folder = tmp_path / f"same{seed}"
        imaged(folder, nominal, truth.machine, camera, 100 + seed, configurations=5)
        assert watch_machine(retained, folder).verdict.usable
    off = changed(truth.machine, "legs[3].length.offset", 0.5e-3)
    folder = imaged(tmp_path / "off", nominal, off, camera, 303, stations=2, configurations=5)
    value = watch_machine(retained, folder)
    first = value.judged.findings[0].suspect
    assert not value.verdict.usable
    assert "leg 3 has changed" in value.verdict.headline
    assert (first.cause.part, first.cause.legs) == ("zero", (2,))
    assert abs(first.change.value[0] - 0.5e-3) < 3 * first.change.sigma[0]
