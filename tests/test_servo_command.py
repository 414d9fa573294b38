"""``pkmcal servo``: options, files, sentences and the page."""

from __future__ import annotations

import json

import numpy as np
import pytest

from conftest import run
from document_keys import assert_keys
from page_documents import page_blocks, page_document
from pkmcal.cameras.files import camera_text
from pkmcal.placement.default_camera import default_camera

QUICK = ("--runs", 3, "--rate", 6, "--noise", 0, "--joint-noise", 0, "--duration", 8, "--delay", 0)
HOME = "0,0,0.3567,0,0,0"


@pytest.fixture(scope="module")
def studied(tmp_path_factory):
    folder = tmp_path_factory.mktemp("servo") / "out"
    return run("servo", "gough-stewart", *QUICK, "-o", folder, "--json"), folder


def test_a_built_in_machine(studied):
    done, folder = studied
    assert done.code == 0, done.out
    assert done.json["usable"] is True
    assert done.json["estimates"]["identified"]["reached"] == 3
    assert sorted(p.name for p in folder.iterdir()) == ["servo.html", "servo.json"]
    document = json.loads((folder / "servo.json").read_text())
    assert document["estimates"] == done.json["estimates"]
    assert_keys("servo.json", document)
    assert_keys("servo --json", done.json)
    count = document["estimates"]
    assert count["true"]["astray_largest"] == 0
    assert count["hand"]["astray_median"] > 5 * count["identified"]["astray_median"] > 0
    assert document["settings"]["legs"] == [1, 2, 3, 4, 5, 6]
    curves = document["curves"]
    assert {len(values) for values in curves.values()} == {48}
    assert curves["identified"][0] == 1.0
    assert curves["identified"][-1] < 0.01


def test_the_page_shows_one_run(studied):
    """The animation ends at the goal, whose joints have their own line."""
    document = page_document((studied[1] / "servo.html").read_text(encoding="utf-8"))
    plots = [plot for one in page_blocks(document, "panels") for plot in one["plots"]]
    plots += page_blocks(document, "plot")
    assert {plot["name"] for plot in plots} == {"astray", "curves", "tail", "image"}
    (stage,) = page_blocks(document, "space")
    assert len(stage["poses"]) == 48
    first, last = (stage["poses"][k]["configuration"]["legs"] for k in (0, -1))
    joints = np.array([leg["platform"][-1] for leg in last])
    goal = next(path for path in stage["paths"] if path["dashed"])
    away = np.linalg.norm(joints[:, None] - np.array(goal["lines"][0]), axis=-1).min(axis=1)
    assert away.max() < 5e-4
    start = np.array([leg["platform"][-1] for leg in first])
    assert np.linalg.norm(start - joints, axis=1).max() > 5e-3
    assert [camera["name"] for camera in stage["machine"]["cameras"]] == ["camera"]


def test_words_for_people(tmp_path):
    done = run("servo", "gough-stewart", *QUICK, "--legs", "1,2,3", "--law", "directions",
               "-o", tmp_path / "out")  # fmt: skip
    assert done.code == 1
    assert "should not be used" in done.out
    assert "Identified" in done.out
    assert "servo.html" in done.out


def test_a_calibration_with_its_camera(demo, tmp_path):
    done = run("servo", demo.calibration, *QUICK, "-o", tmp_path / "out", "--json")
    assert done.code in (0, 1), done.out
    value = done.json
    assert value["station"] == "station1"
    assert value["estimates"]["identified"]["reached"] >= 2
    assert "calibration's covariance" in value["origin"]
    other = run("servo", demo.calibration, *QUICK, "--station", "station9", "-o", tmp_path / "two",
                "--json")  # fmt: skip
    assert (other.code, other.json["code"]) == (2, "calibration.no_station")
    assert other.json["found"] == "station9"


def test_one_way(tmp_path):
    """Requested start and goal: the same for every run; through a camera of one's own."""
    file = tmp_path / "camera.yaml"
    file.write_text(camera_text(default_camera()))
    done = run("servo", "gough-stewart", *QUICK, "--start", HOME, "--goal", "0.02,0,0.36,0,0,0.1",
               "--camera", file, "-o", tmp_path / "out", "--json")  # fmt: skip
    assert done.code == 0, done.out
    ways = {round(r["way"], 9) for r in done.json["estimates"]["true"]["runs"]}
    assert len(ways) == 1


@pytest.mark.parametrize(
    ("options", "where", "found"),
    [
        (("--gain", 0), "--gain", "0"),
        (("--gain", 30, "--delay", 3), "--gain", "30/s at 25 samples a second and a delay of 3"),
        (("--rate", -5), "--rate", "-5"),
        (("--speed", 0), "--speed", "0"),
        (("--duration", 3000), "--duration", "75000"),
        (("--legs", "1,1"), "--legs", "1,1"),
        (("--legs", "x"), "--legs", "x"),
        (("--legs", "1,2,9"), None, "legs 1, 2, 9"),
        (("--start", "1,2"), "--start", "1,2"),
        (("--goal", "0,0,0.6,0,0,0"), "--goal", "a reading of 0.6334 m for joint 1"),
        (("--station", "front"), "--station", "front"),
    ],
)
def test_wrong_options(tmp_path, options, where, found):
    done = run("servo", "gough-stewart", "--runs", 2, *options, "-o", tmp_path / "out", "--json")
    assert done.code == 2, done.out
    assert (done.json["where"], done.json["found"]) == (where, found)
    assert not (tmp_path / "out").exists()


def test_no_such_law(tmp_path):
    done = run("servo", "gough-stewart", "--law", "points", "-o", tmp_path / "out")
    assert done.code == 2, done.out
    assert "'points' is not one of 'edges', 'directions'" in done.err
    assert not (tmp_path / "out").exists()


def test_no_such_machine(tmp_path):
    done = run("servo", "nothing", "-o", tmp_path / "out", "--json")
    assert (done.code, done.json["code"]) == (2, "machine.unknown")
    assert done.json["found"] == "nothing"


def test_a_machine_without_tubes(tmp_path):
    done = run("servo", "delta", "-o", tmp_path / "out", "--json")
    assert done.code == 2
    assert (done.json["found"], done.json["expected"]) == ("none", "tubes")


def test_foreign_folders_stay(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "letter.txt").write_text("mine")
    done = run("servo", "gough-stewart", "-o", folder, "--json")
    assert (done.code, done.json["code"]) == (2, "output.foreign_files")
    assert done.json["found"] == "letter.txt"
    assert [p.name for p in folder.iterdir()] == ["letter.txt"]
