"""A person's YAML changed in one place, and nothing else of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from faults import raises
from pkmcal.errors import InputError
from pkmcal.files import parse_yaml, with_numbers

KEYS = ("stations", "front", "pose")
POSE = {"position": [0.25, -1.5, 0.125], "look_at": [0.0, 0.5, 0.2], "up": [0.1, 0.0, 0.9]}
HEAD = "# mine\npkmcal: 1   # the version\nstations:\n"
BLOCK = """\
  front:   # the good camera
    camera: cameras/front.yaml
    pose:            # measured on a Monday
      position: [0.0,   -1.0, 0.2]    # with a tape
      # to the middle
      look_at:
        - 0.0   # x
        - 0.0
        - 2.0e-1
      up: [0, 0, 1]

    # and what it sees
    observe: legs
  rear: {camera: a.yaml}
# the end
"""


def written(text: str) -> dict:
    return parse_yaml(with_numbers(text, "session.yaml", KEYS, POSE), Path("s")).data


def test_only_the_numbers_change():
    done = with_numbers(HEAD + BLOCK, "session.yaml", KEYS, POSE)
    expected = (HEAD + BLOCK).replace("[0.0,   -1.0, 0.2]", "[0.25,   -1.5, 0.125]")
    expected = expected.replace("- 0.0\n        - 2.0e-1", "- 0.5\n        - 0.2")
    assert done == expected.replace("[0, 0, 1]", "[0.1, 0.0, 0.9]")


@pytest.mark.parametrize(
    ("station", "after"),
    [
        ("  hand:\n    observe: legs\n  rear: {}\n",
         "  hand:\n    observe: legs\n    poses:\n      0003-2: {position: [0.25, -1.5, 0.125],"
         " look_at: [0.0, 0.5, 0.2], up: [0.1, 0.0, 0.9]}\n  rear: {}\n"),
        ("  hand: {observe: legs, poses: {0004: {position: [1, 2, 3]}}}\n",
         "  hand: {observe: legs, poses: {0004: {position: [1, 2, 3]}, 0003-2: {position:"
         " [0.25, -1.5, 0.125], look_at: [0.0, 0.5, 0.2], up: [0.1, 0.0, 0.9]}}}\n"),
    ],
)  # fmt: skip
def test_a_pose_of_one_image_is_added(station, after):
    keys = ("stations", "hand", "poses", "0003-2")
    done = with_numbers(HEAD + station, "session.yaml", keys, POSE, with_parent=True)
    assert done == HEAD + after


@pytest.mark.parametrize(
    ("station", "after"),
    [
        ("  front:\n    observe: legs  # seen\n\n    # last\n",
         "  front:\n    observe: legs  # seen\n    pose:\n      position: [0.25, -1.5, 0.125]\n"
         "      look_at: [0.0, 0.5, 0.2]\n      up: [0.1, 0.0, 0.9]\n\n    # last\n"),
        ("  front: {observe: [legs, board]} # both",
         "  front: {observe: [legs, board], pose: {position: [0.25, -1.5, 0.125],"
         " look_at: [0.0, 0.5, 0.2], up: [0.1, 0.0, 0.9]}} # both"),
        ("  front:\n    pose:   # to come\n    observe: legs",
         "  front:\n    pose: {position: [0.25, -1.5, 0.125], look_at: [0.0, 0.5, 0.2],"
         " up: [0.1, 0.0, 0.9]}   # to come\n    observe: legs"),
        ("  front:\n    pose: ~\n",
         "  front:\n    pose: {position: [0.25, -1.5, 0.125], look_at: [0.0, 0.5, 0.2],"
         " up: [0.1, 0.0, 0.9]}\n"),
        ("  front:\n    pose:\n      look_at: [1, 2, 3]\n      position: [1, 2, 3] # here",
         "  front:\n    pose:\n      look_at: [0.0, 0.5, 0.2]\n"
         "      position: [0.25, -1.5, 0.125] # here\n      up: [0.1, 0.0, 0.9]"),
        ("  front:\n    pose: {position: [1, 2, 3], look_at: [1, 2, 4]}\n",
         "  front:\n    pose: {position: [0.25, -1.5, 0.125], look_at: [0.0, 0.5, 0.2],"
         " up: [0.1, 0.0, 0.9]}\n"),
        ("  front:\n    note: |\n      two\n      lines\n  rear: 1\n",
         "  front:\n    note: |\n      two\n      lines\n    pose:\n"
         "      position: [0.25, -1.5, 0.125]\n      look_at: [0.0, 0.5, 0.2]\n"
         "      up: [0.1, 0.0, 0.9]\n  rear: 1\n"),
        ("  rear: &rear {pose: {position: [1, 2, 3], look_at: [1, 2, 4]}}\n"
         "  front:\n    camera: &c x\n    <<: *rear\n",
         "  rear: &rear {pose: {position: [1, 2, 3], look_at: [1, 2, 4]}}\n"
         "  front:\n    camera: &c x\n    <<: *rear\n    pose:\n"
         "      position: [0.25, -1.5, 0.125]\n      look_at: [0.0, 0.5, 0.2]\n"
         "      up: [0.1, 0.0, 0.9]\n"),
    ],
)  # fmt: skip
def test_what_is_absent_is_added(station, after):
    assert with_numbers(HEAD + station, "session.yaml", KEYS, POSE) == HEAD + after


def test_line_ends_and_a_byte_order_mark_stay():
    text = "\ufeff" + (HEAD + "  front:\n    observe: legs\n").replace("\n", "\r\n")
    done = with_numbers(text, "session.yaml", KEYS, POSE)
    assert done.startswith(text)
    assert done.count("\n") == done.count("\r\n") == text.count("\n") + 4
    assert written(text)["stations"]["front"]["pose"] == POSE


@pytest.mark.parametrize(
    "stations",
    [
        "  front: {pose: &p {position: [1, 2, 3], look_at: [1, 2, 4]}}\n  rear: {pose: *p}\n",
        "  front: &f {pose: {position: [1, 2, 3], look_at: [1, 2, 4]}}\n  rear: {<<: *f}\n",
        "  front:\n    pose: {position: &v [1, 2, 3], look_at: [1, 2, 4]}\n  rear: {x: *v}\n",
        "  front: {pose: {position: [1, 2], look_at: [1, 2, 4]}}\n",
        "  front: {pose: {position: 1}}\n",
        "  rear: {}\n",
        "  front: [legs]\n",
    ],
)
def test_what_would_change_something_else_is_refused(stations):
    with raises(InputError, code="file.not_editable") as caught:
        with_numbers(HEAD + stations, "session.yaml", KEYS, POSE)
    assert caught.value.where.startswith("session.yaml, line ")


def test_a_number_with_its_unit_becomes_one_in_metres():
    text = HEAD + "  front:\n    pose: {position: [250 mm, -1.5 m, 0], look_at: [0, 0, 1 m]}\n"
    done = with_numbers(text, "session.yaml", KEYS, POSE)
    assert "{position: [0.25, -1.5, 0.125], look_at: [0.0, 0.5, 0.2], up: [0.1" in done
