"""Sessions: what loads, and the sentence for everything that can be wrong with one."""

import json
import subprocess
import sys

import cv2
import numpy as np
import pytest

from faults import raises, replaced
from pkmcal.errors import InputError
from pkmcal.files import read_csv
from pkmcal.session.load import digests, load_session, session_digest
from pkmcal.session.readings import check_readings
from pkmcal.wording import MINUS_SIGN

SESSION = """\
pkmcal: 1
mechanism: gough-stewart
joints: {file: joints.csv, noise: 3.0e-6}
stations:
  front:
    camera: cameras/front.yaml
    images: images/front/{configuration}.png
    observe: legs
    pose:
      position: [0.0, -1.0, 0.2]
      look_at: [0.0, 0.0, 0.2]
      up: [0, 0, 1]
"""
CAMERA = "model: pinhole\nimage_size: [8, 6]\nfocal: [9.0, 9.0]\ncenter: [3.5, 2.5]\n"
JOINTS = """\
configuration,leg1,leg2,leg3,leg4,leg5,leg6
0000,0.36,0.37,0.38,0.39,0.40,0.41
0001,0.46,0.45,0.44,0.43,0.42,0.40
0002,0.40,0.41,0.38,0.36,0.46,0.35
"""


def image(path, width=8, height=6):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((height, width), 128, np.uint8))


@pytest.fixture
def folder(tmp_path):
    """A session of one station and three configurations that loads."""
    (tmp_path / "cameras").mkdir()
    (tmp_path / "session.yaml").write_text(SESSION)
    (tmp_path / "cameras" / "front.yaml").write_text(CAMERA)
    (tmp_path / "joints.csv").write_text(JOINTS)
    for name in ("0000", "0001", "0002"):
        image(tmp_path / "images" / "front" / f"{name}.png")
    return tmp_path


# what loads


def test_lengths_with_units_are_what_they_are_in_metres(folder):
    plain = load_session(folder)
    replaced(folder / "session.yaml", "noise: 3.0e-6", "noise: 3 um")
    replaced(folder / "session.yaml", "[0.0, -1.0, 0.2]", "[0 mm, -100 cm, 200 mm]")
    header, *rows = JOINTS.splitlines()
    rows = [row.split(",") for row in rows]
    rows = [",".join([row[0], *(f"{float(x) * 1000:g}" for x in row[1:])]) for row in rows]
    heads = header.replace(",", " [mm],").removeprefix("configuration [mm]") + " [mm]"
    (folder / "joints.csv").write_text("\n".join(["configuration" + heads, *rows]) + "\n")
    again = load_session(folder)
    assert again.joint_noise == plain.joint_noise
    np.testing.assert_allclose(again.joints, plain.joints, rtol=1e-15)
    assert again.document["joints"]["columns"] == plain.document["joints"]["columns"]
    np.testing.assert_array_equal(again.stations[0].T_camera_base, plain.stations[0].T_camera_base)


OTHERS = {
    "ros": "image_width: 8\nimage_height: 6\ndistortion_model: plumb_bob\n"
    "camera_matrix: {rows: 3, cols: 3, data: [9, 0, 3.5, 0, 9, 2.5, 0, 0, 1]}\n"
    "distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}\n",
    "kalibr": "cam0:\n  camera_model: pinhole\n  distortion_model: none\n"
    "  intrinsics: [9, 9, 3.5, 2.5]\n  resolution: [8, 6]\n",
}


@pytest.mark.parametrize("form", OTHERS)
def test_a_stations_camera_is_read_as_other_programs_write_it(folder, form):
    plain = load_session(folder).stations[0].camera
    (folder / "cameras" / "front.yaml").write_text(OTHERS[form])
    (front,) = load_session(folder).stations
    assert type(front.camera) is type(plain)
    np.testing.assert_array_equal(front.camera.parameters, plain.parameters)


def test_one_of_several_cameras_is_named_behind_its_file(folder):
    two = OTHERS["kalibr"] + OTHERS["kalibr"].replace("cam0", "cam1").replace("[9, 9", "[10, 10")
    (folder / "cameras" / "front.yaml").write_text(two)
    with raises(InputError, code="camera.several", found="cam0 and cam1") as caught:
        load_session(folder)
    assert "cameras/front.yaml#cam1" in caught.value.next_step
    replaced(folder / "session.yaml", "front.yaml", "front.yaml#cam1")
    (front,) = load_session(folder).stations
    assert front.camera.parameters[0] == 10
    assert front.camera_file == "cameras/front.yaml#cam1"
    replaced(folder / "session.yaml", "front.yaml#cam1", "front.yaml#cam7")
    with raises(InputError, found="cam7", expected="cam0 and cam1"):
        load_session(folder)


def test_a_session(folder):
    session = load_session(folder)
    assert session.configurations == ("0000", "0001", "0002")
    assert session.joints.shape == (3, 6)
    assert session.joints[1, 5] == 0.40
    assert session.joint_noise == 3e-6
    assert session.machine.n_joints == 6
    assert session.warnings == ()
    assert session.board is None
    (front,) = session.stations
    assert (front.name, front.observe, front.camera_file) == (
        "front",
        ("legs",),
        "cameras/front.yaml",
    )
    assert front.camera.image_size == (8, 6)
    assert [photo.configuration for photo in front.images] == [0, 1, 2]
    assert front.images[2].path == folder / "images/front/0002.png"
    assert front.T_camera_base @ [0, 0, 0.2, 1] == pytest.approx([0, 0, 1, 1])


def test_the_file_itself_may_be_named(folder):
    assert load_session(folder / "session.yaml").folder == folder
    assert load_session(str(folder)).folder == folder


def test_the_digest_is_of_what_a_result_depends_on(folder):
    def digest():
        session = load_session(folder)
        return session_digest(session, digests(session))

    first = digest()
    with (folder / "session.yaml").open("a") as file:
        file.write("# a comment\nnotes: |\n  Machine 2.\n  Leg 4 exchanged.\n")
    assert load_session(folder).document["notes"] == "Machine 2.\nLeg 4 exchanged.\n"
    assert digest() == first
    replaced(folder / "joints.csv", "0.46,", "0.459,")
    second = digest()
    replaced(folder / "cameras/front.yaml", "9.0, 9.0", "9.0, 9.1")
    third = digest()
    assert cv2.imwrite(str(folder / "images/front/0001.png"), np.full((6, 8), 129, np.uint8))
    assert len({first, second, third, digest()}) == 4


def test_the_resolved_document_is_plain_and_complete(folder):
    document = json.loads(json.dumps(load_session(folder).document))
    assert document["stations"]["front"]["photographs"][0] == "images/front/0000.png"
    assert document["stations"]["front"]["pose"]["up"] == [0, 0, 1]
    assert document["joints"]["readings"]["0002"][0] == 0.40
    assert document["board"] is None


def test_rows_and_images_pair_by_name(folder):
    header, *rows = JOINTS.splitlines(keepends=True)
    (folder / "joints.csv").write_text(header + "".join(reversed(rows)))
    session = load_session(folder)
    for photo in session.stations[0].images:
        assert session.configurations[photo.configuration] == photo.path.stem


def test_a_configuration_without_image_is_a_warning(folder):
    (folder / "images/front/0001.png").unlink()
    (warning,) = load_session(folder).warnings
    assert warning.startswith("joints.csv: no station has an image of configuration 0001 (1 of")


def test_two_stations_need_not_image_the_same(folder):
    image(folder / "images/left/0001.png")
    (folder / "images/front/0001.png").unlink()
    remainder = SESSION[SESSION.index("  front:") : SESSION.index("    pose:")]
    with (folder / "session.yaml").open("a") as stream:
        stream.write(
            remainder.replace("  front:", "  left:").replace("images/front", "images/left")
        )
    session = load_session(folder)
    assert session.warnings == ()
    assert [len(station.images) for station in session.stations] == [2, 1]
    assert session.stations[1].T_camera_base is None


def test_repeats_and_absolute_patterns(folder):
    for path in (folder / "images/front").iterdir():
        path.unlink()
    for name in ("0000_1", "0000_2", "0001_x_1"):
        image(folder / f"elsewhere/{name}.png")
    replaced(folder / "joints.csv", "0001,", "0001_x,")
    pattern = f"{folder}/elsewhere/{{configuration}}_{{repeat}}.png"
    replaced(folder / "session.yaml", "images/front/{configuration}.png", pattern)
    photos = load_session(folder).stations[0].images
    assert [(p.configuration, p.repeat) for p in photos] == [(0, "1"), (0, "2"), (1, "1")]


def test_a_folder_for_each_configuration(folder):
    for name in ("0000", "0001"):
        image(folder / f"shots/{name}/front-{name}.png")
    new = "./shots/{configuration}/front-{configuration}.png"
    replaced(folder / "session.yaml", "images/front/{configuration}.png", new)
    photos = load_session(folder).stations[0].images
    assert [photo.configuration for photo in photos] == [0, 1]


def test_hidden_files_are_no_images(folder):
    (folder / "images/front/._0001.png").write_bytes(b"what some systems leave behind")
    assert len(load_session(folder).stations[0].images) == 3


def test_a_mechanism_file_beside_the_session(folder):
    from pkmcal.mechanisms import catalogue

    (folder / "mechanism.yaml").write_text(catalogue()["gough-stewart"].read_text())
    replaced(folder / "session.yaml", "gough-stewart", "mechanism.yaml")
    assert load_session(folder).machine.n_joints == 6


def test_column_names_are_free(folder):
    replaced(folder / "joints.csv", "leg1,leg2,leg3,leg4,leg5,leg6", "a,b,c,leg1,d,e")
    assert load_session(folder).joints.shape == (3, 6)


def test_a_board(folder):
    (folder / "board.yaml").write_text("type: charuco\n")
    replaced(folder / "session.yaml", "pkmcal: 1", "pkmcal: 1\nboard: board.yaml")
    session = load_session(folder)
    assert session.board == folder / "board.yaml"
    assert session.warnings == ("session.yaml, line 2, board: no station observes the board.",)
    replaced(folder / "session.yaml", "observe: legs", "observe: board")
    session = load_session(folder)
    assert session.warnings == ()
    assert session.board_body == "platform"
    assert session.document["board"] == {"file": "board.yaml", "fixed_to": "platform"}


def test_a_reading_slightly_out_of_range_is_a_warning(folder):
    replaced(folder / "joints.csv", "0.46,0.45", "0.486,0.45")
    (warning,) = load_session(folder).warnings
    assert "line 3, column leg1: the reading 0.486 is slightly outside" in warning


def test_a_joint_that_never_moves_is_a_warning(folder):
    replaced(folder / "joints.csv", "0.41,0.38,0.36", "0.41,0.3800001,0.36")
    replaced(folder / "joints.csv", "0.45,0.44", "0.45,0.38")
    (warning,) = load_session(folder).warnings
    assert warning.startswith("joints.csv: leg3 never moves by more than its noise")


def test_importing_pkmcal_is_light():
    heavy = ["cv2", "scipy", "numpy", "pydantic"]
    code = f"import sys, pkmcal; print([m for m in {heavy} if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


# what is wrong with a file

EDITS = [
    # session.yaml
    ("session.yaml", "pkmcal: 1", "pkmcal: 2",
     {"where": "session.yaml, line 1, pkmcal", "found": "2", "expected": "1"}),
    ("session.yaml", "pkmcal: 1", "pkmcal: true",
     {"where": "session.yaml, line 1, pkmcal", "found": "true", "expected": "1"}),
    ("session.yaml", "pkmcal: 1\n", "",
     {"where": "session.yaml, pkmcal", "expected": "the line pkmcal: 1, the format's version"}),
    ("session.yaml", "camera:", "camrea:",
     {"where": "session.yaml, line 6, stations.front.camrea", "found": "camrea",
      "expected": "camera (known here: camera, handheld, images, observe, pose, poses, "
                  "response, tracker)"}),
    ("session.yaml", "    camera: cameras/front.yaml\n", "",
     {"where": "session.yaml, line 5, stations.front.camera",
      "expected": "the camera's file, for example cameras/front.yaml, or exif"}),
    ("session.yaml", "observe: legs", "observe: leg",
     {"where": "session.yaml, line 8, stations.front.observe", "found": "'leg'",
      "expected": "legs"}),
    ("session.yaml", "3.0e-6", "0",
     {"where": "session.yaml, line 3, joints.noise", "found": "0",
      "expected": "a number of 1e-12 or more"}),
    ("session.yaml", "noise: 3.0e-6", "noise: few",
     {"where": "session.yaml, line 3, joints.noise", "found": "'few'", "expected": "a number"}),
    ("session.yaml", "noise: 3.0e-6", "noise: 3 kg",
     {"where": "session.yaml, line 3, joints.noise", "found": "'3 kg'",
      "expected": "metres or radians, or a number with its unit, such as 0.01 mm"}),
    ("session.yaml", "noise: 3.0e-6", "noise: 3 deg",
     {"where": "session.yaml, line 3, joints.noise", "found": "'3 deg'",
      "expected": "metres, or a number with its unit, such as 269.3 mm"}),
    ("session.yaml", "[0.0, -1.0, 0.2]", "[0.0, -1000, 200]",
     {"where": "session.yaml, line 10, stations.front.pose.position", "found": "1000 m",
      "expected": "metres, at most 50 where no value has a unit"}),
    ("joints.csv", "leg2", "leg2 [deg]",
     {"where": "joints.csv, line 1, column leg2", "found": "an angle, such as deg",
      "expected": "a length, such as mm"}),
    ("session.yaml", ", noise: 3.0e-6", "",
     {"where": "session.yaml, line 3, joints.noise",
      "expected": "the standard deviation of a reading in metres or radians, such as 3.0e-6"}),
    ("session.yaml", "[0.0, -1.0, 0.2]", "[0.0, -1.0]",
     {"where": "session.yaml, line 10, stations.front.pose.position", "found": "[0.0, -1.0]",
      "expected": "the camera's place in the base frame, [x, y, z] in m"}),
    ("session.yaml", SESSION[SESSION.index("stations:"):], "stations: {}\n",
     {"where": "session.yaml, line 4, stations", "found": "6 readings for 6 freedoms",
      "expected": "stations: a camera or a tracker, or a machine with more readings than "
                  "freedoms"}),
    # files that it names
    ("session.yaml", "joints.csv", "joint.csv",
     {"code": "file.missing", "where": "session.yaml, line 3, joints.file", "found": "joint.csv"}),
    ("session.yaml", "cameras/front.yaml", "cameras/back.yaml",
     {"code": "file.missing", "where": "session.yaml, line 6, stations.front.camera",
      "found": "cameras/back.yaml"}),
    ("session.yaml", "cameras/front.yaml", "cameras",
     {"code": "file.irregular", "where": "session.yaml, line 6, stations.front.camera: cameras",
      "expected": "a file"}),
    ("session.yaml", "gough-stewart", "gough-stuart",
     {"code": "machine.unknown", "where": "session.yaml, line 2, mechanism",
      "found": "gough-stuart", "expected": "gough-stewart"}),
    ("session.yaml", "gough-stewart", "mechanism.yaml",
     {"code": "file.missing", "where": "session.yaml, line 2, mechanism",
      "found": "mechanism.yaml"}),
    ("session.yaml", "observe: legs", "observe: board",
     {"where": "session.yaml, line 8, stations.front.observe",
      "expected": "a line board: board.yaml at the top level"}),
    ("session.yaml", "pkmcal: 1", "pkmcal: 1\nboard: board.yaml",
     {"code": "file.missing", "where": "session.yaml, line 2, board", "found": "board.yaml"}),
    ("cameras/front.yaml", "focal: [9.0, 9.0]", "focal: [9.0, -9.0]",
     {"where": "cameras/front.yaml, line 3, focal[2]", "found": "-9.0",
      "expected": "a number above 0"}),
    # pattern of the images
    ("session.yaml", "{configuration}", "0000",
     {"where": "session.yaml, line 7, stations.front.images", "found": "'images/front/0000.png'",
      "expected": "a pattern with {configuration}, such as images/front/{configuration}.png"}),
    ("session.yaml", "{configuration}", "{configration}",
     {"where": "session.yaml, line 7, stations.front.images", "found": "{configration}",
      "expected": "{configuration}"}),
    ("session.yaml", "{configuration}", "{configuration",
     {"where": "session.yaml, line 7, stations.front.images",
      "found": "images/front/{configuration.png"}),
    ("session.yaml", "images/front/{", "images/back/{",
     {"code": "images.none", "where": "session.yaml, line 7, stations.front.images",
      "expected": "files images/back/{configuration}.png"}),
    ("session.yaml", "{configuration}.png", "{configuration}.PNG",
     {"code": "images.none", "where": "session.yaml, line 7, stations.front.images",
      "expected": "files images/front/{configuration}.PNG"}),
    # rough pose
    ("session.yaml", "up: [0, 0, 1]", "up: [0, 1, 0]",
     {"where": "session.yaml, line 9, stations.front.pose",
      "found": "up [0.0, 1.0, 0.0], 0 degrees from the line of sight",
      "expected": "a direction across the view, towards the image's upper edge"}),
    ("session.yaml", "up: [0, 0, 1]", "up: [0, 0, 0]",
     {"where": "session.yaml, line 9, stations.front.pose",
      "found": "up [0.0, 0.0, 0.0], 0 degrees from the line of sight",
      "expected": "a direction across the view, towards the image's upper edge"}),
    ("session.yaml", "look_at: [0.0, 0.0, 0.2]", "look_at: [0.0, -1.0, 0.2]",
     {"where": "session.yaml, line 9, stations.front.pose", "found": "look_at [0.0, -1.0, 0.2]",
      "expected": "a point in the middle of the image, away from position"}),
    # joints.csv
    ("joints.csv", ",leg6", "",
     {"where": "joints.csv, line 2", "found": "7 cells",
      "expected": "6 (configuration, leg1, leg2, leg3, leg4, leg5)"}),
    ("joints.csv", "leg1,leg2", "leg2,leg1",
     {"code": "readings.order", "where": "joints.csv, line 1",
      "found": "leg2 leg1 leg3 leg4 leg5 leg6", "expected": "leg1 leg2 leg3 leg4 leg5 leg6"}),
    ("joints.csv", "0001,", "0000,",
     {"where": "joints.csv, line 3"}),
    ("joints.csv", "0.37", "nan",
     {"where": "joints.csv, line 2, column leg2", "found": "'nan'", "expected": "a number"}),
    ("joints.csv", "0.37", "0.87",
     {"code": "readings.outside_range", "where": "joints.csv, line 2, column leg2",
      "found": "0.87", "expected": "0.345 to 0.485, the range in the mechanism file"}),
    ("joints.csv", "0001,", "1,",
     {"where": "session.yaml, line 7, stations.front.images", "found": "configuration 0001",
      "expected": "one of the table's 3: 0000, 1 and 0002"}),
    ("joints.csv", JOINTS[JOINTS.index("0001"):], "",
     {"code": "configurations.only_one", "where": "joints.csv", "found": "0000",
      "expected": "two at least; one does not distinguish a joint's place from its offset"}),
]  # fmt: skip


@pytest.mark.parametrize(("name", "old", "new", "facts"), EDITS)
def test_a_wrong_line(folder, name, old, new, facts):
    replaced(folder / name, old, new)
    with raises(InputError, **facts):
        load_session(folder)


# what is wrong with the whole


def test_no_such_folder(tmp_path):
    with raises(InputError, code="session.missing", where=str(tmp_path / "none")):
        load_session(tmp_path / "none")


def test_a_folder_without_session(folder):
    inner = folder / "runs" / "monday"
    inner.mkdir(parents=True)
    (folder / "session.yaml").rename(inner / "session.yaml")
    with raises(InputError, code="session.missing", found="sessions in monday below it"):
        load_session(folder / "runs")
    with raises(InputError, code="session.missing", found=None) as caught:
        load_session(folder)
    assert "pkmcal new DIR" in caught.value.next_step


def scaled(factor):
    header, *rows = JOINTS.splitlines()
    for row in rows:
        name, *cells = row.split(",")
        header += f"\n{name}," + ",".join(repr(float(cell) * factor) for cell in cells)
    return header


def test_lengths_in_millimetres(folder):
    (folder / "joints.csv").write_text(scaled(1e3))
    with pytest.raises(InputError) as caught:
        load_session(folder)
    assert caught.value.code == "readings.units"
    assert caught.value.where.endswith("joints.csv, line 2, column leg1")


def test_motors_in_degrees(folder):
    """Only rotary readings can be in degrees; a leg's length of that size is merely out
    of range.
    """
    (folder / "joints.csv").write_text(scaled(180 / np.pi))
    with raises(InputError, code="readings.outside_range", found="20.6265"):
        load_session(folder)
    table = read_csv(folder / "joints.csv", label="joints.csv")
    ranges = np.tile([0.345, 0.485], (len(table.columns), 1))
    with pytest.raises(InputError) as caught:
        check_readings(table, ranges, 1e-5, ["rad"] * len(table.columns))
    assert caught.value.code == "readings.units"
    assert caught.value.where.endswith("line 2, column leg1")


def shifted(by, columns=range(6)):
    header, *rows = JOINTS.splitlines()
    for row in rows:
        name, *cells = row.split(",")
        shifted = [float(x) + by * (k in columns) for k, x in enumerate(cells)]
        header += f"\n{name}," + ",".join(f"{x:.4f}" for x in shifted)
    return header


def test_one_constant_that_explains_all_readings_is_reported(folder):
    """0.345 to 0.485, 7 mm to spare; readings are from 0.35 to 0.46."""
    (folder / "joints.csv").write_text(shifted(-0.34))
    where = "joints.csv, line 2, column leg1"
    with raises(InputError, code="readings.zero", where=where, found="0.02") as caught:
        load_session(folder)
    assert "leg1, leg2, leg3, leg4, leg5 and leg6" in caught.value.what
    assert caught.value.expected.startswith("0.345 to 0.485, ")
    assert "between +328 and +372 mm" in caught.value.expected


def test_one_constant_of_one_joint_is_reported(folder):
    (folder / "joints.csv").write_text(shifted(0.2, [2]))
    with raises(InputError, code="readings.zero") as caught:
        load_session(folder)
    assert caught.value.where.endswith("column leg3")
    assert f"between {MINUS_SIGN}242 and {MINUS_SIGN}148 mm" in caught.value.expected


def test_two_joints_with_two_constants_are_out_of_range(folder):
    (folder / "joints.csv").write_text(shifted(0.2, [2]))
    header, *rows = (folder / "joints.csv").read_text().splitlines()
    cells = [row.split(",") for row in rows]
    other = "\n".join(",".join([*c[:4], f"{float(c[4]) - 0.2:.4f}", *c[5:]]) for c in cells)
    (folder / "joints.csv").write_text(f"{header}\n{other}\n")
    with raises(InputError, code="readings.outside_range", found="0.58"):
        load_session(folder)


def test_one_reading_in_millimetres_is_a_mistake_of_its_own(folder):
    replaced(folder / "joints.csv", "0.37", "370")
    where = "joints.csv, line 2, column leg2"
    with raises(InputError, code="readings.outside_range", where=where, found="370"):
        load_session(folder)


def test_more_readings_out_of_range_are_counted(folder):
    replaced(folder / "joints.csv", "0.36,0.37", "0.96,0.97")
    with raises(InputError, code="readings.outside_range", found="0.96") as caught:
        load_session(folder)
    assert "one of 2 such readings" in caught.value.next_step


def test_all_configurations_alike(folder):
    header, row, *_ = JOINTS.splitlines()
    rows = [row, row.replace("0000", "0001").replace("0.36", "0.360001"), row.replace("0000", "2")]
    (folder / "joints.csv").write_text("\n".join([header, *rows]))
    with raises(InputError, code="readings.unmoved", where="joints.csv") as caught:
        load_session(folder)
    assert caught.value.expected.endswith("joints.noise, 3e-06")


def test_only_one_configuration_imaged(folder):
    for name in ("0001", "0002"):
        (folder / f"images/front/{name}.png").unlink()
    with raises(InputError, code="configurations.only_one", found="0000"):
        load_session(folder)


def test_an_image_without_readings(folder):
    image(folder / "images/front/0003.png")
    image(folder / "images/front/0004.png")
    expected = "one of the table's 3: 0000, 0001 and 0002"
    with raises(InputError, found="configuration 0003", expected=expected) as caught:
        load_session(folder)
    assert "images/front/0003.png" in caught.value.what
    assert "one of 2 such files" in caught.value.what


def test_an_image_of_another_size(folder):
    image(folder / "images/front/0001.png", 16, 12)
    expected = "8x6 (cameras/front.yaml)"
    where = "images/front/0001.png"
    with raises(InputError, where=where, found="16x12", expected=expected) as caught:
        load_session(folder)
    assert "unscaled" in caught.value.next_step


def test_a_file_that_is_no_image(folder):
    (folder / "images/front/0001.png").write_bytes(b"")
    with raises(InputError, code="image.empty", where="images/front/0001.png"):
        load_session(folder)


def test_one_stations_images_under_two_names(folder):
    station = SESSION[SESSION.index("  front:") :]
    with (folder / "session.yaml").open("a") as stream:
        stream.write(station.replace("  front:", "  left:"))
    with raises(InputError, code="station.same_images", found="0000.png") as caught:
        load_session(folder)
    assert caught.value.where.endswith("stations.left.images")


def test_images_of_another_ending_are_reported(folder):
    for path in (folder / "images" / "front").iterdir():
        path.rename(path.with_suffix(".JPG"))
    with raises(InputError, expected="files images/front/{configuration}.png") as caught:
        load_session(folder)
    assert "images/front/{configuration}.JPG" in caught.value.next_step
