"""Detection of mistakes in well-formed sessions.

    python benchmarks/wrong_sessions.py [--sessions 10] [--only WORDS] [--keep FOLDER]

Each fact of the table is made wrong in simulated sessions, each with its own machine and room:
hexapods by their legs (three stations, twelve images from each), H4s by a board (one station,
twenty-four). Reported for each fact: sessions in which the wrong fact is named in the result, or as
the reason of a refusal; that are refused otherwise, that have another warning, and that are
accepted without a finding; of the last two, those that are off by more than three stated standard
deviations; and the error of the tool's position over the session's poses, root mean square, in
standard deviations. "none" are right sessions.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

SESSIONS = {"legs": (3, 12, (640, 480)), "board": (1, 24, (1280, 960))}
"""Stations, images of each, and their size."""
DISTORTION = -0.08
"""k1 of the lens."""
FAR = 3.0
"""Stated standard deviations beyond which an error is not to be accepted."""


class Fact(NamedTuple):
    """A wrong fact: the function that puts it into a session's folder, codes of findings of which
    one names it, and the sessions in which it can be wrong.

    codes : none where it is enough that the result is right.
    """

    make: Callable[[Path, np.random.Generator], None]
    codes: tuple[str, ...]
    targets: tuple[str, ...] = ("legs", "board")


class Outcome(NamedTuple):
    """Result of a session: named, refused, warned or silent; z of the tool, NaN after an error; its
    messages.
    """

    what: str
    z: float
    message: str


def edited(path: Path, change: Callable[[Any], None]) -> None:
    """A YAML file with a change."""
    document = yaml.safe_load(path.read_text())
    change(document)
    path.write_text(yaml.safe_dump(document, sort_keys=False))


def readings(folder: Path, change: Callable[[np.ndarray], None]) -> None:
    """The readings (K, m) changed in place."""
    path = folder / "joints.csv"
    head, *rows = list(csv.reader(path.read_text().splitlines()))
    values = np.array([[float(x) for x in row[1:]] for row in rows])
    change(values)
    lines = [head, *([row[0], *map(repr, v)] for row, v in zip(rows, values.tolist(), strict=True))]
    path.write_text("\n".join(",".join(line) for line in lines) + "\n")


def scaled(share: float) -> Callable[[Path, np.random.Generator], None]:
    """One encoder's scale."""

    def make(folder: Path, rng: np.random.Generator) -> None:
        def change(values: np.ndarray) -> None:
            values[:, rng.integers(values.shape[1])] *= 1 + rng.choice([-1, 1]) * share

        readings(folder, change)

    return make


def camera(change: Callable[[dict[str, Any], np.random.Generator], None]) -> Any:
    """The camera's file."""

    def make(folder: Path, rng: np.random.Generator) -> None:
        edited(folder / "cameras" / "camera.yaml", lambda document: change(document, rng))

    return make


def focal(share: float) -> Any:
    """Its focal lengths."""

    def change(document: dict[str, Any], rng: np.random.Generator) -> None:
        factor = 1 + rng.choice([-1, 1]) * share
        document["focal"] = [float(f * factor) for f in document["focal"]]

    return camera(change)


def aspect(share: float) -> Any:
    """Scale of the pixels: fx / fy."""

    def change(document: dict[str, Any], rng: np.random.Generator) -> None:
        half = rng.choice([-1, 1]) * share / 2
        fx, fy = document["focal"]
        document["focal"] = [float(fx * (1 + half)), float(fy * (1 - half))]

    return camera(change)


def centre(pixels: float) -> Any:
    """Its centre."""

    def change(document: dict[str, Any], rng: np.random.Generator) -> None:
        direction = rng.uniform(0, 2 * np.pi)
        x, y = document["center"]
        document["center"] = [
            float(x + pixels * np.cos(direction)),
            float(y + pixels * np.sin(direction)),
        ]

    return camera(change)


def undistorted(document: dict[str, Any], _rng: np.random.Generator) -> None:
    """Its distortion left out."""
    document["distortion"] = []


def board(share: float) -> Any:
    """The board's squares."""

    def make(folder: Path, rng: np.random.Generator) -> None:
        factor = 1 + rng.choice([-1, 1]) * share

        def change(document: dict[str, Any]) -> None:
            for key in ("square", "marker"):
                if key in document:
                    document[key] = float(document[key] * factor)

        (path,) = folder.glob("*board*.yaml")
        edited(path, change)

    return make


def play(metres: float) -> Any:
    """A motor whose readings differ by the way from which it came."""

    def make(folder: Path, rng: np.random.Generator) -> None:
        def change(values: np.ndarray) -> None:
            one = values[:, rng.integers(values.shape[1])]
            one += metres / 2 * np.sign(np.diff(one, prepend=one[:1]))

        readings(folder, change)

    return make


def noisier(metres: float) -> Any:
    """All readings worse than stated."""

    def make(folder: Path, rng: np.random.Generator) -> None:
        def change(values: np.ndarray) -> None:
            values += rng.normal(0, metres, values.shape)

        readings(folder, change)

    return make


def one_off(metres: float) -> Any:
    """One reading of one configuration."""

    def make(folder: Path, rng: np.random.Generator) -> None:
        def change(values: np.ndarray) -> None:
            values[rng.integers(len(values)), rng.integers(values.shape[1])] += metres

        readings(folder, change)

    return make


def frozen(folder: Path, rng: np.random.Generator) -> None:
    """A reading that never changes."""

    def change(values: np.ndarray) -> None:
        values[:, rng.integers(values.shape[1])] = values[0].mean()

    readings(folder, change)


def moved(metres: float, radians: float) -> Any:
    """The first station's camera elsewhere in the second half of its images."""

    def make(folder: Path, rng: np.random.Generator) -> None:
        import cv2

        from pkmcal.geometry.rigid import perturb
        from pkmcal.simulation.session import Studio

        seed, in_view = int(folder.name.split("-")[1]), folder.name.split("-")[0]
        truth, cameras, settings, _ = ingredients(in_view, seed)
        direction, axis = rng.normal(size=(2, 3))
        step = np.concatenate(
            [radians * axis / np.linalg.norm(axis), metres * direction / np.linalg.norm(direction)]
        )
        T = truth.T_camera_base.copy()
        T[0] = perturb(T[0], step)
        studio = Studio.of(replace(truth, T_camera_base=T), cameras, settings)
        mine = np.flatnonzero(truth.images[:, 0] == 0)
        for index in mine[len(mine) // 2 :].tolist():
            name = truth.configurations[truth.images[index, 1]]
            (path,) = folder.glob(f"images/*/{name}.png")
            cv2.imwrite(str(path), studio.images(index)[0])

    return make


def sleeve(metres: float) -> Any:
    """A sleeve over a tube that the nominal model does not have."""

    def make(folder: Path, rng: np.random.Generator) -> None:
        def change(document: dict[str, Any]) -> None:
            leg = document["legs"][rng.integers(len(document["legs"]))]
            tube = leg["tubes"][rng.integers(len(leg["tubes"]))]
            tube["radius"] = float(tube["radius"] - metres)

        edited(folder / "mechanism.yaml", change)

    return make


def exchanged(folder: Path, rng: np.random.Generator) -> None:
    """Two images of a station under each other's names, of configurations that differ."""
    paths = sorted(sorted((folder / "images").iterdir())[0].iterdir())
    rows = list(csv.reader((folder / "joints.csv").read_text().splitlines()))[1:]
    joints = {row[0]: np.array([float(x) for x in row[1:]]) for row in rows}
    apart = 0.0
    while apart < 0.01:
        one, two = (paths[k] for k in rng.choice(len(paths), 2, replace=False))
        apart = np.abs(joints[one.stem] - joints[two.stem]).max()
    data = one.read_bytes()
    one.write_bytes(two.read_bytes())
    two.write_bytes(data)


LENS = ("camera.focal", "camera.aspect", "camera.centre", "camera.distortion")
MOVED = ("station.moved", "board.moved")
SCALE = ("readings.scale", "readings.scale_estimates")
BOARD = ("board.size", "board.size_estimate", "board.size_disagrees", "machine.scale")
NOISE = ("readings.noise", "readings.noise_beyond_tolerance", "readings.noise_beyond_encoders")

FACTS: dict[str, Fact] = {
    "none": Fact(lambda _f, _r: None, ()),
    "encoder's scale 1 %": Fact(scaled(0.01), SCALE),
    "encoder's scale .1 %": Fact(scaled(0.001), SCALE),
    "board's squares .2 %": Fact(board(0.002), BOARD, ("board",)),
    "board's squares 1 %": Fact(board(0.01), BOARD, ("board",)),
    "focal length .2 %": Fact(focal(0.002), LENS),
    "focal length 1 %": Fact(focal(0.01), LENS),
    "pixel aspect .3 %": Fact(aspect(0.003), LENS),
    "centre 3 px": Fact(centre(3.0), LENS),
    "centre 30 px": Fact(centre(30.0), LENS),
    "distortion omitted": Fact(camera(undistorted), LENS),
    "camera moved 1 mm": Fact(moved(1e-3, 0.0), MOVED),
    "camera turned .2 degrees": Fact(moved(0.0, 0.0035), MOVED),
    "play of .3 mm": Fact(play(3e-4), ("readings.play", "discrepancy.readings.step")),
    "readings worse, .3 mm": Fact(noisier(3e-4), NOISE),
    "one reading 1 mm off": Fact(one_off(1e-3), ("readings.single", "readings.outvoted")),
    "a sleeve of .3 mm": Fact(sleeve(3e-4), ("tube.radius",), ("legs",)),
    "a sleeve of 1.5 mm": Fact(sleeve(1.5e-3), ("tube.radius",), ("legs",)),
    "a frozen reading": Fact(frozen, ("readings.frozen", "readings.unmoved")),
    "two images exchanged": Fact(exchanged, ("configurations.misnamed", "image.exchanged")),
}


def ingredients(in_view: str, seed: int) -> tuple[Any, Any, Any, Any]:
    """Truth, cameras, settings and nominal model of a session."""
    from pkmcal.mechanisms import load_mechanism
    from pkmcal.placement.default_camera import camera_of_size
    from pkmcal.placement.stations import one_a_station
    from pkmcal.simulation import Settings, board_for, with_forearms
    from pkmcal.simulation.truth import draw_truth

    stations, count, size = SESSIONS[in_view]
    nominal = with_forearms(load_mechanism("gough-stewart" if in_view == "legs" else "h4"))
    lens = camera_of_size(size)
    values = lens.parameters.copy()
    values[4] = DISTORTION
    lens = replace(lens, parameters=values)
    settings = Settings(stations=stations, configurations=count)
    if in_view == "board":
        platform_board = board_for(nominal, "platform")
        settings = replace(settings, board=platform_board, board_on="platform", observe=("board",))
    cameras = one_a_station(lens, stations)
    return draw_truth(nominal, cameras, settings, seed), cameras, settings, nominal


def simulated(in_view: str, seed: int, keep: Path) -> Path:
    """The folder of a right session, drawn where it is not there yet."""
    from pkmcal.simulation import simulate_session

    folder = keep / f"{in_view}-{seed}"
    if not folder.exists():
        _, cameras, settings, nominal = ingredients(in_view, seed)
        simulate_session(folder, nominal, cameras, settings, seed=seed)
        if in_view == "board":  # a print is not exact, unlike a simulated board
            edited(folder / "board.yaml", lambda document: document.pop("tolerance"))
    return folder


def off_by(result: Any, folder: Path) -> float:
    """How far the tool is off at the session's true poses, in stated standard deviations."""
    from pkmcal.identify.tool import tool_error
    from pkmcal.simulation import load_truth

    truth = load_truth(folder, result.session.machine)
    error = result.tool_error(truth.T_base_platform)
    # the calibrated machine against the true one, at the readings as they really were
    off = tool_error(
        truth.machine,
        result.machine,
        error.parameters,
        truth.T_base_platform,
        truth.joints,
        legs_observed=result.estimate.edge_weights.size > 0,
    )
    return float(np.sqrt(np.nanmean(off.off_position**2) / np.nanmean(error.position**2)))


def outcome(fact: str, in_view: str, seed: int, keep: Path) -> Outcome:
    """One session with a wrong fact."""
    from pkmcal import calibrate
    from pkmcal.errors import PkmcalError

    right = simulated(in_view, seed, keep)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / right.name
        shutil.copytree(right, folder)
        FACTS[fact].make(folder, np.random.default_rng(seed))
        codes = FACTS[fact].codes
        try:
            result = calibrate(folder)
        except PkmcalError as error:
            what = "named" if error.code in codes else "refused"
            return Outcome(what, float("nan"), f"{error.code}: {error}")
        z, verdict = off_by(result, folder), result.verdict
    values = " ".join(f"{one.code}: {one.text}" for one in verdict.findings)
    if not set(codes).isdisjoint(verdict.codes):
        return Outcome("named", z, values)
    if not verdict.usable:
        return Outcome("refused", z, values)
    return Outcome("warned" if verdict.warnings else "silent", z, values)


def main() -> None:
    """A line a fact."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sessions", type=int, default=10, help="of each fact and kind")
    parser.add_argument("--first", type=int, default=0, help="seed of the first one")
    parser.add_argument("--only", nargs="*", help="facts whose names have one of these words")
    parser.add_argument("--kind", choices=list(SESSIONS), help="these sessions alone")
    parser.add_argument("--keep", type=Path, help="folder for the right sessions")
    parser.add_argument("--tell", action="store_true", help="what is said, session by session")
    options = parser.parse_args()
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as temporary, ProcessPoolExecutor(2) as pool:
        keep = options.keep or Path(temporary)
        seeds = range(options.first, options.first + options.sessions)
        kinds = [options.kind] if options.kind else list(SESSIONS)
        list(pool.map(simulated, *zip(*[(s, k, keep) for s in kinds for k in seeds],
                                      strict=True)))  # fmt: skip
        print(f"{'':40}{'named':>8}{'refused':>9}{'warned':>8}{'silent':>8}{'silent > 3':>12}"
              f"{'worst z':>9}{'median z':>9}")  # fmt: skip
        for fact, what in FACTS.items():
            if options.only and not any(word in fact for word in options.only):
                continue
            for in_view in [kind for kind in what.targets if kind in kinds]:
                jobs = [(fact, in_view, seed, keep) for seed in seeds]
                value = list(pool.map(outcome, *zip(*jobs, strict=True)))
                print_outcomes(f"{fact}, {in_view}", value)
                if options.tell:
                    for seed, one in zip(seeds, value, strict=True):
                        print(f"    {seed}: {one.what} {one.z:.2f} {one.message}")
    print(f"{time.perf_counter() - begin:.0f} s")


def print_outcomes(name: str, results: list[Outcome]) -> None:
    """One line."""
    counts = [sum(one.what == word for one in results) for word in
              ("named", "refused", "warned", "silent")]  # fmt: skip
    far = sum(one.what in ("silent", "warned") and one.z > FAR for one in results)
    z = np.array([one.z for one in results if one.what in ("silent", "warned", "named")])
    z = z[np.isfinite(z)]
    worst, median = (f"{f(z):9.2f}" if z.size else f"{'–':>9}" for f in (np.max, np.median))
    print(f"{name:40}{counts[0]:8}{counts[1]:9}{counts[2]:8}{counts[3]:8}{far:12}{worst}{median}",
          flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
