"""Mistakes of users in a session: each one gets a sentence with a next step.

Every mistake goes through ``pkmcal calibrate``, and most through ``pkmcal check``, which must give
the same message; further refusals of loading a session are in test_session.py. Mistakes in images
take a search of many seconds, so only ``calibrate`` is tested here, ``check`` in test_check.py;
test_diagnose.py has the other mistakes of this kind.
"""

from __future__ import annotations

import errno
import os
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml

from conftest import run
from faults import raises, replaced
from pkmcal.api.calibrate import CalibrationResult
from pkmcal.errors import InputError
from pkmcal.session.load import load_session


def rows(session, change):
    """joints.csv with its rows (lists of cells, the header first) changed in place."""
    path = session / "joints.csv"
    table = [line.split(",") for line in path.read_text().splitlines()]
    change(table)
    path.write_text("\n".join(",".join(cells) for cells in table) + "\n")


def stations(session, change):
    """session.yaml with its stations changed in place."""
    path = session / "session.yaml"
    document = yaml.safe_load(path.read_text())
    change(document["stations"])
    path.write_text(yaml.safe_dump(document, sort_keys=False))


def only(session, *names):
    """session.yaml with these stations alone: each of the others is a search more."""
    stations(session, lambda item: [item.pop(name) for name in [*item] if name not in names])


def images(session, station):
    return sorted((session / "images" / station).iterdir())


def refused(session, *text):
    """The sentence of both commands, which holds all of `text`; nothing was written."""
    sentence = refused_by_calibrate(session, *text)
    value = run("check", session, "--json")
    assert value.code == 2
    assert sentence in [finding["text"] for finding in value.json["findings"]]
    return sentence


def refused_by_calibrate(session, *text):
    """The sentence, which holds all of `text`; nothing was written."""
    done = run("calibrate", session)
    assert (done.code, done.out) == (2, "")
    sentence = done.err.removeprefix("Error: ").rstrip("\n")
    assert "\n" not in sentence
    for words in text:
        assert words in sentence
    assert not (session / "calibration").exists()
    return sentence


# files


def test_no_such_folder(tmp_path):
    text = refused(tmp_path / "none")
    assert text == f"{tmp_path / 'none'}: there is no such session folder."


def test_an_empty_folder(tmp_path):
    text = refused(tmp_path)
    assert text == (
        f"{tmp_path}: the folder holds no session.yaml."
        " Name the session's folder; pkmcal new DIR makes one to fill in."
    )


def test_a_file_in_the_place_of_the_folder(tmp_path):
    (tmp_path / "notes.txt").touch()
    refused(tmp_path / "notes.txt", "there is no such session folder")


def test_a_missing_file(session):
    (session / "joints.csv").unlink()
    refused(session, "session.yaml, line ", "joints.file: there is no such file; found joints.csv")


def test_an_unknown_key(session):
    replaced(session / "session.yaml", "observe: legs", "obsserve: legs", 1)
    refused(session, "session.yaml, line ", "obsserve", "observe")


def fault(*words):
    """Code, value found and exit code of a command's only error."""
    done = run(*words, "--json")
    return done.json["code"], done.json["found"], done.code


def test_other_things_in_the_place_of_a_session(session, tmp_path):
    (image,) = images(session, "station1")[:1]
    assert fault("calibrate", image) == ("session.missing", "a file", 2)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "calibration.json").write_text("{}")
    # validate and watch with the two the other way round
    for words in (["calibrate"], ["plan"], ["validate", session], ["watch", session]):
        assert fault(*words, tmp_path / "out") == ("session.missing", "a calibration", 2)


@pytest.mark.parametrize(
    ("content", "found"),
    [(b"PK\x03\x04\x80", "a spreadsheet"), (b"\x89PNG\r\n", "an image"),
     (b"\xff\xd8\xff\xe0", "an image"), (b"\xff\xfea\0", "byte 0xff")],
)  # fmt: skip
@pytest.mark.parametrize("name", ["session.yaml", "joints.csv"])
def test_a_file_that_is_not_text_is_called_what_it_is(session, name, content, found):
    (session / name).write_bytes(content)
    assert fault("calibrate", session) == ("file.not_text", found, 2)
    if found == "an image":
        assert fault("plan", "3-rpr", "--camera", session / name)[1] == found


def test_the_page_of_a_calibration_in_the_place_of_its_folder(tmp_path):
    for name in ("report.html", "calibration.json"):
        (tmp_path / name).write_text("x")
    done = run("export", tmp_path / "report.html", "--to", "c", "--json")
    assert (done.code, done.json["code"]) == (2, "calibration.other_file")
    assert str(tmp_path) in done.json["next_step"]


# readings


def test_wrong_columns(session):
    rows(session, lambda table: [cells.pop() for cells in table])
    refused(
        session,
        "joints.csv, line 1: another number of joint columns than the machine has actuated legs;"
        " found 5 (leg1, leg2, leg3, leg4, leg5), expected 6.",
    )


# images


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in folders here")
def test_a_pipe_with_the_name_of_a_image(session):
    path = images(session, "station2")[1]
    path.unlink()
    os.mkfifo(path)
    refused(session, f"images/station2/{path.name}: this is a pipe, not a file")


def test_a_folder_with_the_name_of_a_image(session):
    path = images(session, "station2")[1]
    path.unlink()
    path.mkdir()
    refused(session, f"images/station2/{path.name}: this is a folder, not a file")


def test_a_folder_beside_the_images_is_nobodys_business(session):
    files = images(session, "station2")
    files[1].with_name("thumbnails.png").mkdir()
    assert [p.path for p in load_session(session).stations[1].images] == files


LONG = "n" * 5000


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("session.yaml", "mechanism: ", f"mechanism: {LONG} # ", "mechanism: the file"),
        ("session.yaml", "mechanism: ", f"mechanism: {LONG}.yaml # ", "mechanism: the file"),
        ("session.yaml", "images/station1", f"images/{LONG}", "images: there is no image"),
        ("session.yaml", "{configuration}", f"{{{LONG}}}", "this placeholder is not known"),
        ("session.yaml", "joints:", f"a: !{LONG} 3\njoints:", "is not allowed"),
        ("joints.csv", "0003", LONG, "joints.csv, line 5: this name is too long"),
        ("joints.csv", "leg3", LONG, "joints.csv, line 1: this name is too long"),
        ("mechanism.yaml", "name: ", f"name: {LONG} # ", "expected text of 255 characters at most"),
    ],
)  # fmt: skip
def test_names_of_five_thousand_letters(session, name, old, new, message):
    replaced(session / name, old, new, 1)
    assert len(refused(session, message)) < 1000


def test_a_path_through_what_was_not_measured(session):
    replaced(
        session / "session.yaml", "joints:", "paths: {ruler: ['0000', '0001', 'x']}\njoints:", 1
    )
    refused(
        session, "session.yaml, line 3, paths.ruler[3]: there is no such configuration; found x"
    )


def test_a_path_that_is_too_short(session):
    replaced(
        session / "session.yaml", "joints:", "paths: {ruler: ['0000', '0000', '0001']}\njoints:", 1
    )
    refused(
        session, "session.yaml, line 3, paths.ruler: too few configurations for a straight path"
    )


def test_a_zero_in_a_pattern(session):
    replaced(session / "session.yaml", "images: ", 'images: "a\\0{configuration}.png" # ', 1)
    refused(session, "session.yaml, line ", "images: this text holds a character")


def test_a_damaged_image_is_reported_by_pkmcal_alone(session, capfd):
    path = images(session, "station2")[1]
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 255
    path.write_bytes(data)
    refused(session, f"images/station2/{path.name}: the image cannot be decoded; found a PNG")
    assert capfd.readouterr() == ("", "")


def test_an_image_cut_short(session):
    path = images(session, "station2")[1]
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    text = refused(session)
    assert text == (
        f"images/station2/{path.name}: the image cannot be decoded; found a PNG file that"
        " ends early, expected a whole PNG or JPEG file. Copy it again from the camera, or remove"
        " it: an absent image is allowed."
    )


@pytest.mark.slow
def test_images_of_something_else(session):
    rng = np.random.default_rng(1)
    for path in images(session, "station2"):
        cloud = cv2.GaussianBlur(rng.normal(size=(360, 480)), (0, 0), 9)
        picture = 255 * (cloud - cloud.min()) / np.ptp(cloud)
        assert cv2.imwrite(str(path), picture.astype(np.uint8))
    only(session, "station1", "station2")
    refused_by_calibrate(
        session,
        "session.yaml, stations.station2: the machine was not localized in the images of"
        " station2; found legs that readings of other configurations fit as well",
        "Check that these images show this machine's legs, that each bears the name of its"
        " configuration, and that the nominal model is this machine's.",
    )


@pytest.mark.slow
def test_two_stations_swapped(session):
    def swap(value):
        first, second = value["station1"], value["station2"]
        first["pose"], second["pose"] = second["pose"], first["pose"]

    stations(session, swap)
    only(session, "station1", "station2")
    text = refused_by_calibrate(session)
    assert text == (
        "session.yaml, stations: stations station1 and station2 are mixed up; found the"
        " images of each fit the pose of the other. Exchange the poses of station1 and"
        " station2 in session.yaml, or their image folders."
    )


# outputs


def unwritten(session, out, *text):
    before = sorted(path for path in session.rglob("*"))
    done = run("calibrate", session, "-o", out)
    assert (done.code, done.out) == (2, "")
    for words in text:
        assert words in done.err
    assert sorted(path for path in session.rglob("*")) == before


def test_output_inside_a_file(session):
    out = session / "joints.csv" / "out"
    unwritten(session, out, f"{out}: outputs cannot go here; found", "joints.csv is a file")


def test_output_is_a_file(session):
    unwritten(session, session / "joints.csv", "outputs cannot go here; found")


def test_output_folder_of_the_kernels(session):
    if not os.path.isdir("/proc/self"):  # noqa: PTH112
        pytest.skip("no folder here that even an administrator cannot write to")
    unwritten(session, "/proc/self/out", "/proc/self/out: cannot be written", "Name another folder")


def test_no_work_is_spent_before_the_output_is_known_to_be_writable(session, monkeypatch):
    def worked(*_, **__):
        pytest.fail("calibrated before looking at the output folder")

    monkeypatch.setattr("pkmcal.api.calibrate.calibrate_session", worked)
    unwritten(session, session / "joints.csv", "outputs cannot go here")


def test_a_disk_that_fills_up_leaves_nothing(session, calibrated, monkeypatch):
    def full(_self, _content):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    result = CalibrationResult.of(replace(calibrated, images={}))
    where = str(session / "calibration")
    with raises(InputError, code="file.unwritable", where=where) as caught:
        result.save(session / "calibration")
    assert os.strerror(errno.ENOSPC) in caught.value.what
    assert not (session / "calibration").exists()
    assert not list(session.glob(".*"))
