"""The recipes of docs/howto.md for delta printers, typed as they stand, on a simulated printer."""

from __future__ import annotations

import json
import re

import cv2
import numpy as np
import pytest

import printers
from conftest import run
from kit_sessions import CAMERA
from pkmcal.boards.board import load_board
from pkmcal.boards.prints import Print
from pkmcal.cameras import load_camera
from pkmcal.files import csv_text, yaml_text
from pkmcal.geometry.rigid import apply, inverse, look_at, pose, rotation
from test_docs import blocks, text_of


def recipe(heading: str) -> list[tuple[str, str]]:
    """Commands of a recipe in their order, each with its output on the page."""
    text = text_of("docs/howto.md").partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    display = [part for block in blocks(text, "console") for part in block.split("$ ")[1:]]
    return [(part.partition("\n")[0], part.partition("\n")[2]) for part in display]


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
    """Every command prints what the page shows, figures aside."""
    commands = recipe("A delta printer with its probe")
    assert [command.split()[1] for command, _ in commands] == ["new", "calibrate", "export"]
    for command, display in commands:
        done = typed(command)
        assert done.code == 0, done.out + done.err
        assert form(done.out, workplace) == form(display), command
    text = text_of("docs/howto.md").partition("## A delta printer with its probe")[2]
    values = (workplace / "kit" / "export-klipper" / "pkmcal_printer.cfg").read_text()
    assert form(blocks(text, "ini")[0]) == form(re.sub(r"^#.*\n", "", values, flags=re.MULTILINE))


def image(board, camera, T_camera_board, rng):
    """The board's print before a pinhole camera (h, w), grey: nine rays a pixel, blur and noise."""
    printed, fine, rays = Print.of(board), board.document["square"] / 96, 3
    margin = 0.5 * board.document["square"]
    x, y = (np.arange(s[0] - margin, s[-1] + margin, fine) for s in (printed.x, printed.y))
    black = printed.dark_at(*np.meshgrid(x, y))
    fx, fy, cx, cy = camera.parameters[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    on_print = np.array([[fine, 0, x[0]], [0, fine, y[0]], [0, 0, 1]])
    by_rays = np.array([[rays, 0, (rays - 1) / 2], [0, rays, (rays - 1) / 2], [0, 0, 1]])
    H = by_rays @ K @ T_camera_board[:3][:, [0, 1, 3]] @ on_print
    width, height = camera.image_size
    in_view = cv2.warpPerspective(np.where(black, 25, 225).astype(np.uint8), H,
                               (rays * width, rays * height), borderValue=110)  # fmt: skip
    in_view = cv2.resize(in_view, (width, height), interpolation=cv2.INTER_AREA)
    in_view = cv2.GaussianBlur(in_view.astype(float), (0, 0), 0.7) + rng.normal(
        0, 1.5, in_view.shape
    )
    return np.clip(in_view.round(), 0, 255).astype(np.uint8)


def imaged(kit):
    """A user's part of the recipe: the camera's file, 25 images, and readings as Klipper prints
    them.
    """
    rng = np.random.default_rng(1)
    (kit / "cameras" / "front.yaml").write_text(yaml_text(CAMERA))
    camera, board = load_camera(kit / "cameras" / "front.yaml"), load_board(kit / "board.yaml")
    true = printers.machine(printers.BUILT)
    r, a = 0.08 * np.sqrt(rng.uniform(size=25)), rng.uniform(0, 2 * np.pi, 25)
    middle = np.array([0.0, 0.0, 0.1])
    T = pose(np.eye(3), np.stack([r * np.cos(a), r * np.sin(a), rng.uniform(0.02, 0.18, 25)], 1))
    T_camera_base = look_at(middle + np.array([0.2, -0.25, 0.22]), middle, np.array([0, 0, 1.0]))
    # tilted from the line of sight: seen from straight ahead, a board hardly determines its tilt
    facing = inverse(T_camera_base)[:3, :3] @ rotation(np.array([0.4, -0.35, 0.1]))
    T_platform_board = pose(facing, [0.0, 0.0, 0.02] - facing @ board.points.mean(axis=0))
    T_camera_board = T_camera_base @ T @ T_platform_board
    assert camera.in_image(camera.project(apply(T_camera_board[:, None], board.points)), 5.0).all()
    names = [f"{k + 1:02d}" for k in range(25)]
    readings = (1e3 * true.inverse(T)).round(3)
    heads = [f"leg{k} [mm]" for k in (1, 2, 3)]
    (kit / "joints.csv").write_text(csv_text(heads, names, readings))
    for name, T_camera in zip(names, T_camera_board, strict=True):
        picture = image(board, camera, T_camera, rng)
        assert cv2.imwrite(str(kit / "images" / "front" / f"{name}.png"), picture)


def test_a_delta_kit_with_a_board(workplace):
    new, board, calibrate, export = recipe("A delta kit with a board")
    for command, display in (new, board):
        done = typed(command)
        assert done.code == 0, done.out + done.err
        assert form(done.out, workplace) == form(display), command
    kit = workplace / "kit"
    assert (kit / "board.pdf").read_bytes().startswith(b"%PDF")
    imaged(kit)
    for command, display in (calibrate, export):
        done = typed(command)
        assert done.code == 0, done.out + done.err
        first = form(display).partition(" #")[0]
        assert form(done.out, workplace).startswith(first), command
    text = (kit / "calibration" / "calibration.json").read_text()
    # the readings are rounded, and exact beside that; 0.004 mm is a step's deviation
    most = json.loads(text)["statistics"]["reading_range"][1]
    assert most is None or most * 0.004 > 0.001 / np.sqrt(12)
    values = (kit / "export-klipper" / "pkmcal_printer.cfg").read_text()
    radius = re.search(r"delta_radius: ([\d.]+)", values)
    assert radius
    # the board's size is known to 0.1 %, so two deviations are 0.2 mm
    assert float(radius[1]) == pytest.approx(printers.BUILT.radius, abs=0.2)


@pytest.mark.parametrize(
    ("rod", "radius", "endstop"),
    [(218.0, 97.3, 300.0), (270.0, 105.4, 400.0), (300.0, 146.0, 400.0), (397.0, 200.0, 540.0)],
)
def test_a_printers_nominal_model_is_what_its_firmware_holds(
    tmp_path, monkeypatch, rod, radius, endstop
):
    """Exported as it was read it comes back, also where home is above the lowest carriage, which
    is below the tool there.
    """
    monkeypatch.chdir(tmp_path)
    settings = printers.Settings(radius=radius, rod=(rod,) * 3, endstop=(endstop,) * 3)
    (tmp_path / "printer.cfg").write_text(printers.printer_cfg(settings))
    done = [
        typed(f"pkmcal {words}")
        for words in (
            "new kit --printer printer.cfg --board",
            "export kit/mechanism.yaml --to klipper",
        )
    ]
    assert [d.code for d in done] == [0, 0], done[-1].out + done[-1].err
    (values,) = tmp_path.rglob("pkmcal_printer.cfg")
    for name, value in (
        ("delta_radius", radius),
        ("arm_length", rod),
        ("position_endstop", endstop),
    ):
        count = re.findall(rf"^{name}: ([\d.]+)", values.read_text(), re.MULTILINE)
        assert [float(v) for v in count] == pytest.approx([value] * len(count), abs=2e-4)
        assert count
