"""Sessions whose stations observe a board: valid ones, and messages for the others."""

from __future__ import annotations

import json

import pytest

from faults import fault, raises, replaced
from pkmcal.errors import InputError
from pkmcal.session.load import load_session
from test_session import folder, image

__all__ = ["folder"]


@pytest.fixture
def joined(folder):
    """The session with a second station, both observing legs and a board on the base."""
    (folder / "board.yaml").write_text("type: charuco\n")
    for name in ("0000", "0001", "0002"):
        image(folder / f"images/left/{name}.png")
    board = "pkmcal: 1\nboard: {file: board.yaml, fixed_to: base}"
    replaced(folder / "session.yaml", "pkmcal: 1", board)
    replaced(folder / "session.yaml", "observe: legs", "observe: [legs, board]")
    remainder = "  left: {camera: cameras/front.yaml, images: 'images/left/{configuration}.png', "
    with (folder / "session.yaml").open("a") as stream:
        stream.write(remainder + "observe: [board, legs]}\n")
    return folder


def test_legs_and_board_in_the_same_images(joined):
    session = load_session(joined)
    assert session.warnings == ()
    assert (session.board, session.board_body) == (joined / "board.yaml", "base")
    assert [station.observe for station in session.stations] == [("legs", "board")] * 2
    document = json.loads(json.dumps(session.document))
    assert document["stations"]["left"]["observe"] == ["legs", "board"]


def test_a_board_on_the_base_joins_two(joined):
    replaced(joined / "session.yaml", "observe: [board, legs]", "observe: legs")
    assert load_session(joined).warnings == (
        "session.yaml, line 2, board: only station front observes the board on the base;"
        " it takes two for a board to join them.",
    )


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("observe: [legs, board]", "observe: []",
         ["line 9, stations.front.observe: the list is empty", "legs, board, or [legs, board]"]),
        ("observe: [legs, board]", "observe: [legs, legs]",
         ["the same word stands twice; found ['legs', 'legs']"]),
        ("observe: [legs, board]", "observe: [legs, bord]",
         ["no station can observe this; found 'bord', expected board"]),
        ("observe: [legs, board]", "observe: 7", ["found 7, expected legs, board, or [legs"]),
        ("observe: [legs, board]", "observe: {legs: board}", ["no station can observe this"]),
        ("observe: [board, legs]", "observe: board",
         ["stations.left.observe: the board is fixed to the base, which does not move, and station"
          " left observes no legs; found board, expected [legs, board], in the same images",
          "write board: {file: board.yaml, fixed_to: platform}"]),
        ("fixed_to: base", "fixed_to: table",
         ["line 2, board.fixed_to", "found 'table', expected 'base' or 'platform'"]),
        ("fixed_to: base", "fixd_to: base",
         ["line 2, board.fixd_to: this key is not known", "expected fixed_to"]),
        ("file: board.yaml", "file: bord.yaml",
         ["line 2, board.file: there is no such file; found bord.yaml", "(there is board.yaml)"]),
        ("{file: board.yaml, fixed_to: base}", "{fixed_to: base}",
         ["board.file: this is missing", "for example board.yaml"]),
        ("{file: board.yaml, fixed_to: base}", "[board.yaml]",
         ["line 2, board", "keys and values"]),
    ],
)  # fmt: skip
def test_a_wrong_board(joined, old, new, parts):
    replaced(joined / "session.yaml", old, new)
    message = fault(load_session, joined)
    for part in parts:
        assert part in message


def test_a_board_on_the_base_and_no_legs(joined):
    replaced(joined / "session.yaml", "observe: [legs, board]", "observe: board")
    replaced(joined / "session.yaml", "observe: [board, legs]", "observe: board")
    with raises(InputError, found="board", expected="[legs, board], in the same images"):
        load_session(joined)
