"""Boards on paper: the PDF has the board's points at their places, in true size."""

from __future__ import annotations

import re
import zlib

import cv2
import numpy as np
import pytest

from conftest import run
from faults import raises
from pkmcal.boards.detect import detect_boards
from pkmcal.boards.prints import PAPER_SIZES, board_digest, sheet_pdf
from pkmcal.errors import InputError
from pkmcal.simulation.board import board_from_fields

POINT = 25.4 / 72
"""mm."""
DPI = 150
BOARDS = {
    "charuco": {"type": "charuco", "squares": [9, 7], "square": 0.03, "marker": 0.022,
                "dictionary": "DICT_5X5_100"},
    "chessboard": {"type": "chessboard", "corners": [7, 6], "square": 0.02},
    "aruco_grid": {"type": "aruco_grid", "markers": [4, 5], "marker": 0.03, "gap": 0.008,
                   "dictionary": "DICT_4X4_50"},
    "aprilgrid": {"type": "aruco_grid", "markers": [4, 5], "marker": 0.03, "gap": 0.009,
                  "dictionary": "DICT_APRILTAG_36h11", "border": 2, "leftward": True},
    "circles": {"type": "circle_grid", "circles": [6, 7], "spacing": 0.025},
    "asymmetric": {"type": "circle_grid", "circles": [4, 9], "spacing": 0.02, "asymmetric": True},
}  # fmt: skip


def content_of(pdf):
    """Size of the page in mm, and its nominal model commands."""
    size = np.array(re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", pdf).groups(), dtype=float)
    stream = re.search(rb"stream\n(.*?)\nendstream", pdf, re.DOTALL)[1]
    return size * POINT, zlib.decompress(stream).decode("latin-1")


def rectangles(text):
    """(n, 4) x0, y0, x1, y1 in mm from the page's lower left corner."""
    values = re.findall(r"([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re", text)
    values = values or [[0.0] * 4]
    x, y, w, h = np.array(values, dtype=float).T * POINT
    return np.stack([x, y, x + w, y + h], axis=-1)


def discs(text):
    """(n, 3) middle and radius in mm, of circles of four curves from their rightmost point on."""
    paths = re.findall(r"^([\d.]+ [\d.]+) m ((?:[\d. ]+ c ){4})h$", text, re.MULTILINE)
    out = []
    for start, curves in paths:
        ends = [curve.split()[-2:] for curve in curves.split("c")[:4]]
        points = np.array([start.split(), *ends], dtype=float) * POINT
        assert np.allclose(points[0], points[4], atol=1e-3)
        middle = points[:4].mean(axis=0)
        radii = np.linalg.norm(points - middle, axis=1)
        assert np.allclose(radii, radii[0], atol=1e-3)
        out.append([*middle, radii[0]])
    return np.array(out).reshape(-1, 3)


def rasterised(size, boxes, circles):
    """The page as a printer of DPI dots an inch sees it, top row first; partly black by area."""
    scale = 4
    dots = np.round(size / 25.4 * DPI).astype(int) * scale
    fine = np.full((dots[1], dots[0]), 255, np.uint8)
    at = np.round(boxes / 25.4 * DPI * scale).astype(int)
    for x0, y0, x1, y1 in at:
        fine[dots[1] - y1 : dots[1] - y0, x0:x1] = 0
    for x0, y0, radius in circles / 25.4 * DPI * scale:
        low = int(x0 - radius), int(dots[1] - y0 - radius)
        part = fine[low[1] :, low[0] :][: int(2 * radius) + 2, : int(2 * radius) + 2]
        y, x = np.mgrid[: part.shape[0], : part.shape[1]] + 0.5
        part[np.hypot(x + low[0] - x0, y + low[1] - (dots[1] - y0)) < radius] = 0
    rows, columns = dots[1] // scale, dots[0] // scale
    return fine.reshape(rows, scale, columns, scale).mean(axis=(1, 3)).astype(np.uint8)


@pytest.mark.parametrize("kind", BOARDS)
def test_the_printed_board_is_found_with_its_points_in_true_size(kind, tmp_path):
    board = board_from_fields(BOARDS[kind])
    pdf, _ = sheet_pdf(board)
    size, text = content_of(pdf)
    image = rasterised(size, rectangles(text), discs(text))
    cv2.imwrite(str(tmp_path / "page.png"), cv2.GaussianBlur(image, (0, 0), 1.0))
    (visible,) = detect_boards([tmp_path / "page.png"], board)
    assert visible.success, visible.reason
    assert len(visible.ids) == len(board.points)
    mm = visible.pixels * 25.4 / DPI
    points = board.points[visible.ids, :2] * 1e3
    # turned by nothing, enlarged by nothing
    turn, *_ = np.linalg.lstsq(np.c_[points, np.ones(len(points))], mm, rcond=None)
    np.testing.assert_allclose(turn[:2], np.eye(2), atol=2e-4)


@pytest.mark.parametrize("paper", [None, *PAPER_SIZES])
def test_everything_is_on_the_paper_and_the_rulers_are_as_long_as_they_say(paper):
    board = board_from_fields(BOARDS["chessboard"])
    pdf, name = sheet_pdf(board, paper)
    size, text = content_of(pdf)
    assert name == (paper or "a4")
    np.testing.assert_allclose(sorted(size), sorted(np.array(PAPER_SIZES[name]) * 1e3), atol=0.01)
    drawn = re.findall(r"([\d.-]+) ([\d.-]+) m ([\d.-]+) ([\d.-]+) l", text)
    lines = np.array(drawn, dtype=float).reshape(-1, 2, 2) * POINT
    boxes = rectangles(text)
    for points in (lines.reshape(-1, 2), boxes.reshape(-1, 2)):
        assert np.all(points > 5)
        assert np.all(points < size - 5)
    lengths = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=-1)
    words = float(re.search(r"both rulers are (\d+)", text)[1])
    assert sorted(lengths)[-2:] == pytest.approx([words, words], abs=0.01)
    # all letters are on the page too, and large enough
    for points, x, y, pitch, rows in re.findall(
        r"/F (\d+) Tf ([\d.]+) ([\d.]+) Td (\d+) TL (.*?) ET", text
    ):
        written = re.findall(r"\((.*?)\) Tj", rows)
        assert float(points) >= 8
        assert (float(y) - (len(written) - 1) * float(pitch)) * POINT > 5
        widest = max(map(len, written)) * 0.5 * float(points)
        assert (float(x) + widest) * POINT < size[0] - 5
    # neither touches the board
    low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
    inside = (lines > low - 2).all(axis=-1) & (lines < high + 2).all(axis=-1)
    assert not inside.any()


def test_rulers_have_numbers_and_axes_begin_at_the_origin():
    board = board_from_fields(BOARDS["chessboard"])
    text = content_of(sheet_pdf(board, file="mine.yaml")[0])[1]
    letters = re.findall(r"/F \d+ Tf ([\d.]+) ([\d.]+) Td \d+ TL \((.*?)\) Tj T\* ET", text)
    place = {}
    for x, y, words in letters:
        place.setdefault(words, []).append((float(x) * POINT, float(y) * POINT))
    assert {*place} >= {"0", "20", "40", "60", "80", "100", "x", "y"}
    # 20 mm apart, on both rulers
    along = [place[str(mm)][0][0] for mm in (20, 40, 60, 80)]
    up = [place[str(mm)][1][1] for mm in (20, 40, 60, 80)]
    np.testing.assert_allclose(np.diff(along), 20, atol=0.01)
    np.testing.assert_allclose(np.diff(up), 20, atol=0.01)
    # the first inner corner is a square inside the pattern
    boxes = rectangles(text)
    left, top = boxes[:, 0].min(), boxes[:, 3].max()
    drawn = re.findall(r"([\d.-]+) ([\d.-]+) m ([\d.-]+) ([\d.-]+) l", text)
    lines = np.array(drawn, dtype=float).reshape(-1, 2, 2) * POINT
    shafts = lines[np.isclose(np.linalg.norm(lines[:, 1] - lines[:, 0], axis=-1), 12)]
    (x_axis,) = shafts[np.isclose(shafts[:, 0, 1], shafts[:, 1, 1])]
    (y_axis,) = shafts[np.isclose(shafts[:, 0, 0], shafts[:, 1, 0])]
    assert x_axis[0, 0] == pytest.approx(left + 20, abs=0.01)
    assert x_axis[1, 0] > x_axis[0, 0]
    assert y_axis[0, 1] == pytest.approx(top - 20, abs=0.01)
    assert y_axis[1, 1] < y_axis[0, 1]


def test_prints_of_two_boards_have_other_digests():
    small, large = (
        board_from_fields(BOARDS["chessboard"] | {"square": side}) for side in (0.02, 0.0201)
    )
    digests = {board_digest(one) for one in (small, large, small)}
    assert len(digests) == 2
    text = content_of(sheet_pdf(small, file="mine.yaml")[0])[1]
    assert f"(mine.yaml, digest {board_digest(small)}" in text


def test_the_file_is_a_pdf_whose_table_leads_to_its_objects():
    pdf, _ = sheet_pdf(board_from_fields(BOARDS["charuco"]))
    start = int(re.search(rb"startxref\n(\d+)\n%%EOF\n$", pdf)[1])
    assert pdf[start:].startswith(b"xref\n0 7\n")
    places = [int(place) for place in re.findall(rb"(\d{10}) 00000 n ", pdf[start:])]
    for number, place in enumerate(places, 1):
        assert pdf[place:].startswith(f"{number} 0 obj\n".encode())
    assert b"/PrintScaling /None" in pdf


def test_papers_too_small_and_papers_unknown():
    board = board_from_fields(BOARDS["charuco"])
    with raises(InputError, where="--paper", expected="at most a4") as caught:
        sheet_pdf(board, "a4")
    assert caught.value.found.startswith("270 x 210 mm")
    with raises(InputError, where="--paper", found="a5"):
        sheet_pdf(board, "a5")
    huge = board_from_fields(BOARDS["charuco"] | {"square": 0.3, "marker": 0.2})
    with raises(InputError, where=None, expected="at most a0"):
        sheet_pdf(huge)


def test_the_command(tmp_path):
    run("new", tmp_path / "mine", "--board")
    done = run("board", tmp_path / "mine")
    assert done.code == 0
    assert "paper of size a4" in done.out
    assert f"{tmp_path / 'mine' / 'board.pdf'}  the page to print" in done.out
    assert (tmp_path / "mine" / "board.pdf").read_bytes().startswith(b"%PDF-1.7\n")
    again = run("board", tmp_path / "mine" / "board.yaml", "--paper", "a2", "--json").json
    assert again["paper"] == "a2"
    (tmp_path / "my.pdf").write_bytes(b"%PDF my own")
    refused = run("board", tmp_path / "mine", "-o", tmp_path / "my.pdf")
    assert refused.code == 2
    assert str(tmp_path / "my.pdf") in refused.err
    assert (tmp_path / "my.pdf").read_bytes() == b"%PDF my own"
    assert "no.yaml: the file does not exist" in run("board", tmp_path / "no.yaml").err
