"""Localization: stations of all machines without a pose, and sessions with a usual mistake in them.

    python benchmarks/recognition.py [--stations 100]         right, refused, wrong; seconds
    python benchmarks/recognition.py --machines 3-rps ...     of some machines alone
    python benchmarks/recognition.py --mistakes [--no-pose]   named, refused otherwise, not noticed
    python benchmarks/recognition.py --keep FOLDER ...        renders images once and keeps them

Each session is simulated with its own machine, and its stations are localized as at the start of a
calibration. A pose is right within a tenth of the camera's distance and six degrees of the true
one: the calibration converges from there. Poses further off, which a machine of three legs with
large nominal errors may have, are judged by the whole calibration.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from pkmcal.errors import PkmcalError

NEAR, TURNED = 0.1, np.radians(6.0)
"""Share of the camera's distance, and rad, within which a place is right."""
SIZE = (640, 480)
IMAGES = 10
"""Images of each station of the catalogue's machines."""
MISTAKEN = (2, 8)
"""Stations, and images of each, of a session with a mistake."""
HINGED = ("h4-rods",)
"""Machines that cannot be simulated: how far their side bars turn is not known."""


class Outcome(NamedTuple):
    """Result of a session: right, refused or wrong; its message; processor's seconds; the codes of
    the refusal and of what the data do not exclude beside it.
    """

    what: str
    message: str
    seconds: float
    codes: tuple[str, ...] = ()


class Mistake(NamedTuple):
    """A usual mistake: the function that puts it into a session's folder, and the code of its
    finding; none if the session is as good as before.
    """

    make: Callable[[Path, np.random.Generator], None]
    code: str = ""


def simulated(machine: str, seed: int, stations: int, count: int, keep: Path) -> Path:
    """The folder of a session, drawn where it is not there yet."""
    from pkmcal.mechanisms import load_mechanism
    from pkmcal.placement.default_camera import camera_of_size
    from pkmcal.simulation import Settings, simulate_session, with_forearms

    folder = keep / f"{machine}-{stations}x{count}-{seed}"
    if not folder.exists():
        settings = Settings(stations=stations, configurations=count)
        nominal = with_forearms(load_mechanism(machine))
        simulate_session(folder, nominal, camera_of_size(SIZE), settings, seed=seed)
    return folder


def recognised(folder: Path, seed: int, upside_down: bool = False) -> Outcome:
    """Stations localized in a session's images, against its truth; upside down, they are turned
    about their line of sight.
    """
    from pkmcal.calibration.calibrate import calibrate_session
    from pkmcal.calibration.localization import (
        boards_of,
        check_observable,
        localize_stations,
        read_images,
    )
    from pkmcal.session.load import load_session
    from pkmcal.simulation import load_truth

    begin = time.process_time()
    try:
        session = load_session(folder)
        check_observable(session)
        images = read_images(session)
        boards = boards_of(session, images)
        begin = time.process_time()  # of the search alone, where it comes to that
        values = localize_stations(session, images, boards, np.random.default_rng(seed))
    except PkmcalError as error:
        return _refused(error, str(error), time.process_time() - begin)
    seconds = time.process_time() - begin
    true = load_truth(folder, session.machine).T_camera_base
    if upside_down:
        true = np.diag([-1.0, -1.0, 1.0, 1.0]) @ true
    right, text = _near(values, true)
    if not right:
        try:
            end = calibrate_session(session, seed=seed).estimate.state.T_camera_base
        except PkmcalError as error:
            return _refused(error, f"{text} at first; {error}", seconds)
        right, after = _near(end, true)
        text = f"{text}; calibrated, {after}"
    return Outcome("right" if right else "wrong", text, seconds / len(session.stations))


def _refused(error: PkmcalError, message: str, seconds: float) -> Outcome:
    return Outcome("refused", message, seconds, (error.code, *error.rivals))


def _near(values: np.ndarray, true: np.ndarray) -> tuple[bool, str]:
    """Whether cameras T_camera_base (S, 4, 4) stand near where they do in truth, and how far off
    the worst is, in words.
    """
    from pkmcal.geometry.rigid import angle_between, inverse

    at, there = (inverse(T)[:, :3, 3] for T in (values, true))
    place = np.linalg.norm(at - there, axis=1) / np.linalg.norm(there, axis=1)
    turn = angle_between(values, true)
    text = f"{100 * place.max():.1f} % of the distance, {np.degrees(turn.max()):.1f} degrees off"
    return bool((place < NEAR).all() and (turn < TURNED).all()), text


def calibrated(folder: Path, seed: int) -> Outcome:
    """Whether a session whose stations were localized is refused in the end."""
    from pkmcal.calibration.calibrate import calibrate_session

    begin = time.process_time()
    try:
        verdict = calibrate_session(folder, seed=seed).verdict
    except PkmcalError as error:
        return _refused(error, str(error), time.process_time() - begin)
    what = "wrong" if verdict.usable else "refused"
    return Outcome(what, verdict.headline, time.process_time() - begin)


# ------------------------------------------------------------------ mistakes


def edited(path: Path, change: Callable[[Any], None]) -> None:
    """A YAML file with a change."""
    document = yaml.safe_load(path.read_text())
    change(document)
    path.write_text(yaml.safe_dump(document, sort_keys=False))


def readings(folder: Path, order: Callable[[list[str]], list[str]]) -> None:
    """The readings' columns in another order, under their names as before."""
    path = folder / "joints.csv"
    head, *rows = list(csv.reader(path.read_text().splitlines()))
    lines = [head, *([row[0], *order(row[1:])] for row in rows)]
    path.write_text("\n".join(",".join(line) for line in lines) + "\n")


def pictures(folder: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """All images changed."""
    import cv2

    for path in sorted(folder.glob("images/*/*.png")):
        cv2.imwrite(str(path), change(np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))))


def renamed(folder: Path, order: Callable[[list[Path]], list[Path]]) -> None:
    """Each station's images under each other's names."""
    for station in sorted((folder / "images").iterdir()):
        paths = sorted(station.iterdir())
        data = [path.read_bytes() for path in order(paths)]
        for path, bytes_ in zip(paths, data, strict=True):
            path.write_bytes(bytes_)


def without_poses(folder: Path) -> None:
    """The stations' poses dropped."""

    def drop(document: dict[str, Any]) -> None:
        for station in document["stations"].values():
            station.pop("pose", None)

    edited(folder / "session.yaml", drop)


def _two(count: int, rng: np.random.Generator) -> tuple[int, int]:
    a, b = rng.choice(count, 2, replace=False)
    return int(a), int(b)


def _exchanged(items: list[Any], rng: np.random.Generator) -> list[Any]:
    a, b = _two(len(items), rng)
    out = list(items)
    out[a], out[b] = out[b], out[a]
    return out


def _columns(folder: Path, rng: np.random.Generator) -> None:
    a, b = _two(6, rng)
    order = [b if k == a else a if k == b else k for k in range(6)]
    readings(folder, lambda row: [row[k] for k in order])


def _radii(folder: Path, _: np.random.Generator) -> None:
    def double(document: dict[str, Any]) -> None:
        for leg in document["legs"]:
            for tube in leg["tubes"]:
                tube["radius"] *= 2

    edited(folder / "mechanism.yaml", double)


def _millimetres(folder: Path, _: np.random.Generator) -> None:
    def larger(value: Any) -> Any:
        if isinstance(value, dict):
            # a reading's scale has no unit
            return {k: part if k == "scale" else larger(part) for k, part in value.items()}
        if isinstance(value, list):
            return [larger(part) for part in value]
        return 1e3 * value if isinstance(value, float) else value

    edited(folder / "mechanism.yaml", lambda d: d.update(legs=larger(d["legs"])))


def _another(folder: Path, _: np.random.Generator) -> None:
    """A machine of the same kind, a third wider, whose base's joints stand elsewhere."""

    def other(document: dict[str, Any]) -> None:
        turn = np.radians(25.0)
        for number, leg in enumerate(document["legs"]):
            x, y, z = leg["base"]["center"]
            s = np.sin(turn if number % 2 else -turn)
            c = np.cos(turn)
            leg["base"]["center"] = [float(1.3 * (c * x - s * y)), float(1.3 * (s * x + c * y)), z]

    edited(folder / "mechanism.yaml", other)


def _stations(folder: Path, _: np.random.Generator) -> None:
    def exchange(document: dict[str, Any]) -> None:
        one, two = document["stations"].values()
        one["pose"], two["pose"] = two["pose"], one["pose"]

    edited(folder / "session.yaml", exchange)


MISTAKES: dict[str, Mistake] = {
    "columns exchanged": Mistake(_columns, "readings.exchanged"),
    "numbering turned": Mistake(
        lambda f, _: readings(f, lambda row: row[1:] + row[:1]), "readings.numbering_turned"
    ),
    "numbering backwards": Mistake(
        lambda f, _: readings(f, lambda row: row[::-1]), "readings.numbering_reversed"
    ),
    "images exchanged": Mistake(
        lambda f, rng: renamed(f, lambda paths: _exchanged(paths, rng)), "image.exchanged"
    ),
    "images shifted": Mistake(
        lambda f, _: renamed(f, lambda paths: paths[1:] + paths[:1]), "image.shifted"
    ),
    "mirrored": Mistake(lambda f, _: pictures(f, lambda p: p[:, ::-1]), "image.mirrored"),
    "upside down": Mistake(lambda f, _: pictures(f, lambda p: p[::-1, ::-1])),
    "diameters": Mistake(_radii, "tube.diameter"),
    "millimetres": Mistake(_millimetres, "mechanism.units"),
    "another machine": Mistake(_another, "station.not_recognised"),
    "stations exchanged": Mistake(_stations, "station.exchanged"),
}


def mistaken(name: str, folder: Path, seed: int, no_pose: bool) -> Outcome:
    """A session with a mistake: named, refused otherwise, or not detected."""
    mistake = MISTAKES[name]
    with tempfile.TemporaryDirectory() as temporary:
        copy = Path(temporary) / folder.name
        shutil.copytree(folder, copy)
        if no_pose:
            without_poses(copy)
        mistake.make(copy, np.random.default_rng(seed))
        value = recognised(copy, seed, upside_down=name == "upside down")
        if mistake.code and value.what != "refused":
            value = calibrated(copy, seed)
    if not mistake.code:
        return value._replace(what="named" if value.what == "right" else value.what)
    if value.what != "refused":
        return value._replace(what="not noticed")
    return value._replace(what="named" if mistake.code in value.codes else "refused")


# ------------------------------------------------------------------ results


def of_catalogue(
    count: int, keep: Path, machines: list[str] | None = None
) -> Iterator[tuple[str, Outcome]]:
    """Stations of all machines, or of some, in turn, each without a pose."""
    from pkmcal.mechanisms import catalogue

    names = machines or sorted(set(catalogue()) - set(HINGED))
    for k in range(count):
        name, seed = names[k % len(names)], k // len(names)
        folder = simulated(name, seed, 1, IMAGES, keep)
        with tempfile.TemporaryDirectory() as temporary:
            copy = Path(temporary) / folder.name
            shutil.copytree(folder, copy)
            without_poses(copy)
            yield name, recognised(copy, seed)


def of_mistakes(count: int, keep: Path, no_pose: bool) -> Iterator[tuple[str, Outcome]]:
    """Each mistake in sessions of a hexapod."""
    for name in MISTAKES:
        if name == "stations exchanged" and no_pose:
            continue
        for seed in range(count):
            folder = simulated("gough-stewart", 100 + seed, *MISTAKEN, keep)
            yield name, mistaken(name, folder, seed, no_pose)


def main() -> None:
    """One line a session as it is done, then the counts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--stations", type=int, default=100)
    parser.add_argument("--machines", nargs="+", metavar="NAME", help="of these machines alone")
    parser.add_argument("--mistakes", action="store_true")
    parser.add_argument("--sessions", type=int, default=5, help="of each mistake")
    parser.add_argument("--no-pose", action="store_true", help="mistakes: drop the rough poses")
    parser.add_argument("--keep", type=Path, help="folder for the images")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        keep = options.keep or Path(temporary)
        if options.mistakes:
            outcomes = of_mistakes(options.sessions, keep, options.no_pose)
        else:
            outcomes = of_catalogue(options.stations, keep, options.machines)
        counts: dict[str, Counter[str]] = {}
        seconds: dict[str, list[float]] = {}
        for name, outcome in outcomes:
            counts.setdefault(name, Counter())[outcome.what] += 1
            seconds.setdefault(name, []).append(outcome.seconds)
            print(f"{name}: {outcome.what} ({outcome.message.splitlines()[0]})", file=sys.stderr)
    total: Counter[str] = sum(counts.values(), Counter())
    for name, count in [*counts.items(), ("all", total)]:
        words = ", ".join(f"{n} {what}" for what, n in count.most_common())
        taken = np.concatenate(list(seconds.values())) if name == "all" else seconds[name]
        print(f"{name:24} {words:40} {np.median(taken):6.1f} s")


if __name__ == "__main__":
    main()
