"""The recipes of docs/howto.md for delta printers, typed as they stand, on a simulated printer."""

from __future__ import annotations

import re
from unittest.mock import patch

import cv2
import numpy as np
import pytest

import printers
from conftest import run
from kit_sessions import CAMERA, CORNER
from pkmcal.boards.board import Detection, load_board
from pkmcal.cameras import load_camera
from pkmcal.files import csv_text, yaml_text
from pkmcal.geometry.rigid import apply, inverse, look_at, pose, rotation
from test_docs import blocks, text_of


def recipe(heading: str) -> list[tuple[str, str]]:
    """The commands of a recipe in their order, each with what the page shows of it."""
    text = text_of("docs/howto.md").partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    shown = [part for block in blocks(text, "console") for part in block.split("$ ")[1:]]
    return [(part.partition("\n")[0], part.partition("\n")[2]) for part in shown]


def form(text: str, folder: object = None) -> str:
    """A text without its figures and line ends, which differ by machine and by place."""
    text = re.sub(r"\d+(\.\d+)?(e-?\d+)?", "#", text.replace(f"{folder}/", ""))
    return " ".join(text.split())


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "printer.cfg").write_text(printers.calibrated_cfg())
    (tmp_path / "probed.txt").write_text(printers.console(15))
    return tmp_path.resolve()


def typed(command: str):
    name, *words = command.split()
    assert name == "pkmcal"
    return run(*words)


def test_a_delta_printer_with_its_probe(workplace):
    """Every command says what the page shows, figures aside."""
    commands = recipe("A delta printer with its probe")
    assert [command.split()[1] for command, _ in commands] == ["new", "calibrate", "export"]
    for command, shown in commands:
        done = typed(command)
        assert done.code == 0, done.out + done.err
        assert form(done.out, workplace) == form(shown), command
    text = text_of("docs/howto.md").partition("## A delta printer with its probe")[2]
    values = (workplace / "kit" / "export-klipper" / "pkmcal_printer.cfg").read_text()
    assert form(blocks(text, "ini")[0]) == form(re.sub(r"^#.*\n", "", values, flags=re.MULTILINE))


def photographed(kit):
    """What a person adds where the page says so: the camera's file, 25 photographs, and readings as
    Klipper tells them. Returns what a detector finds in the photographs, which are grey.
    """
    rng = np.random.default_rng(1)
    (kit / "cameras" / "front.yaml").write_text(yaml_text(CAMERA))
    camera, board = load_camera(kit / "cameras" / "front.yaml"), load_board(kit / "board.yaml")
    true = printers.machine(printers.BUILT)
    r, a = 0.08 * np.sqrt(rng.uniform(size=25)), rng.uniform(0, 2 * np.pi, 25)
    middle = np.array([0.0, 0.0, 0.1])
    T = pose(np.eye(3), np.stack([r * np.cos(a), r * np.sin(a), rng.uniform(0.02, 0.18, 25)], 1))
    T_camera_base = look_at(middle + np.array([0.4, -0.5, 0.5]), middle, np.array([0, 0, 1.0]))
    # leaning from the line of sight: seen straight on, a board hardly tells its tilt
    facing = inverse(T_camera_base)[:3, :3] @ rotation(np.array([0.4, -0.35, 0.1]))
    T_platform_board = pose(facing, [0.0, 0.0, 0.02] - facing @ board.points.mean(axis=0))
    pixels = camera.project(apply((T_camera_base @ T @ T_platform_board)[:, None], board.points))
    assert camera.in_image(pixels, margin=5.0).all()
    pixels = pixels + CORNER * rng.normal(size=pixels.shape)
    names = [f"{k + 1:02d}" for k in range(25)]
    readings = (1e3 * true.inverse(T)).round(3)
    heads = [f"leg{k} [mm]" for k in (1, 2, 3)]
    (kit / "joints.csv").write_text(csv_text(heads, names, readings))
    grey = cv2.imencode(".png", np.full((720, 1280), 128, dtype=np.uint8))[1].tobytes()
    for name in names:
        (kit / "images" / "front" / f"{name}.png").write_bytes(grey)
    ids, sigma = np.arange(len(board.points)), np.full(len(board.points), CORNER)
    return tuple(
        Detection(f"{name}.png", camera.image_size, ids, p, sigma)
        for name, p in zip(names, pixels, strict=True)
    )


def test_a_delta_kit_with_a_board(workplace):
    """The photographs are left out: corners as a detector finds them stand in their place."""
    new, board, calibrate, export = recipe("A delta kit with a board")
    for command, shown in (new, board):
        done = typed(command)
        assert done.code == 0, done.out + done.err
        assert form(done.out, workplace) == form(shown), command
    kit = workplace / "kit"
    assert (kit / "board.pdf").read_bytes().startswith(b"%PDF")
    found = photographed(kit)
    with patch("pkmcal.boards.views.detect_in", lambda *_: found):
        for command, shown in (calibrate, export):
            done = typed(command)
            assert done.code == 0, done.out + done.err
            first = form(shown).partition(" #")[0]
            assert form(done.out, workplace).startswith(first), command
    values = (kit / "export-klipper" / "pkmcal_printer.cfg").read_text()
    radius = re.search(r"delta_radius: ([\d.]+)", values)
    assert radius
    # the board's size is known to 0.1 %, so two deviations are 0.2 mm
    assert float(radius[1]) == pytest.approx(printers.BUILT.radius, abs=0.2)
