"""Time and allocations of one sample of the control loop.

    OPENBLAS_NUM_THREADS=1 python benchmarks/loop.py [CALLS]

One core. Processor time, with wall time beside it. The machine is the Gough-Stewart platform with
all six legs visible, the image 640x480 and rendered.
"""

from __future__ import annotations

import sys
import time
import tracemalloc
from collections.abc import Callable
from functools import partial
from itertools import cycle

import cv2
import numpy as np

from pkmcal.arrays import Integers
from pkmcal.cameras import Camera
from pkmcal.control.loop import VisualServo
from pkmcal.control.machine_view import true_edges
from pkmcal.geometry.rigid import perturb
from pkmcal.mechanisms import load_mechanism
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.simulation.session import Studio
from pkmcal.simulation.truth import Settings, Truth, draw_truth

CALLS = 1000


def timed(call: Callable[[], object], calls: int) -> tuple[np.ndarray, np.ndarray]:
    """Processor's and wall clock's times of each call, ms."""
    out = np.empty((calls, 2))
    for k in range(calls):
        begin, wall = time.thread_time(), time.perf_counter()
        call()
        out[k] = time.thread_time() - begin, time.perf_counter() - wall
    return out[:, 0] * 1e3, out[:, 1] * 1e3


def allocated(call: Callable[[], object]) -> tuple[float, float]:
    """Peak during a call and what is left after a hundred more, KB."""
    call()
    tracemalloc.start()
    call()
    before = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    call()
    peak = tracemalloc.get_traced_memory()[1] - before
    for _ in range(100):
        call()
    remainder = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    return peak / 1024, remainder / 1024


def print_time(name: str, call: Callable[[], object], calls: int) -> None:
    begin = time.thread_time()
    call()
    first = 1e3 * (time.thread_time() - begin)
    own, wall = timed(call, calls)
    peak, remainder = allocated(call)
    columns = (*np.quantile(own, [0, 0.5, 0.99, 1]), np.median(wall), first, peak, remainder)
    print(f"{name:34}" + "".join(f"{value:9.2f}" for value in columns))


def imaged() -> tuple[Truth, Camera, Integers]:
    """The truth of a session with one image, its camera, and the image."""
    camera = camera_of_size((640, 480))
    settings = Settings(stations=1, configurations=1, tolerance=0.0, extreme=0.0)
    truth = draw_truth(load_mechanism("gough-stewart"), (camera,), settings, 5)
    return truth, camera, Studio.of(truth, (camera,), settings).images(0)[0]


def main() -> None:
    """Print a table of the kinds of samples."""
    cv2.setNumThreads(1)
    calls = int(sys.argv[1]) if len(sys.argv) > 1 else CALLS
    truth, camera, image = imaged()
    machine, T = truth.machine, truth.T_camera_base[0]
    pose, readings = truth.T_base_platform[0], truth.readings[0]
    goal = perturb(machine.home(), np.array([0.02, -0.03, 0.05, 0.01, 0.005, 0.0]))
    heads = ("least", "median", "99 %", "worst", "wall", "first", "peak KB", "left KB")
    print(f"{f'{calls} calls, ms of one core':34}" + "".join(f"{head:>9}" for head in heads))
    for law in ("edges", "directions"):
        servo = VisualServo(machine, camera, T, goal, law=law, start=pose)
        edges = true_edges(servo.view, pose)
        print_time(f"{law}: from edges", partial(servo.step_edges, edges, readings), calls)
        less = edges.copy()
        less[1] = np.nan
        print_time(
            f"{law}: from edges, a leg lost", partial(servo.step_edges, less, readings), calls
        )
        servo.reset(pose)
        print_time(f"{law}: from an image", partial(servo.step_image, image, readings), calls)
    covered = np.full_like(image, 90)
    servo.reset(pose)
    pictures = cycle([image, covered])
    print_time(
        "every other image covered", lambda: servo.step_image(next(pictures), readings), calls
    )


if __name__ == "__main__":
    main()
