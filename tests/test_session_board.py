"""Sessions whose stations observe a board: valid ones, and messages for the others."""

from __future__ import annotations

import json

import pytest

from faults import raises, replaced
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
    ("old", "new", "facts"),
    [
        ("observe: [legs, board]", "observe: []",
         {"where": "session.yaml, line 9, stations.front.observe", "found": "[]",
          "expected": "legs, board, or [legs, board]"}),
        ("observe: [legs, board]", "observe: [legs, legs]",
         {"where": "session.yaml, line 9, stations.front.observe", "found": "['legs', 'legs']",
          "expected": "legs, board, or [legs, board]"}),
        ("observe: [legs, board]", "observe: [legs, bord]",
         {"where": "session.yaml, line 9, stations.front.observe", "found": "'bord'",
          "expected": "board"}),
        ("observe: [legs, board]", "observe: 7",
         {"where": "session.yaml, line 9, stations.front.observe", "found": "7",
          "expected": "legs, board, or [legs, board]"}),
        ("observe: [legs, board]", "observe: {legs: board}",
         {"where": "session.yaml, line 9, stations.front.observe", "found": "{'legs': 'board'}",
          "expected": "legs, board, or [legs, board]"}),
        ("observe: [board, legs]", "observe: board",
         {"where": "session.yaml, line 14, stations.left.observe", "found": "board",
          "expected": "[legs, board], in the same images"}),
        ("fixed_to: base", "fixed_to: table",
         {"where": "session.yaml, line 2, board.fixed_to", "found": "'table'",
          "expected": "'base' or 'platform'"}),
        ("fixed_to: base", "fixd_to: base",
         {"where": "session.yaml, line 2, board.fixd_to", "found": "fixd_to",
          "expected": "fixed_to (known here: file, fixed_to)"}),
        ("file: board.yaml", "file: bord.yaml",
         {"code": "file.missing", "where": "session.yaml, line 2, board.file",
          "found": "bord.yaml"}),
        ("{file: board.yaml, fixed_to: base}", "{fixed_to: base}",
         {"where": "session.yaml, line 2, board.file",
          "expected": "the board's file, for example board.yaml"}),
        ("{file: board.yaml, fixed_to: base}", "[board.yaml]",
         {"where": "session.yaml, line 2, board", "found": "['board.yaml']",
          "expected": "keys and values"}),
    ],
)  # fmt: skip
def test_a_wrong_board(joined, old, new, facts):
    replaced(joined / "session.yaml", old, new)
    with raises(InputError, **facts):
        load_session(joined)


def test_a_board_on_the_base_and_no_legs(joined):
    replaced(joined / "session.yaml", "observe: [legs, board]", "observe: board")
    replaced(joined / "session.yaml", "observe: [board, legs]", "observe: board")
    with raises(InputError, found="board", expected="[legs, board], in the same images"):
        load_session(joined)
