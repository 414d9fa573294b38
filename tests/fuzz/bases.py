"""Whole sessions and results, small and quick, from which malformed ones are made."""

from __future__ import annotations

import os
from contextlib import suppress
from functools import partial
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np

import printers
from fuzz import pictures
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.camera_calibration.calibrate import CalibrationCheckOptions, calibrate_camera
from pkmcal.camera_calibration.model_selection import ModelSelectionOptions
from pkmcal.cameras import load_camera
from pkmcal.cameras.files import CAMERA_FILE_FORMATS, foreign_text
from pkmcal.commands.cli import main
from pkmcal.errors import InputError
from pkmcal.exporters.contract import exporters
from pkmcal.files import Exif, csv_text, with_exif, yaml_text
from pkmcal.geometry.rigid import look_at, pose, rotation
from pkmcal.mechanisms import catalogue, load_mechanism, mechanism_text
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.planning.plan import PlanOptions, plan_measurements
from pkmcal.simulation import Settings
from rendered import rendered

SIZE = (160, 120)
CAMERA = {"model": "pinhole", "image_size": list(SIZE), "focal": [141.0, 141.2],
          "center": [80.4, 59.5], "distortion": [-0.11, 0.09, 0.0004, -0.0003, 0.0]}  # fmt: skip
MIRROR = {"model": "unified", "image_size": list(SIZE), "focal": [90.0, 90.0],
          "center": [79.5, 59.5], "xi": 0.9, "distortion": [0.01, 0.0, 0.0, 0.0]}  # fmt: skip
FISHEYE = {"model": "fisheye", "image_size": list(SIZE), "focal": [60.0, 60.0],
           "center": [79.5, 59.5], "distortion": [0.01, 0.0, 0.0, 0.0]}  # fmt: skip
RATIONAL = {**CAMERA, "model": "rational", "distortion": [0.5, 0.1, 1e-3, -2e-3, 0.01, 0.7, 0.15]}
DOUBLE_SPHERE = {"model": "double_sphere", "image_size": list(SIZE), "focal": [60.0, 60.0],
                 "center": [79.5, 59.5], "xi": -0.2, "alpha": 0.58}  # fmt: skip
EXTENDED_UNIFIED = {"model": "extended_unified", "image_size": list(SIZE), "focal": [60.0, 60.0],
                    "center": [79.5, 59.5], "alpha": 0.6, "beta": 1.1}  # fmt: skip
MRCAL = """# by mrcal
{ 'lensmodel': 'LENSMODEL_OPENCV8',
  'intrinsics': [ 141., 141.2, 80.4, 59.5, 0.5, 0.1, 1e-3, -2e-3, 0.01, 0.7, 0.15, 0.01,],
  'extrinsics': [ 0., 0., 0., 0., 0., 0.,], 'imagersize': [ 160, 120,], }
"""
COLMAP = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 RADIAL 160 120 141 80.9 60 -0.11 0.09\n"
VISP = """<?xml version="1.0"?>
<root><camera><name>a</name><image_width>160</image_width><image_height>120</image_height>
<model><type>perspectiveProjWithDistortion</type><px>141</px><py>141.2</py><u0>80.4</u0>
<v0>59.5</v0><kud>-0.11</kud><kdu>0.11</kdu></model></camera></root>
"""
BOARD = {"type": "chessboard", "corners": [6, 5], "square": 0.026, "tolerance": 0.001}
CHARUCO = {"type": "charuco", "squares": [7, 5], "square": 0.03, "marker": 0.022,
           "dictionary": "DICT_4X4_50"}  # fmt: skip
GRID = {"type": "aruco_grid", "markers": [4, 3], "marker": 0.03, "gap": 0.01,
        "dictionary": "DICT_4X4_50", "first_id": 0}  # fmt: skip


def make(folder: Path) -> None:
    """All bases into a new folder."""
    folder.mkdir(parents=True)
    nominal = load_mechanism("3-rpr")
    camera = camera_of_size(SIZE)
    rendered(folder / "legs", nominal, camera, Settings(stations=1, configurations=4))
    rendered(folder / "hand", nominal, camera, Settings(configurations=3, handheld=True))
    for name in ("legs", "hand"):
        (folder / name / "truth.json").unlink()
    more(folder / "legs" / "session.yaml", EVERYTHING)
    by_exif(folder / "hand")
    measured(folder / "tracker", seed=1, count=14)
    measured(folder / "later", seed=2, count=5)
    boards(folder / "board")
    for name, text in machines():
        (folder / "machines").mkdir(exist_ok=True)
        (folder / "machines" / f"{name}.yaml").write_text(text)
    cameras(folder / "cameras")
    delta_printers(folder / "printers")
    models(folder / "models")
    pictures_of(folder / "pictures", (folder / "legs/images/station1/0000.png").read_bytes())
    results(folder)


def delta_printers(folder: Path) -> None:
    """Firmwares' files of a printer, and of its bed."""
    folder.mkdir()
    places = printers.bed(8)
    (folder / "printer.cfg").write_text("[probe]\nz_offset: 1.2\n" + printers.calibrated_cfg())
    (folder / "config.g").write_text(
        "G90 ; absolute\nM665 L270:270.1:269.9 R105 H300 B90 X0.1 Y0 Z-0.1\nM666 X0.2 Y0 Z-0.2\n"
    )
    bed = "".join(f"Bed X: {x:.2f} Y: {y:.2f} Z: 0.1{k}\n" for k, (x, y) in enumerate(places))
    (folder / "m503.txt").write_text(
        "Recv: echo: M92 X80.00 Y80.00 Z80.00\nRecv: echo:  M666 X0.00 Y-0.50 Z-0.25\n"
        "Recv: echo:  M665 L270.00 R105.00 H300.00 S200.00 X0.10 Y0.00 Z-0.10 A0.10 B0.00 C0.00\n"
        f"Recv: echo:  M851 X0.00 Y0.00 Z-1.50\n{bed}"
    )
    (folder / "part.yaml").write_text(
        "unit: mm\nmarks: {middle: [0, 0, 5], a: [60, 10.5, 5], b: [-30, 51.9, 6]}\n"
        "distances:\n  - {between: [middle, a], outside: 70.0, inside: 51.4}\n"
        "  - {between: [a, b], apart: 98.7}\nnoise: 0.03\nshrinkage: 0.1 %\n"
    )
    (folder / "configuration.txt").write_text(
        "#define CONFIGURATION_H_VERSION 02010205\n#define DELTA_DIAGONAL_ROD 270.0 // (mm)\n"
        "#define OFFSET 30.0\n#define DELTA_RADIUS (135.0-(OFFSET))\n#define DELTA_HEIGHT 300\n"
        "#define DELTA_ENDSTOP_ADJ { 0.0, -0.5, -0.2 }\n#define NOZZLE_AS_PROBE\n"
        f"#define NOZZLE_TO_PROBE_OFFSET {{ 0, 0, -1.5 }}\n{bed}"
    )
    lines = [f"// probe at {x:.3f},{y:.3f} is z=1.{k}" for k, (x, y) in enumerate(places)]
    (folder / "console.txt").write_text("\n".join(lines))
    (folder / "towers.cfg").write_text("[stepper_b]\nangle: 330.1\n")
    (folder / "mesh.cfg").write_text(
        "[include towers.cfg]\n[bed_mesh]\nmesh_radius: 80\nfaulty_region_1_min: 30, 30\n"
        + "faulty_region_1_max: 60, 60\n" + printers.printer_cfg(printers.Settings())
        + "#*# [bed_mesh default]\n#*# points =\n" + 5 * "#*# \t 0.1, 0.2, 0.1, 0.0, 0.1\n"
        + "#*# x_count = 5\n#*# y_count = 5\n#*# min_x = -80\n#*# max_x = 80\n#*# min_y = -80\n"
        "#*# max_y = 80\n"
    )  # fmt: skip
    six = ",".join(6 * ["74.1"])
    (folder / "part.log").write_text(
        "\n".join(lines) + "\nProbe samples exceed tolerance. Retrying...\n"
        f"DELTA_ANALYZE CENTER_DISTS={six} OUTER_DISTS={six}\nprobe accuracy results: range 0.1,"
        " standard deviation 0.003\nDELTA_ANALYZE CENTER_PILLAR_WIDTHS = [9.1, 9.0, 9.2]\n"
        f"DELTA_ANALYZE OUTER_PILLAR_WIDTHS={six.replace('74', '9')} SCALE=1\n"
    )
    (folder / "grid.txt").write_text(
        "G29 L-60 R60 F-60 B60\nBilinear Leveling Grid:\n      0      1      2\n"
        + "".join(f" {k}{7 * ' +0.010'}\n" for k in range(7))
    )
    arms = "".join(f"[stepper_{s}]\nupper_arm_length: 170\nlower_arm_length: 320\n"
                   "position_endstop: 252\n" for s in "abc")  # fmt: skip
    (folder / "rotary.cfg").write_text(
        f"[printer]\nkinematics: rotary_delta\nshoulder_radius: 34\nshoulder_height: 413\n{arms}"
    )
    anchors = [(0, -2000, -100), (2000, 1000, -100), (-2000, 1000, -100), (0, 0, 3000)]
    (folder / "winch.cfg").write_text(
        "[printer]\nkinematics: winch\n"
        + "".join(f"[stepper_{s}]\nanchor_x: {x}\nanchor_y: {y}\nanchor_z: {z}\n"
                  for s, (x, y, z) in zip("abcd", anchors, strict=True))
    )  # fmt: skip
    lines = [f"G30 P{k} X{x:.1f} Y{y:.1f} Z-99999" for k, (x, y) in enumerate(places)]
    (folder / "bed.g").write_text("\n".join([*lines, f"G32 bed probe heights:{' 0.1' * 8}, mean"]))
    rows = "".join("0, 0.01, -0.02, 0.030\n" for _ in range(4))
    (folder / "heightmap.txt").write_text(
        "RepRapFirmware height map file v2 generated at 2026-11-23 10:00\n"
        "axis0,axis1,min0,max0,min1,max1,radius,spacing0,spacing1,num0,num1\n"
        f"X,Y,-40.00,40.00,-40.00,40.00,60.00,26.67,26.67,4,4\n{rows}"
    )
    heads, points = ("x [mm]", "y [mm]", "z [mm]"), np.pad(places, ((0, 0), (0, 1)))
    (folder / "points.csv").write_text(csv_text(heads, [*"abcdefgh"], points))


COPIED_LEG = """<body name="rod{s}" pos="0.2 {y} 0"><joint name="ball{s}" type="ball"/>
<body name="piston{s}"><joint name="slide{s}" type="slide" axis="-0.15 {u} 0.3"/>
<site name="tip{s}" pos="-0.15 {u} 0.3"/></body></body>"""
SIDES = {"l": (0.05, 0.04), "r": (-0.05, -0.04)}
COPIES = (
    '<mujoco><worldbody><body name="platform" pos="0 0 0.3"><freejoint/><replicate count="3"'
    ' euler="0 0 120"><site name="topl" pos="0.05 0.09 0"/><site name="topr" pos="0.05 -0.09 0"/>'
    '</replicate></body><replicate count="3" euler="0 0 120" sep="-"><frame>'
    + "".join(COPIED_LEG.format(s=s, y=y, u=u) for s, (y, u) in SIDES.items())
    + "</frame></replicate></worldbody><equality>"
    + "".join(f'<connect site1="tip{s}-{k}" site2="top{s}{k}"/>' for s in SIDES for k in range(3))
    + "</equality><actuator>"
    + "".join(f'<motor joint="slide{s}"/>' for s in SIDES)
    + "</actuator></mujoco>\n"
)
"""Hexapod of copied legs."""


def models(folder: Path) -> None:
    """Files of ``new --from``: a machine in three formats and in two files, and joint centres."""
    folder.mkdir()
    for to in ("mujoco", "sdf", "urdf"):
        for name, text in exporters()[to].files(MachineSource(load_mechanism("3-rpr"))).items():
            if (folder / name).suffix in (".xml", ".sdf", ".urdf", ".yaml"):
                ending = name.partition(".")[2]
                (folder / f"robot.{ending}").write_text(text)
    (folder / "copies.xml").write_text(COPIES)
    (folder / "whole.xml").write_text('<mujoco><include file="part.xml"/></mujoco>')
    (folder / "part.xml").write_text((folder / "robot.xml").read_text())
    machine = load_mechanism("gough-stewart")
    centers = {"base": machine.base_centers(), "platform": machine.platform_centers()}
    (folder / "pins.hal").write_text("".join(
        f"setp genhexkins.{end}.{j}.{axis} {1e3 * x:.4f}\n"
        for end, points in centers.items() for j, point in enumerate(points)
        for axis, x in zip("xyz", point, strict=True)
    ))  # fmt: skip
    heads = [f"{end}_{axis} [mm]" for end in centers for axis in "xyz"]
    rows = 1e3 * np.hstack(list(centers.values()))
    table = csv_text(heads, [str(k) for k in range(1, 7)], rows)
    (folder / "centres.csv").write_text(table.replace("configuration", "leg", 1))
    (folder / "hangprinter.g").write_text(
        "M669 K6 A0:-1600:-120 B1390:800:-120 C-1390:800:-120 D0:0:2300\nM666 Q0.05 R30:30:30:30"
        " U2:2:2:2 O1:1:1:1 L20:20:20:20 H255:255:255:255\n"
    )
    positions = ", ".join(f"{{bl:{2900 + 7 * k}, br:{3100 - 3 * k}, tr:{3000 + k},"
                          f" tl:{3050 - k}}}" for k in range(6))  # fmt: skip
    (folder / "maslow.log").write_text(f"CLBM:[{positions}]\n")


EVERYTHING = """\
paths: {line: ["0000", "0001", "0002"]}
workspace: {x: [-0.05, 0.05], y: [-0.05, 0.05], turn: 0.2}
"""


def more(path: Path, text: str) -> None:
    path.write_text(path.read_text() + text)


def by_exif(folder: Path) -> None:
    """Images with a focal length in EXIF, for camera: exif."""
    path = folder / "session.yaml"
    path.write_text(path.read_text().replace("cameras/camera.yaml", "exif"))
    for photo in (folder / "images").rglob("*.jpg"):
        plain = cv2.imread(str(photo), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        photo.write_bytes(with_exif(cv2.imencode(".jpg", plain)[1].tobytes(), Exif(1, 32.0)))


def measured(folder: Path, seed: int, count: int) -> None:
    """A hexapod measured by a laser tracker, with distances between positions of its
    tool's point.
    """
    rng, nominal = np.random.default_rng(seed), load_mechanism("gough-stewart")
    built = np.random.default_rng(0).normal(size=len(nominal.values))
    truth = nominal.with_values(nominal.values + 0.5 * nominal.parameters.tolerance * built)
    T = nominal.home() @ pose(
        rotation(rng.uniform(-0.15, 0.15, (count, 3))), rng.uniform(-0.03, 0.03, (count, 3))
    )
    joints = truth.inverse(T)
    T_tracker_base = look_at(np.array([2.0, 0.5, 0.4]), np.array([0, 0, 0.3]), np.eye(3)[2])
    in_view = (
        T_tracker_base @ T @ pose(rotation(np.array([0.1, 0.2, 0.3])), np.array([0.02, 0.01, 0.05]))
    )
    turns = np.stack([cv2.Rodrigues(R)[0].ravel() for R in in_view[:, :3, :3]])
    turns += 1e-4 * rng.normal(size=turns.shape)
    points = in_view[:, :3, 3] + 2e-5 * rng.normal(size=(count, 3))
    names = [f"{seed}{k:02d}" for k in range(count)]
    folder.mkdir()
    (folder / "joints.csv").write_text(csv_text([f"leg{k}" for k in range(1, 7)], names, joints))
    columns = ["x", "y", "z", "rx", "ry", "rz"]
    (folder / "poses.csv").write_text(csv_text(columns, names, np.hstack([points, turns])))
    (folder / "mechanism.yaml").write_text(mechanism_text(nominal))
    station = {"poses": "poses.csv", "noise": {"position": 2e-5, "rotation": 1e-4}}
    session = {"pkmcal": 1, "mechanism": "mechanism.yaml",
               "joints": {"file": "joints.csv", "noise": 3e-6},
               "stations": {"tracker": {"tracker": station}},
               "distances": {"file": "distances.csv", "noise": 3e-5}}  # fmt: skip
    marks = (T @ np.array([0.0, 0.0, 0.05, 1.0]))[:, :3]
    pairs = [(k, k + 2) for k in range(0, count - 2, 2)]
    rows = [f"{names[a]},{names[b]},{np.linalg.norm(marks[b] - marks[a])!s}" for a, b in pairs]
    (folder / "distances.csv").write_text("\n".join(["from,to,distance", *rows]) + "\n")
    (folder / "session.yaml").write_text(yaml_text(session))


def boards(folder: Path) -> None:
    """Images of a chessboard on a platform, a session of them, and an uncalibrated camera."""
    rng = np.random.default_rng(3)
    columns, rows = (n + 1 for n in BOARD["corners"])
    side = 40
    y, x = np.mgrid[: (rows + 2) * side, : (columns + 2) * side] // side
    inside = (x > 0) & (y > 0) & (x <= columns) & (y <= rows)
    drawn = np.where(inside & ((x + y) % 2 == 0), 20, 235).astype(np.uint8)
    size = (2 * SIZE[0], 2 * SIZE[1])
    K = np.array([[282.0, 0, 160.3], [0, 282.4, 119.5], [0, 0, 1]])
    (folder / "images").mkdir(parents=True)
    names = [f"b{k}" for k in range(7)]
    for name in names:
        T = pose(
            rotation(rng.uniform(-0.45, 0.45, 3)),
            np.array([0, 0, 0.34]) + rng.uniform(-0.02, 0.02, 3),
        )
        # pixels of the pattern to metres about its middle, and these to the image's pixels
        metres = BOARD["square"] / side
        middle = np.array([[metres, 0, -metres * drawn.shape[1] / 2],
                           [0, metres, -metres * drawn.shape[0] / 2], [0, 0, 1]])  # fmt: skip
        H = K @ T[:3][:, [0, 1, 3]] @ middle
        in_view = cv2.warpPerspective(drawn, H, size, flags=cv2.INTER_AREA, borderValue=130)
        noisy = cv2.GaussianBlur(in_view, (0, 0), 0.7) + rng.normal(0, 1.0, in_view.shape)
        picture = np.clip(noisy, 0, 255).astype(np.uint8)
        assert cv2.imwrite(str(folder / "images" / f"{name}.png"), picture)
    nominal = load_mechanism("gough-stewart")
    T = nominal.home() @ pose(rotation(rng.uniform(-0.2, 0.2, (7, 3))), np.zeros((7, 3)))
    joints = nominal.inverse(T)
    (folder / "joints.csv").write_text(csv_text([f"leg{k}" for k in range(1, 7)], names, joints))
    (folder / "board.yaml").write_text(yaml_text(BOARD))
    camera = {**CAMERA, "image_size": list(size), "focal": [282.0, 282.4],
              "center": [160.3, 119.5], "distortion": [0.0]}  # fmt: skip
    (folder / "cameras").mkdir()
    (folder / "cameras" / "camera.yaml").write_text(yaml_text(camera))
    session = {"pkmcal": 1, "mechanism": "gough-stewart",
               "joints": {"file": "joints.csv", "noise": 3e-6},
               "stations": {"bench": {"camera": "cameras/camera.yaml",
                                      "images": "images/{configuration}.png", "observe": "board"}},
               "board": {"file": "board.yaml", "fixed_to": "platform"}}  # fmt: skip
    (folder / "session.yaml").write_text(yaml_text(session))


def machines():
    for name in catalogue():
        yield name, mechanism_text(load_mechanism(name))


def cameras(folder: Path) -> None:
    """Camera files of every model and of every other program."""
    folder.mkdir()
    covariance = np.diag([0.1, 0.1, 0.2, 0.2, 1e-4, 1e-4, 1e-8, 1e-8, 1e-4]).tolist()
    for name, fields in (
        ("pinhole", {**CAMERA, "covariance": covariance}), ("unified", MIRROR),
        ("fisheye", FISHEYE), ("rational", RATIONAL), ("double_sphere", DOUBLE_SPHERE),
        ("extended_unified", EXTENDED_UNIFIED),
    ):  # fmt: skip
        path = folder / f"{name}.yaml"
        path.write_text(yaml_text(fields))
        camera = load_camera(path)
        for form in CAMERA_FILE_FORMATS:
            with suppress(InputError):  # a program without this model
                (folder / f"{name}.{form}.yaml").write_text(foreign_text(camera, path, form))
    xml = foreign_text(load_camera(folder / "pinhole.yaml"), folder / "a.xml", "opencv")
    (folder / "pinhole.opencv.xml").write_text(xml)
    for name, text in (("a.cameramodel", MRCAL), ("cameras.txt", COLMAP), ("visp.xml", VISP)):
        (folder / name).write_text(text)
        load_camera(folder / name)


def pictures_of(folder: Path, whole: bytes) -> None:
    """The same image in other kinds of file, and other images of its name."""
    folder.mkdir()
    grey = cv2.imdecode(np.frombuffer(whole, np.uint8), cv2.IMREAD_GRAYSCALE)
    colour = cv2.applyColorMap(grey, cv2.COLORMAP_JET)
    noise = np.random.default_rng(0).integers(0, 255, grey.shape, dtype=np.uint8)

    def put(name, image, *options):
        ok, data = cv2.imencode(name[name.index(".") :], image, options)
        assert ok, name
        (folder / name).write_bytes(data.tobytes())

    for kind in ("png", "jpg", "bmp", "tiff", "pgm", "webp", "jp2", "hdr", "pfm", "ras", "gif"):
        image = colour.astype(np.float32) if kind in ("hdr", "pfm") else colour
        if kind == "pgm":
            image = grey
        try:
            put(f"colour.{kind}", image)
        except cv2.error:  # a kind that this build of OpenCV does not write
            continue
    put("deep.png", grey.astype(np.uint16) * 257)
    put("deep.tiff", grey.astype(np.float32))
    put("alpha.png", np.dstack([colour, noise]))
    put("noise.png", noise)
    put("black.png", np.zeros_like(grey))
    put("one.png", grey[:1, :1])
    put("one.jpg", grey[:1, :1])
    put("half.png", cv2.resize(grey, None, fx=0.5, fy=0.5))
    put("turned.png", np.ascontiguousarray(grey.T))
    put("wide.png", np.zeros((2, 8000), np.uint8))
    put("progressive.jpg", grey, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    put("restarts.jpg", grey, cv2.IMWRITE_JPEG_RST_INTERVAL, 4)
    put("grey.jpg", grey)
    (folder / "cmyk.jpg").write_bytes(pictures.cmyk((folder / "grey.jpg").read_bytes()))
    (folder / "palette.png").write_bytes(pictures.palette(*SIZE))
    (folder / "animated.png").write_bytes(pictures.animated(whole))


def one_camera_model():
    """Context in which not all models of a camera are compared, which takes seconds."""
    options = CalibrationCheckOptions(selection=ModelSelectionOptions(models=("pinhole",)))
    quick = partial(calibrate_camera, options=options)
    return patch("pkmcal.camera_calibration.calibrate.calibrate_camera", quick)


def few_candidates():
    """Context in which a plan is chosen among few candidates."""
    quick = partial(plan_measurements, options=PlanOptions(candidates=60, work_poses=20, rounds=1))
    return patch("pkmcal.api.plan.plan_measurements", quick)


def results(folder: Path) -> None:
    """Results of commands on these sessions; the calibration is usable.

    The quality of a plan and the model of a camera are not tested here.
    """
    at = os.getcwd()  # noqa: PTH109
    os.chdir(folder)
    try:
        with one_camera_model(), few_candidates():
            run_commands()
    finally:
        os.chdir(at)


def run_commands() -> None:
    """Each command once, in the working folder."""
    for words in (
        "calibrate tracker -o calibration",
        "plan machines/3-rpr.yaml --camera cameras/pinhole.yaml -n 2 -o plan",
        "study 3-rpr --vary configurations=3 --runs 2 -o study",
        "validate calibration later -o validation",
        "watch calibration later -o watch",
        "diff calibration machines/gough-stewart.yaml -o diff",
        "check tracker -o check",
        "export calibration --to json -o export",
        "camera board --model pinhole -o camera",
        "servo calibration --camera cameras/pinhole.yaml --runs 1 --duration 1 -o servo",
    ):
        code = main(words.split())
        assert code in (0, 1), words
        assert code == 0 or not words.startswith("calibrate"), "the calibration is refused"
