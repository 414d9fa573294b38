"""Observation beside the obvious baseline: decoding the images and cv2.Canny.

    python benchmarks/observe.py [SESSION]

Without a session, one is simulated. Each part runs a few times, and the best time counts, in one
process, so that the ratio is meaningful on any machine.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path


def best_of(run: Callable[[], float], times: int = 3) -> float:
    """Smallest of several results, s."""
    return min(run() for _ in range(times))


def decode_and_canny(paths: list[Path]) -> float:
    """Seconds to decode the images one after the other and find Canny's edges in each."""
    import cv2

    begin = time.perf_counter()
    for path in paths:
        cv2.Canny(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), 50, 150)
    return time.perf_counter() - begin


def main() -> None:
    """Print the ratio, the parts of a calibration, and the memory used."""
    begin = time.perf_counter()
    from pkmcal.calibration.calibrate import calibrate_session
    from pkmcal.report.calibration import outcome_of
    from pkmcal.session.load import load_session
    from pkmcal.web.report_page import report_page

    start_up = time.perf_counter() - begin
    with tempfile.TemporaryDirectory() as folder:
        source = Path(sys.argv[1]) if len(sys.argv) > 1 else simulated(Path(folder) / "session")
        session = load_session(source)
        first = calibrate_session(session)
        runs = [calibrate_session(session).timings for _ in range(3)]
        parts = {name: min(run[name] for run in runs) for name in runs[0]}
        begin = time.perf_counter()
        report_page(outcome_of(first))
        parts["report"] = time.perf_counter() - begin
        paths = [p.path for s in session.stations for p in s.images]
        plain = best_of(lambda: decode_and_canny(paths))
    observation = parts["decode"] + parts["observe"]
    print(f"{len(paths)} images")
    print(f"start-up (imports)          {start_up:6.2f} s")
    for name, seconds in parts.items():
        print(f"{name:27} {seconds:6.2f} s")
    print(f"decoding and cv2.Canny      {plain:6.2f} s")
    print(f"observation / that          {observation / plain:6.2f}")
    print(f"largest memory              {peak_memory():6.0f} MB")


def simulated(folder: Path) -> Path:
    """A session of 45 images, 1024x768."""
    from pkmcal.mechanisms import load_mechanism
    from pkmcal.placement.default_camera import default_camera
    from pkmcal.simulation.session import Settings, simulate_session

    simulate_session(folder, load_mechanism("gough-stewart"), default_camera(), Settings(), seed=1)
    return folder


def peak_memory() -> float:
    """Largest resident memory of this process so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
