"""How still a platform stands at its goal when the edges are noisy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array
from pkmcal.control.image import Eye
from pkmcal.control.laws import solution, task_of
from pkmcal.control.seen import SeenMachine, directions_of, legs_from_image
from pkmcal.geometry.rigid import dot
from pkmcal.simulate.edges import EdgeNoise

DRAWS = 24
"""Images of each goal; the standard deviation over all goals is then good to a few percent."""


@dataclass(frozen=True)
class Stillness:
    """What one image's noise is, told as the platform's place, root mean squares of the goals.

    joints : (R,) m, over the platform's joints. position : (R,) m of their middle. turn : (R,) rad.
    """

    joints: Array
    position: Array
    turn: Array

    def held(self, step: float, delay: int) -> Stillness:
        """The same in the closed loop."""
        part = loop_factor(step, delay)
        return Stillness(self.joints * part, self.position * part, self.turn * part)


def loop_factor(step: float, delay: int) -> float:
    """Standard deviation of the platform in the loop, as a part of one image's.

    step : gain / rate, what of an error is corrected in a sample. The platform follows
    x(k + 1) = x(k) - step (x(k - delay) + noise); without delay its variance is
    step / (2 - step) of the noise's. inf where the loop is unstable.
    """
    n = delay + 1
    follow = np.eye(n, k=-1)
    follow[0, 0] += 1.0
    follow[0, n - 1] -= step
    if np.abs(np.linalg.eigvals(follow)).max() >= 1:
        return float("inf")
    drive = np.zeros((n, n))
    drive[0, 0] = step**2
    # P = F P F^T + Q, as one linear system
    whole = np.eye(n * n) - np.kron(follow, follow)
    return float(np.sqrt(np.linalg.solve(whole, drive.ravel())[0]))


def one_image(
    eye: Eye,
    believed: SeenMachine,
    law: str,
    goals: Array,
    readings: Array,
    noise: EdgeNoise,
    rng: np.random.Generator,
    draws: int = DRAWS,
) -> Stillness:
    """The platform's apparent displacement at goals (R, 4, 4) by the noise of single images."""
    points = eye.points(goals, readings)
    wanted = eye.normals(points, EdgeNoise(0.0, 0.0), rng)
    squares = np.zeros((3, len(goals)))
    for _ in range(draws):
        measured = eye.normals(points, noise, rng)
        legs = legs_from_image(believed, directions_of(measured), readings)
        task = task_of(law, believed, measured, wanted, legs)
        twist = (task.twist @ solution(task)[..., None])[..., 0]
        arms = legs.b - legs.pivot[..., None, :]
        turned = np.cross(twist[..., None, :3], arms) + twist[..., None, 3:]
        squares[0] += dot(turned, turned).mean(axis=-1)
        squares[1] += dot(twist[..., 3:], twist[..., 3:])
        squares[2] += dot(twist[..., :3], twist[..., :3])
    return Stillness(*np.sqrt(squares / draws))
