"""False alarms: findings in sessions without any mistake.

    OPENBLAS_NUM_THREADS=1 python benchmarks/right_sessions.py [--sessions 10] [--kind KIND ...]
                                                               [--first SEED] [--workers 2]

Sessions of each kind, each with its own machine whose errors have the nominal model's prior sigmas,
and with noise as stated. For each kind: sessions that are refused, that have a model violation, a
rejected configuration, a stated noise that is contradicted, and any of these; 95 % intervals of the
readings' noise that contain the truth, of those with two ends and of all; the tool's error over the
session's poses in stated standard deviations (root mean square over the sessions, and the largest);
seconds. Then each of these findings in its own words.

Legs and images by hand are rendered; boards are corners with noise, trackers tables, and printers
the heights that their firmware stores.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

import printers

INTERVAL_MISS = 0.05
CORNER_SIGMA = 0.1
"""px, of a board's corner."""
TRACKER_SIGMA = np.repeat([1e-4, 2e-5], 3)
"""rad and m."""
HEIGHT_SIGMA = 0.02
"""mm, of a printer's probe."""
FINDINGS = ("refused", "departure", "outvoted", "noise", "rejected")
"""rejected : measured poses, which in these sessions are all right."""


class Session(NamedTuple):
    """A session's folder; the true machine, poses (K, 4, 4) and readings (K, m), None where they
    are not compared; factor of the readings' true noise on the stated one; corners in place of
    images.
    """

    folder: Path
    machine: Any
    poses: Any
    readings: Any
    detections: Any = None


class Outcome(NamedTuple):
    """Findings on a session, by kind; the interval of the readings' noise; z of the tool, NaN if it
    is not compared; seconds.
    """

    findings: dict[str, list[str]]
    low: float
    high: float
    z: float
    seconds: float


def written(folder: Path, nominal: Any, readings: Any, noise: float, **more: Any) -> None:
    """Files of a session without images."""
    from pkmcal.files import csv_text, yaml_text
    from pkmcal.mechanisms import mechanism_text

    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{k:03d}" for k in range(len(readings))]
    columns = [f"motor{k + 1}" for k in range(readings.shape[1])]
    (folder / "mechanism.yaml").write_text(mechanism_text(nominal))
    (folder / "joints.csv").write_text(csv_text(columns, names, readings))
    document = {
        "pkmcal": 1,
        "mechanism": "mechanism.yaml",
        "joints": {"file": "joints.csv", "noise": noise},
        **more,
    }
    (folder / "session.yaml").write_text(yaml_text(document))


def imaged(
    machine: str, stations: int, count: int, size: tuple[int, int], *, handheld: bool = False
) -> Callable[[Path, int], Session]:
    """A session of legs in rendered images."""

    def make(folder: Path, seed: int) -> Session:
        from pkmcal.mechanisms import load_mechanism
        from pkmcal.placement.default_camera import camera_of_size
        from pkmcal.simulation import Settings, simulate_session, with_forearms

        nominal = with_forearms(load_mechanism(machine))
        settings = Settings(stations=stations, configurations=count, handheld=handheld)
        truth = simulate_session(folder, nominal, camera_of_size(size), settings, seed=seed)
        return Session(folder, truth.machine, truth.T_base_platform, truth.joints)

    return make


def board(machine: str, count: int, noise: float) -> Callable[[Path, int], Session]:
    """A session of a board on the platform, one station; noise of a reading, m or rad."""

    def make(folder: Path, seed: int) -> Session:
        import cv2

        from pkmcal.boards.board import Detection
        from pkmcal.files import yaml_text
        from pkmcal.geometry.rigid import apply
        from pkmcal.mechanisms import load_mechanism
        from pkmcal.placement.default_camera import camera_of_size
        from pkmcal.placement.stations import one_a_station
        from pkmcal.simulation import Settings, board_for, draw_truth, with_forearms

        nominal = with_forearms(load_mechanism(machine))
        made, camera = board_for(nominal, "platform"), camera_of_size((1280, 960))
        settings = Settings(
            stations=1, configurations=count, board=made, board_on="platform", observe=("board",),
            joint_noise=noise,
        )  # fmt: skip
        cameras = one_a_station(camera, 1)
        truth = draw_truth(nominal, cameras, settings, seed)
        T = truth.T_camera_base[0] @ truth.T_base_platform @ truth.T_platform_board
        pixels = camera.project(apply(T[:, None], made.points))
        rng = np.random.default_rng([seed, 1])
        pixels = pixels + CORNER_SIGMA * rng.normal(size=pixels.shape)
        inside = camera.in_image(pixels, margin=2.0)
        results = []
        for k, in_view in enumerate(inside):
            ids = np.flatnonzero(in_view)
            sigma = np.full(len(ids), CORNER_SIGMA)
            reason = "" if len(ids) >= 12 else "out of the picture"
            results.append(
                Detection(f"{k:03d}.png", camera.image_size, ids, pixels[k, ids], sigma, reason)
            )
        (folder / "images").mkdir(parents=True)
        grey = cv2.imencode(".png", np.full((960, 1280), 128, dtype=np.uint8))[1].tobytes()
        for item in results:
            (folder / "images" / item.name).write_bytes(grey)
        (folder / "camera.yaml").write_text(yaml_text(camera.document()))
        document = {k: v for k, v in made.document.items() if k != "tolerance"}
        (folder / "board.yaml").write_text(yaml_text(document))
        station = {
            "camera": "camera.yaml", "images": "images/{configuration}.png", "observe": "board",
        }  # fmt: skip
        more = {"stations": {"tripod": station}, "board": "board.yaml"}
        written(folder, nominal, truth.readings, noise, **more)
        return Session(folder, truth.machine, truth.T_base_platform, truth.joints, tuple(results))

    return make


def tracker(machine: str, count: int, noise: float, *, points: bool) -> Any:
    """A session of a tracker's table, of poses or of points."""

    def make(folder: Path, seed: int) -> Session:
        from pkmcal.files import csv_text
        from pkmcal.geometry.rigid import perturb, pose, rotation, rotation_vector
        from pkmcal.mechanisms import load_mechanism
        from pkmcal.placement.configurations import draw_configurations
        from pkmcal.simulation import true_machine

        rng = np.random.default_rng(seed)
        nominal = load_mechanism(machine)
        truth = true_machine(nominal, 1.0, rng)
        poses, joints = draw_configurations(truth, count, 0.5, rng)
        place = pose(rotation(rng.normal(size=3)), rng.normal(size=3))
        target = pose(rotation(rng.normal(size=3)), 0.03 * rng.normal(size=3))
        in_view = perturb(place @ poses @ target, TRACKER_SIGMA * rng.normal(size=(len(poses), 6)))
        values = np.concatenate([in_view[:, :3, 3], rotation_vector(in_view[:, :3, :3])], axis=1)
        columns = ("x", "y", "z", "rx", "ry", "rz")[: 3 if points else 6]
        sigma = {"rotation": TRACKER_SIGMA[0], "position": TRACKER_SIGMA[3]}
        table = {"poses": "poses.csv", "noise": {k: float(v) for k, v in sigma.items()}}
        readings = joints + noise * rng.normal(size=joints.shape)
        written(folder, nominal, readings, noise, stations={"tracker": {"tracker": table}})
        names = [f"{k:03d}" for k in range(len(poses))]
        (folder / "poses.csv").write_text(csv_text(columns, names, values[:, : len(columns)]))
        return Session(folder, truth, poses, joints)

    return make


def true_printer(rng: np.random.Generator) -> Any:
    """A delta printer whose parts are as far off as those of a kit."""
    built = printers.Settings(
        radius=105.0 + 0.3 * rng.normal(),
        angle=tuple(np.array([210.0, 330.0, 90.0]) + 0.1 * rng.normal(size=3)),
        rod=tuple(270.0 + 0.1 * rng.normal(size=3)),
    )
    return printers.machine(built, endstops=tuple(0.3 * rng.normal(size=3)))


def klipper_printer(points: int) -> Callable[[Path, int], Session]:
    """Heights of a bed as Klipper's DELTA_CALIBRATE keeps them."""

    def make(folder: Path, seed: int) -> Session:
        from pkmcal.firmware.session import write_printer_session

        rng = np.random.default_rng(seed)
        readings = printers.felt(true_printer(rng), printers.bed(points), HEIGHT_SIGMA, rng)
        folder.parent.mkdir(parents=True, exist_ok=True)
        file = folder.parent / f"{folder.name}.cfg"
        file.write_text(printers.printer_cfg(printers.Settings(), readings))
        write_printer_session(folder, file)
        return Session(folder, None, None, None)

    return make


def reprap_printer(ticks: int) -> Callable[[Path, int], Session]:
    """A height map of a bed as RepRapFirmware writes it, over a grid of ticks by ticks."""

    def make(folder: Path, seed: int) -> Session:
        from pkmcal.firmware.session import write_printer_session

        rng = np.random.default_rng(seed)
        true, describe = true_printer(rng), printers.machine(printers.Settings())
        line = np.linspace(-90.0, 90.0, ticks)
        grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        inside = np.hypot(*grid.T) <= 90.5
        touched, goal, heights = grid[inside], grid[inside], np.zeros(0)
        noise = int(rng.integers(2**32))
        for _ in range(4):  # to the firmware's positions of the grid's points
            readings = printers.felt(true, touched, HEIGHT_SIGMA, np.random.default_rng(noise))
            points = 1e3 * describe.forward(1e-3 * readings)[:, :3, 3]
            touched, heights = touched + goal - points[:, :2], points[:, 2]
        rows = np.zeros(len(grid))
        rows[inside] = heights
        cells = [f"{z:7.3f}" if at else "      0" for z, at in zip(rows, inside, strict=True)]
        spacing = line[1] - line[0]
        text = "RepRapFirmware height map file v2\n"
        text += "xmin,xmax,ymin,ymax,radius,xspacing,yspacing,xnum,ynum\n"
        text += f"-90,90.1,-90,90.1,90.5,{spacing:.2f},{spacing:.2f},{ticks},{ticks}\n"
        text += "".join(", ".join(cells[k : k + ticks]) + "\n" for k in range(0, len(cells), ticks))
        folder.parent.mkdir(parents=True, exist_ok=True)
        file, probed = folder.parent / "config.g", folder.parent / "heightmap.csv"
        s = printers.Settings()
        height = s.endstop[0]  # all three are equal in these settings
        file.write_text(
            f"M669 K3\nM665 L{s.rod[0]}:{s.rod[1]}:{s.rod[2]} R{s.radius} H{height} B95 X0 Y0 Z0\n"
            "M666 X0 Y0 Z0\nM92 X80 Y80 Z80\n"
        )
        probed.write_text(text)
        write_printer_session(folder, file, probed)
        return Session(folder, None, None, None)

    return make


KINDS: dict[str, Callable[[Path, int], Session]] = {
    "legs, hexapod": imaged("gough-stewart", 2, 8, (640, 480)),
    "legs, three-legged": imaged("3-rps", 2, 8, (640, 480)),
    "by hand, hexapod": imaged("gough-stewart", 1, 8, (640, 480), handheld=True),
    "board, hexapod": board("gough-stewart", 20, 3e-6),
    "board, H4": board("h4", 24, 3e-6),
    "board, delta": board("delta", 24, 1e-5),
    "board, delta by servos": board("delta", 24, float(np.deg2rad(0.5))),
    "board, 6-RUS": board("6-rus", 24, 1e-5),
    "board, 6-RUS by servos": board("6-rus", 24, float(np.deg2rad(0.5))),
    "tracker, hexapod": tracker("gough-stewart", 20, 1e-5, points=False),
    "tracker's points, delta": tracker("delta", 24, 1e-5, points=True),
    "Klipper, 7 heights": klipper_printer(7),
    "Klipper, 19 heights": klipper_printer(19),
    "RepRapFirmware, 69 heights": reprap_printer(9),
}


def off_by(result: Any, session: Session) -> float:
    """How far the tool is off at the session's true poses, in stated standard deviations."""
    from pkmcal.identify.tool import tool_error

    if session.machine is None:
        return float("nan")
    legs_observed = result.estimate.edge_weights.size > 0
    stated = tool_error(
        result.session.machine, result.machine, result.estimate.covariance,
        session.poses, session.readings, legs_observed=legs_observed,
    )  # fmt: skip
    off = tool_error(
        session.machine, result.machine, stated.parameters, session.poses, session.readings,
        legs_observed=legs_observed,
    )  # fmt: skip
    return float(np.sqrt(np.nanmean(off.off_position**2) / np.nanmean(stated.position**2)))


def outcome(kind: str, seed: int, folder: Path) -> Outcome:
    """One session, made and calibrated."""
    from contextlib import nullcontext

    from pkmcal import calibrate
    from pkmcal.errors import PkmcalError
    from pkmcal.identify.noise import noise_shares
    from pkmcal.identify.row_sums import READING_ROWS

    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        session = KINDS[kind](Path(temporary) / "session", seed)
        corners = session.detections
        item = patch("pkmcal.boards.stations.detect_in", lambda *_: corners)
        quiet = patch("pkmcal.boards.stations.check_boards", lambda *_: None)
        begin, none = time.perf_counter(), nullcontext()
        try:
            with item if corners else none, quiet if corners else none:
                result = calibrate(session.folder)
        except PkmcalError as error:
            seconds = time.perf_counter() - begin
            return Outcome({"refused": [str(error)]}, 0.0, float("inf"), float("nan"), seconds)
        seconds = time.perf_counter() - begin
    lost = int(np.sum(result.estimate.pose_weights < 0.5))
    verdict, statistics = result.verdict, result.estimate.statistics
    findings = {
        "refused": list(verdict.reasons),
        "departure": [one.finding.text for one in result.violations],
        "outvoted": [
            one.text
            for code in ("readings.outvoted", "configurations.misnamed")
            for one in verdict.of(code)
        ],
        "noise": [
            one.text for code in ("poses.noise", "readings.noise") for one in verdict.of(code)
        ]
        + ["joints.noise contradicted"] * (statistics.reading_scale != 1),
        "rejected": [f"{lost} of {result.estimate.pose_weights.size} measured poses"] * (lost > 0),
        "other": list(verdict.warnings),
    }
    info = result.estimate.linearized.info
    low, high = noise_shares(info, READING_ROWS).interval(INTERVAL_MISS)
    scale = statistics.reading_scale
    return Outcome(
        findings, float(scale * low[0]), float(scale * high[0]), off_by(result, session), seconds
    )


def main() -> None:
    """A line a kind, then the findings."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sessions", type=int, default=10, help="of each kind")
    parser.add_argument("--first", type=int, default=0, help="seed of the first one")
    parser.add_argument("--kind", nargs="*", help="kinds whose names have one of these words")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--other", action="store_true", help="all other warnings too")
    options = parser.parse_args()
    kinds = [k for k in KINDS if not options.kind or any(word in k for word in options.kind)]
    seeds = range(options.first, options.first + options.sessions)
    words, every, within, two_ended = [], 0, [], []
    with tempfile.TemporaryDirectory() as temporary, ProcessPoolExecutor(options.workers) as pool:
        print(f"{'':26}{'n':>4}" + "".join(f"{name:>10}" for name in (*FINDINGS, "any"))
              + f"{'interval':>10}{'two ends':>10}{'z rms':>7}{'worst':>7}{'s':>6}")  # fmt: skip
        for kind in kinds:
            jobs = [(kind, seed, Path(temporary)) for seed in seeds]
            results = list(pool.map(outcome, *zip(*jobs, strict=True)))
            hit = [[bool(one.findings.get(name)) for name in FINDINGS] for one in results]
            visible = np.array(hit)
            holds = np.array([one.low <= 1 <= one.high for one in results])
            both = np.array([one.low > 0 and np.isfinite(one.high) for one in results])
            z = np.array([one.z for one in results])
            every += int(visible.any(axis=1).sum())
            within += holds.tolist()
            two_ended += holds[both].tolist()
            z_rms = np.sqrt(np.nanmean(z**2)) if np.isfinite(z).any() else float("nan")
            worst = np.nanmax(z) if np.isfinite(z).any() else float("nan")
            print(f"{kind:26}{len(results):4d}"
                  + "".join(f"{n:10d}" for n in (*visible.sum(axis=0), visible.any(axis=1).sum()))
                  + f"{100 * holds.mean():8.0f} %{holds[both].sum():6d}/{both.sum():<3d}"
                  f"{z_rms:7.2f}{worst:7.2f}{np.mean([one.seconds for one in results]):6.1f}",
                  flush=True)  # fmt: skip
            for seed, one in zip(seeds, results, strict=True):
                names = (*FINDINGS, "other") if options.other else FINDINGS
                words += [f"{kind}, {seed}: {name}: {text}" for name in names
                         for text in one.findings.get(name, ())]  # fmt: skip
    n = len(kinds) * len(seeds)
    print(f"\n{every} of {n} sessions have a finding; intervals hold the truth in"
          f" {100 * np.mean(within):.1f} %, those with two ends in"
          f" {100 * np.mean(two_ended or [np.nan]):.1f} % of {len(two_ended)}\n")  # fmt: skip
    print("\n".join(words))


if __name__ == "__main__":
    main()
