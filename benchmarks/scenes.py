"""Calibrations of imaged scenes with known truth: true and stated errors.

    OPENBLAS_NUM_THREADS=1 python benchmarks/scenes.py FOLDER [FOLDER ...] [--json]
        [--no-pose | --pose-error M DEG] [--seed N]

FOLDER is a session with its truth.json, or contains such sessions. Each session is copied without
its truth, calibrated as by a user, and scored afterwards. The truth is that of `pkmcal simulate`,
or A_base, B_platform, joint_offsets, T_camera_base and images[].T_base_platform.

A truth has its own base and platform frames, so it is first aligned with the estimate, and rigid
motions of both bodies are projected out of the error e and of its covariance C:

- whitened: sqrt(e' C^+ e / dof), 1 for honest standard deviations, with the range of 95 in 100
  honest ones, and the direction with the largest error (in sigmas);
- tool: the platform's origin at the same readings, over 200 poses between the measured ones; true
  and stated root mean squares, and z, the true error relative to the stated covariance.

Processor times. "observe" is decoding, localization and measurement, relative to decoding the
images and cv2.Canny.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import yaml

TRUTH = "truth.json"
POSES = 200
"""Number of poses at which the tool is evaluated."""
NOTHING = 1e-10
"""Share of the largest variance below which a direction is one that the frames decide."""
WIDTH = 190
"""Letters of the table's lines where they go to a file."""


@dataclass(frozen=True)
class TrueMachine:
    """Truth of a machine with read rods, in frames of its own; m.

    a, b : (L, 3) joint centres on base and platform. offset : (L,) length less reading.
    T_camera_base : (S, 4, 4) of the stations. T_base_platform : (M, 4, 4) of the images.
    """

    a: np.ndarray
    b: np.ndarray
    offset: np.ndarray
    T_camera_base: np.ndarray
    T_base_platform: np.ndarray


@dataclass(frozen=True)
class Errors:
    """Errors of an estimate; m, rad.

    nees, dof : of the whitened error. worst : sigmas of its worst direction. tool, tool_stated :
    root mean squares. tool_z : the former in the latter.
    """

    a: float
    b: float
    offset: float
    nees: float
    dof: int
    worst: float
    tool: float
    tool_stated: float
    tool_z: float
    station: tuple[float, ...] = ()
    station_turn: tuple[float, ...] = ()

    @property
    def whitened(self) -> float:
        """1 where the stated covariance is honest."""
        return float(np.sqrt(self.nees / self.dof))


@dataclass(frozen=True)
class Row:
    """One session. refusal : why there is no estimate. observe : its seconds in those of decoding
    and cv2.Canny. seconds : of the processor, for all of it.
    """

    name: str
    images: int = 0
    refusal: str = ""
    usable: bool = False
    headline: str = ""
    errors: Errors | None = None
    observe: float = np.nan
    seconds: float = np.nan


# ------------------------------------------------------------------ errors


def laid_over(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The rigid motion (4, 4) that brings points (n, 3) nearest to their targets (Kabsch)."""
    middle, there = points.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - there).T @ (points - middle))
    out = np.eye(4)
    out[:3, :3] = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    out[:3, 3] = there - out[:3, :3] @ middle
    return out


def moved(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (..., 3) by rigid motions (4, 4)."""
    return points @ T[:3, :3].T + T[:3, 3]


def cross_matrix(v: np.ndarray) -> np.ndarray:
    """[v]x, (..., 3, 3)."""
    out = np.zeros((*v.shape, 3))
    out[..., [2, 0, 1], [1, 2, 0]] = v
    out[..., [1, 2, 0], [2, 0, 1]] = -v
    return out


def without_frames(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Projector (7L, 7L) of changes of (a, b, offset) that leaves out rigid motions of both."""
    n = len(a)
    motions = np.zeros((7 * n, 12))
    for k, points in enumerate((a, b)):
        by_turn = -cross_matrix(points - points.mean(axis=0))
        by_motion = np.concatenate([by_turn, np.tile(np.eye(3), (n, 1, 1))], axis=-1)
        motions[3 * n * k : 3 * n * (k + 1), 6 * k : 6 * (k + 1)] = by_motion.reshape(3 * n, 6)
    q = np.linalg.qr(motions)[0]
    return np.eye(7 * n) - q @ q.T


def turned(omega: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of rotation vectors, Rodrigues."""
    angle = np.linalg.norm(omega, axis=-1)[..., None, None]
    k = cross_matrix(omega) / np.where(angle > 0, angle, 1.0)
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def forward(
    a: np.ndarray, b: np.ndarray, length: np.ndarray, rot: np.ndarray, t: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Poses (n, 3, 3) and (n, 3) at lengths (n, L), from poses near by; Newton's steps."""
    for _ in range(30):
        arm = b @ rot.mT
        leg = arm + t[:, None] - a
        values = np.linalg.norm(leg, axis=-1)
        u = leg / values[..., None]
        by_pose = np.concatenate([np.cross(arm, u), u], axis=-1)
        step = (np.linalg.pinv(by_pose) @ (length - values)[..., None])[..., 0]
        rot, t = turned(step[:, :3]) @ rot, t + step[:, 3:]
        if np.abs(step).max() < 1e-13:
            break
    return rot, t


def errors_of(
    a: np.ndarray,
    b: np.ndarray,
    offset: np.ndarray,
    covariance: np.ndarray,
    truth: TrueMachine,
    T_camera_base: np.ndarray | None = None,
    seed: int = 1,
) -> Errors:
    """Errors of an estimate a, b (L, 3), offset (L,) with the covariance (7L, 7L) of all in this
    order; T_camera_base (S, 4, 4) of its stations.
    """
    base, platform = laid_over(truth.a, a), laid_over(truth.b, b)
    off = (a - moved(base, truth.a), b - moved(platform, truth.b), offset - truth.offset)
    project = without_frames(a, b)
    error = project @ np.concatenate([part.ravel() for part in off])
    value, vectors = np.linalg.eigh(project @ covariance @ project)
    above_limit = value > NOTHING * value.max()
    z = (vectors.T @ error)[above_limit] / np.sqrt(value[above_limit])
    true, stated = _tool(a, b, offset, project, covariance, truth, base, platform, seed)
    size = np.sum(true * np.linalg.solve(stated, true[..., None])[..., 0], axis=-1) / 3
    station, turn = (), ()
    if T_camera_base is not None and len(T_camera_base) == len(truth.T_camera_base):
        there, here = T_camera_base @ base, truth.T_camera_base
        eyes = [-(T[:, :3, :3].mT @ T[:, :3, 3:])[..., 0] for T in (there, here)]
        station = np.linalg.norm(eyes[0] - eyes[1], axis=-1)
        cosine = (np.einsum("nij,nij->n", there[:, :3, :3], here[:, :3, :3]) - 1) / 2
        turn = np.arccos(np.clip(cosine, -1, 1))
    return Errors(
        a=rms(off[0]),
        b=rms(off[1]),
        offset=rms(off[2]),
        nees=float(np.sum(z**2)),
        dof=int(above_limit.sum()),
        worst=float(np.abs(z).max()),
        tool=rms(np.linalg.norm(true, axis=-1)),
        tool_stated=float(np.sqrt(np.trace(stated, axis1=1, axis2=2).mean())),
        tool_z=float(np.sqrt(size.mean())),
        station=tuple(float(x) for x in station),
        station_turn=tuple(float(x) for x in turn),
    )


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def _tool(
    a: np.ndarray,
    b: np.ndarray,
    offset: np.ndarray,
    project: np.ndarray,
    covariance: np.ndarray,
    truth: TrueMachine,
    base: np.ndarray,
    platform: np.ndarray,
    seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    """The platform's origin at the true machine's readings: error (n, 3) and covariance."""
    rng, poses = np.random.default_rng(seed), truth.T_base_platform
    draws = [(*rng.integers(len(poses), size=2), rng.uniform()) for _ in range(POSES)]
    i, j = (np.array([draw[k] for draw in draws]) for k in (0, 1))
    share = np.array([draw[2] for draw in draws])[:, None]
    rot, t = poses[i, :3, :3], share * poses[i, :3, 3] + (1 - share) * poses[j, :3, 3]
    length = np.linalg.norm(truth.b @ rot.mT + t[:, None] - truth.a, axis=-1)
    # the true pose in the estimate's frames: x' = base x, X' = platform X
    rot = base[:3, :3] @ rot @ platform[:3, :3].T
    t = moved(base, t) - rot @ platform[:3, 3]
    fk, place = forward(a, b, length - truth.offset + offset, rot, t)
    arm = b @ fk.mT
    leg = arm + place[:, None] - a
    u = leg / np.linalg.norm(leg, axis=-1)[..., None]
    by_pose = np.concatenate([np.cross(arm, u), u], axis=-1)
    n = len(a)
    by_all, k = np.zeros((POSES, n, 7 * n)), np.arange(n)
    columns = 3 * k[:, None] + np.arange(3)
    by_all[:, k[:, None], columns] = -u
    by_all[:, k[:, None], 3 * n + columns] = u @ fk
    by_all[:, k, 6 * n + k] = -1
    by = -(np.linalg.pinv(by_pose) @ by_all @ project)[:, 3:]
    return place - t, by @ covariance @ by.mT


# ------------------------------------------------------------------ sessions


def read_truth(folder: Path, nominal: Any) -> TrueMachine | str:
    """The truth of a session, or why there is none that this script can use."""
    data = json.loads((folder / TRUTH).read_text())
    if "pkmcal_truth" in data:
        from pkmcal.simulation.truth import load_truth

        items = load_truth(folder, nominal)
        numbers = numbers_of(items.machine)
        if isinstance(numbers, str):
            return numbers
        in_view = items.T_base_platform[items.images[:, 1]]
        values = items.machine.values[numbers]
        return TrueMachine(*parts_of(values), items.T_camera_base, in_view)
    missing = [key for key in ("A_base", "B_platform", "joint_offsets") if key not in data]
    if missing:
        return f"the truth has no {', '.join(missing)}"
    images = data["images"]
    stations = np.array(data["T_camera_base"])
    if data.get("handheld"):  # every image has a pose of its own, in the images' order
        stations = stations[[image["camera"] for image in images]]
    return TrueMachine(
        *(np.array(data[key]) for key in ("A_base", "B_platform", "joint_offsets")),
        T_camera_base=stations,
        T_base_platform=np.array([image["T_base_platform"] for image in images]),
    )


def numbers_of(machine: Any) -> np.ndarray | str:
    """Where A, B and the offsets of all legs stand among a machine's parameters."""
    names, legs = list(machine.parameters.names), range(1, machine.n_legs + 1)
    centres = [
        f"legs[{j}].{side}.center.{c}" for side in ("base", "platform") for j in legs for c in "xyz"
    ]
    wanted = [*centres, *(f"legs[{j}].length.offset" for j in legs)]
    if set(wanted) - set(names):
        return "the machine has other parts than rods that are read"
    return np.array([names.index(name) for name in wanted])


def parts_of(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """a, b (L, 3) and offset (L,) of what `numbers_of` found."""
    n = len(values) // 7
    return values[: 3 * n].reshape(n, 3), values[3 * n : 6 * n].reshape(n, 3), values[6 * n :]


def score(calibration: Any, folder: Path) -> Errors | str:
    """Errors of a calibration by the truth in a folder, or the reason why they are unknown."""
    truth = read_truth(folder, calibration.session.machine)
    if isinstance(truth, str):
        return truth
    numbers, estimate = numbers_of(calibration.machine), calibration.estimate
    if isinstance(numbers, str):
        return numbers
    covariance = estimate.covariance[np.ix_(numbers, numbers)]
    parts = parts_of(calibration.machine.values[numbers])
    return errors_of(*parts, covariance, truth, estimate.state.T_camera_base)


def spoilt(document: dict[str, Any], error: tuple[float, float], rng: np.random.Generator) -> None:
    """The session's rough poses moved by ``error`` (m, rad), each in a direction of its own."""
    for station in document["stations"].values():
        if "pose" not in station:
            continue
        place, at, up = (np.array(station["pose"][key], float) for key in
                         ("position", "look_at", "up"))  # fmt: skip
        axis, direction = rng.normal(size=(2, 3))
        rot = turned(error[1] * axis / np.linalg.norm(axis))
        there = place + error[0] * direction / np.linalg.norm(direction)
        pose = {"position": there, "look_at": there + rot @ (at - place), "up": rot @ up}
        station["pose"] = {key: value.round(4).tolist() for key, value in pose.items()}


def run(folder: Path, options: argparse.Namespace) -> Row:
    """One session, calibrated without its truth and scored with it."""
    from pkmcal.calibration import calibrate
    from pkmcal.errors import PkmcalError
    from pkmcal.session.load import load_session

    with tempfile.TemporaryDirectory() as temporary:
        copy = Path(temporary) / folder.name
        shutil.copytree(folder, copy, ignore=shutil.ignore_patterns(TRUTH))
        for path in (copy, copy / "session.yaml"):
            path.chmod(0o755)
        document = yaml.safe_load((copy / "session.yaml").read_text())
        if options.no_pose:
            for station in document["stations"].values():
                station.pop("pose", None)
        if options.pose_error:
            metres, degrees = options.pose_error
            rng = np.random.default_rng(options.seed)
            spoilt(document, (metres, np.deg2rad(degrees)), rng)
        (copy / "session.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
        row, begin = Row(folder.name), time.process_time()
        # laps of the processor, not of the wall clock
        clock = SimpleNamespace(perf_counter=time.process_time)
        try:
            session = load_session(copy)
            paths = [p.path for s in session.stations for p in s.images]
            row = replace(row, images=len(paths))
            with patch.object(calibrate, "time", clock):
                calibration = calibrate.calibrate_session(session, seed=options.seed)
        except PkmcalError as error:
            return replace(row, refusal=str(error), seconds=time.process_time() - begin)
        seconds = time.process_time() - begin
        remeasured = calibration.timings.get("decode", 0.0) + calibration.timings["observe"]
        plain = min(decode_and_canny(paths) for _ in range(3))
    errors = score(calibration, folder)
    return replace(
        row,
        usable=calibration.verdict.usable,
        headline=" ".join([calibration.verdict.headline, *calibration.verdict.reasons]),
        errors=None if isinstance(errors, str) else errors,
        refusal=f"not scored: {errors}" if isinstance(errors, str) else "",
        observe=remeasured / plain,
        seconds=seconds,
    )


def decode_and_canny(paths: list[Path]) -> float:
    """Processor's seconds to decode images and find Canny's edges in them."""
    import cv2

    begin = time.process_time()
    for path in paths:
        cv2.Canny(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), 50, 150)
    return time.process_time() - begin


# ------------------------------------------------------------------ results


def honest(dof: int, share: float) -> tuple[float, float]:
    """Range in which whitened errors of honest covariances lie with a probability."""
    from scipy.stats import chi2

    low, high = np.sqrt(chi2.ppf([(1 - share) / 2, (1 + share) / 2], dof) / dof)
    return float(low), float(high)


def together(rows: list[Row]) -> tuple[float, int]:
    """Whitened error of all sessions as one, and its degrees of freedom."""
    errors = [row.errors for row in rows if row.errors]
    dof = sum(e.dof for e in errors)
    return float(np.sqrt(sum(e.nees for e in errors) / max(dof, 1))), dof


COLUMNS = (
    "Session", "Photos", "Usable", "Station mm", "°", "A mm", "B mm", "Offset mm", "Tool mm",
    "stated", "z", "Whitened", "95 %", "Worst σ", "Observe", "s",
)  # fmt: skip


def cells(row: Row) -> list[str]:
    """One line of the table."""
    e, start = row.errors, [row.name, str(row.images)]
    times = [f"{row.observe:.1f}" if np.isfinite(row.observe) else "–", f"{row.seconds:.1f}"]
    if e is None:
        return [*start, "refused" if row.refusal and not row.headline else "–"] + ["–"] * 11 + times
    low, high = honest(e.dof, 0.95)
    least, most = honest(e.dof, 0.99)
    beyond = "" if least <= e.whitened <= most else " beyond 99 %"
    stations = [f"{max(part):.2f}" if part else "–" for part in
                ([1e3 * x for x in e.station], np.degrees(e.station_turn).tolist())]  # fmt: skip
    sizes = [f"{1e3 * x:.3f}" for x in (e.a, e.b, e.offset, e.tool, e.tool_stated)]
    rows = [f"{e.tool_z:.2f}", f"{e.whitened:.2f}{beyond}", f"{low:.2f}-{high:.2f}"]
    usable = "yes" if row.usable else "no"
    return [*start, usable, *stations, *sizes, *rows, f"{e.worst:.1f}", *times]


def print_rows(rows: list[Row]) -> None:
    """The table, refusals in words, and the whitened error of all."""
    from rich.console import Console
    from rich.table import Table

    out = Console(highlight=False)
    if not out.is_terminal:
        out = Console(highlight=False, width=WIDTH)
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for place, name in enumerate(COLUMNS):
        table.add_column(name, justify="left" if place in (0, 2) else "right")
    for row in rows:
        table.add_row(*cells(row))
    out.print(table)
    for row in rows:
        if row.refusal or not row.usable:
            text = row.refusal or row.headline
            out.print(f"\n{row.name}: {text}", markup=False, soft_wrap=True)
    whitened, dof = together(rows)
    if dof:
        low, high = honest(dof, 0.95)
        out.print(f"\nAll together: whitened {whitened:.3f}, 95 % {low:.3f}-{high:.3f} (dof {dof})")


def document(rows: list[Row]) -> dict[str, Any]:
    """Errors for programs; m, rad."""
    whitened, dof = together(rows)

    def one(row: Row) -> dict[str, Any]:
        out = asdict(row)
        if row.errors:
            ranges = {f"range_{p}": honest(row.errors.dof, p / 100) for p in (95, 99)}
            out["errors"] |= {"whitened": row.errors.whitened, **ranges}
        return out

    return {
        "sessions": [one(row) for row in rows],
        "whitened": whitened if dof else None,
        "dof": dof,
        "range_95": honest(dof, 0.95) if dof else None,
    }


def sessions_in(folder: Path) -> list[Path]:
    """A folder that is a session, or the sessions with truth in it."""
    if (folder / "session.yaml").exists():
        return [folder]
    return sorted(path.parent for path in folder.glob("*/session.yaml") if
                  (path.parent / TRUTH).exists())  # fmt: skip


def main(words: list[str] | None = None) -> None:
    """Calibrate and score all sessions."""
    from pkmcal.files import json_text

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    parser.add_argument("--json", action="store_true")
    poses = parser.add_mutually_exclusive_group()
    poses.add_argument("--no-pose", action="store_true", help="drop the rough poses")
    poses.add_argument("--pose-error", nargs=2, type=float, metavar=("M", "DEG"))
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(words)
    results = [session for folder in options.folders for session in sessions_in(folder.resolve())]
    unknown = [path for path in results if not (path / TRUTH).exists()]
    if not results or unknown:
        parser.error(f"no session with a {TRUTH} in {unknown or options.folders}")
    rows: list[Row] = []
    for number, session in enumerate(results, start=1):
        print(f"{number} of {len(results)}: {session.name}", file=sys.stderr)
        rows.append(run(session, options))
    if options.json:
        print(json_text(document(rows)), end="")
    else:
        print_rows(rows)


if __name__ == "__main__":
    main()
