"""A calibration as a recording: its content, by itself, and in rerun's own reader."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from conftest import run
from fuzz import bases
from pkmcal.errors import InputError
from pkmcal.files import staged_file
from pkmcal.geometry.rigid import apply, inverse
from pkmcal.observe.images import decode
from pkmcal.report import rrd
from pkmcal.report.recording import RECORDED_GREY, VIEWER_PIXEL_CORNER, recorded

LOUD = "NO RERUN: recordings were not written and read by it (pip install '.[rerun]')"
NEAR, MIDDLE = 1.0, 0.15
"""px, of any edge and of the median one: shading moves single edges by half a pixel, most by less
than 0.1. An image's corner taken for a pixel's centre moves all of them by 0.35 and more."""


@pytest.fixture(scope="module")
def entries(calibrated):
    return list(recorded(calibrated))


def of(entries, *path, at=None):
    """The newest log entry of a path up to a configuration, as a viewer shows it."""
    results = [e for e in entries if e.path == path and (e.at is None or at is None or e.at <= at)]
    return results[-1]


def image(station, *part):
    return ("machine", "cameras", station, "image", *part)


def decoded(entry):
    coded = np.frombuffer(entry.values["jpeg"], dtype=np.uint8)
    return cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE)


def test_every_image_is_there_in_its_place(calibrated, entries):
    session = calibrated.session
    for station in session.stations:
        display = {e.at: e for e in entries if e.path == image(station.name, "photograph")}
        assert sorted(display) == list(range(1, len(session.configurations) + 1))
        taken = {p.configuration + 1: p for p in station.images}
        assert {e.kind for e in display.values()} == {"photograph"}
        assert {at for at, e in display.items() if decoded(e).any()} == set(taken)
        at, photo = next(iter(taken.items()))
        grey = decoded(display[at])
        truth = decode(photo.path, station.camera.image_size, "photograph")
        assert np.abs(grey.astype(float) - truth).mean() < 2  # grey levels, of JPEG


def test_a_station_without_an_image_shows_nothing_of_the_last_one(calibrated, entries):
    session = calibrated.session
    absent = [
        (station.name, k + 1)
        for station in session.stations
        for k in range(len(session.configurations))
        if k not in {p.configuration for p in station.images}
    ]
    assert absent
    for name, at in absent:
        for part in ("edges", "aside", "contour"):
            assert of(entries, *image(name, part), at=at).kind == "clear"
        # black, since rerun's viewer continues to show encoded images that were cleared
        assert not decoded(of(entries, *image(name, "photograph"), at=at)).any()


def projected(calibrated, entries, name, points):
    """Pixels of points (n, 3), base frame, by the camera's logged pose."""
    (station,) = (s for s in calibrated.session.stations if s.name == name)
    T = of(entries, "machine", "cameras", name).values["T"]
    return station.camera.project(apply(inverse(T), points)) + 0.5


def apart(strip, line):
    """Distance (px) of a strip's ends and middle from the nearest part of a line of many points."""
    points = strip[[0, len(strip) // 2, -1]][:, None]
    start, direction = line[:-1], np.diff(line, axis=0)
    share = np.sum((points - start) * direction, axis=-1) / np.sum(direction**2, axis=-1)
    nearest = start + np.clip(share, 0, 1)[..., None] * direction
    return np.linalg.norm(points - nearest, axis=-1).min(axis=1).max()


def test_tubes_in_space_lie_on_their_edges_in_the_images(calibrated, entries):
    """From logged data only: the camera's pose and lens, the tubes, the edges."""
    off: list[float] = []
    for e in entries:
        if e.path[-1] != "edges" or e.kind != "lines2d" or "cameras" not in e.path:
            continue
        station = e.path[2]
        tubes = of(entries, "machine", "calibrated", at=e.at).values
        T = of(entries, "machine", "cameras", station).values["T"]
        sides = []
        for (a, b), radius in zip(tubes["strips"], tubes["radii"], strict=True):
            # what the eye sees of a thin tube: its axis, a radius to either side
            out = np.cross(b - a, (a + b) / 2 - T[:3, 3])
            out *= radius / np.linalg.norm(out)
            along = a + np.linspace(0, 1, 60)[:, None] * (b - a)  # a lens bends it
            sides += [projected(calibrated, entries, station, along + s * out) for s in (-1, 1)]
        off += [min(apart(strip, side) for side in sides) for strip in e.values["strips"]]
    assert max(off) < NEAR
    assert np.median(off) < MIDDLE
    assert len(off) == int(np.sum(calibrated.estimate.edge_weights >= 0.5))


def test_contours_lie_on_the_edges(calibrated, entries):
    """All but those of which another leg hides an end."""
    off: list[float] = []
    for e in entries:
        if e.path[-1] == "edges" and e.kind == "lines2d":
            contour = of(entries, *e.path[:-1], "contour", at=e.at).values["strips"]
            off += [min(apart(strip, line) for line in contour) for strip in e.values["strips"]]
    assert np.median(off) < MIDDLE
    assert np.mean(np.array(off) < NEAR) > 0.8


def test_rejected_edges_are_recorded_apart(calibrated):
    weights = calibrated.estimate.edge_weights.copy()
    edges = calibrated.observation.edges
    n = 3
    weights[n] = 0.2
    downweighted = replace(calibrated, estimate=replace(calibrated.estimate, edge_weights=weights))
    entries = list(recorded(downweighted))
    station = calibrated.session.stations[edges.station[n]].name
    at = edges.configuration[n] + 1
    offset = of(entries, *image(station, "aside"), at=at).values
    assert len(offset["strips"]) == 1
    assert offset["colours"] == [RECORDED_GREY]
    (label,) = offset["labels"]
    assert label.startswith(f"leg {edges.leg[n] + 1}, tube {edges.tube[n] + 1}")
    assert label.endswith("weight 0.20")


def test_poses_and_numbers_are_the_calibrations(calibrated, entries):
    estimate = calibrated.estimate
    for k, T in enumerate(estimate.state.T_base_platform):
        items = of(entries, "machine", "platform", at=k + 1)
        np.testing.assert_array_equal(items.values["T"], T)
        points = of(entries, "machine", "calibrated", "centres", at=k + 1).values["points"]
        np.testing.assert_allclose(points[:6], estimate.machine.base_centers(), atol=1e-15)
        values = [
            of(entries, "readings", f"joint{j + 1}", at=k + 1).values["value"] for j in range(6)
        ]
        np.testing.assert_array_equal(values, calibrated.session.joints[k])
    assert calibrated.verdict.headline in of(entries, "result", "summary").values["text"]
    rows = of(entries, "result", "parameters").values["text"].splitlines()
    assert len(rows) == 2 + len(calibrated.machine.parameters)


def test_the_nominal_model_lies_beside_the_machine(calibrated, entries):
    """Fitted by all joint centres: millimetres off, as the tolerances allow, and not elsewhere."""
    new = np.array(of(entries, "machine", "calibrated", at=1).values["strips"])
    old = np.array(of(entries, "machine", "drawing", at=1).values["strips"])
    off = np.linalg.norm(new - old, axis=-1)
    assert 1e-4 < off.max() < 0.02


def test_without_a_pose_nothing_of_the_machine_stays(calibrated):
    posed = calibrated.estimate.configurations.copy()
    posed[4] = False
    partly = replace(calibrated, estimate=replace(calibrated.estimate, configurations=posed))
    entries = list(recorded(partly))
    for part in ("platform", "calibrated", "drawing"):
        assert of(entries, "machine", part, at=5).kind == "clear"
        assert of(entries, "machine", part, at=6).kind != "clear"


# ------------------------------------------------------------------ words


def test_without_rerun_it_is_stated_before_the_work(session, tmp_path, monkeypatch):
    monkeypatch.setattr(rrd, "find_spec", lambda name: None)
    done = run("calibrate", session, "--rrd", tmp_path / "a.rrd", "-o", tmp_path / "out")
    assert done.code == 2
    assert "recordings need rerun, which is not installed" in done.err
    assert "pip install '.[rerun]'" in done.err
    assert not (tmp_path / "out").exists()


def test_the_recording_is_reported_with_the_other_files(tmp_path, monkeypatch):
    made, session = [], tmp_path / "session"
    bases.measured(session, seed=1, count=14)
    monkeypatch.setattr(rrd, "find_spec", lambda name: object())
    monkeypatch.setattr(rrd, "write_rrd", lambda value, path: made.append((value, path)))
    path = tmp_path / "a.rrd"
    done = run("calibrate", session, "--rrd", path, "-o", tmp_path / "out", "--json")
    assert done.code == 0
    assert done.json["files"][str(path)] == str(path)
    assert [(value.session.folder, to) for value, to in made] == [(session, path)]
    assert (tmp_path / "out" / "calibration.json").is_file()


def test_a_recording_goes_where_a_file_can_go(tmp_path, monkeypatch):
    monkeypatch.setattr(rrd, "find_spec", lambda name: object())
    with pytest.raises(InputError, match=r"another ending; found a\.txt, expected NAME\.rrd"):
        rrd.check_rrd(tmp_path / "a.txt")
    (tmp_path / "b.rrd").mkdir()
    with pytest.raises(InputError, match="a folder stands where the recording should go"):
        rrd.check_rrd(tmp_path / "b.rrd")
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="outputs cannot go here"):
        rrd.check_rrd(tmp_path / "file" / "c.rrd")
    rrd.check_rrd(tmp_path / "new" / "d.rrd")
    assert not (tmp_path / "new").exists()


def test_a_file_that_is_not_finished_does_not_appear(tmp_path):
    path = tmp_path / "a.rrd"
    path.write_text("old")

    def half():
        with staged_file(path) as part:
            part.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        half()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
    with staged_file(path) as part:
        part.write_text("new")
    assert path.read_text() == "new"


# ------------------------------------------------------------------ in rerun's reader


def test_rerun_reads_what_was_recorded(calibrated, entries, tmp_path):
    chunk = pytest.importorskip("rerun.chunk", reason=LOUD)
    path = tmp_path / "bench.rrd"
    rrd.write_rrd(calibrated, path)
    assert list(tmp_path.iterdir()) == [path]
    reader = chunk.RrdReader(path)
    assert [s.application_id for s in reader.recordings()] == ["pkmcal"]
    assert len(reader.blueprints()) == 1
    rows: dict[str, list[dict]] = {}
    for part in reader.stream().to_chunks():
        batch = part.to_record_batch()
        retained = [name for name in batch.schema.names if name != "log_time"]
        rows.setdefault(part.entity_path, []).extend(batch.select(retained).to_pylist())
    wanted = {"/" + "/".join(e.path) for e in entries}
    assert wanted <= set(rows)
    name = calibrated.session.stations[0].name
    results = rows[f"/machine/cameras/{name}/image/photograph"]
    blobs = {
        row["configuration"]: row["EncodedImage:blob"]
        for row in results
        if row.get("EncodedImage:blob")
    }
    values = {
        e.at: e.values["jpeg"]
        for e in entries
        if e.path == image(name, "photograph") and e.kind == "photograph"
    }
    assert {at: bytes(blob[0]) for at, blob in blobs.items()} == values
    for row in rows["/machine/calibrated"]:
        strips = of(entries, "machine", "calibrated", at=row["configuration"]).values["strips"]
        np.testing.assert_allclose(
            row["LineStrips3D:strips"], strips, atol=1e-6
        )  # single precision
    for row in rows[f"/machine/cameras/{name}/image/edges"]:
        if row.get("LineStrips2D:strips") is not None:
            strips = of(entries, *image(name, "edges"), at=row["configuration"]).values["strips"]
            assert len(row["LineStrips2D:strips"]) == len(strips)
            for theirs, ours in zip(row["LineStrips2D:strips"], strips, strict=True):
                np.testing.assert_allclose(theirs, ours, atol=1e-3)
    (pinhole,) = rows[f"/machine/cameras/{name}/image"]
    k = np.array(pinhole["Pinhole:image_from_camera"][0]).reshape(3, 3).T  # columns first
    centre = calibrated.session.stations[0].camera.parameters[2:4]
    np.testing.assert_allclose(k[:2, 2], centre + VIEWER_PIXEL_CORNER, atol=1e-4)
