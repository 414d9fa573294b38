"""A carrier that no export knows, in one Python file: C and MuJoCo follow from its members.

Its module is in a temporary folder and is named in the environment, as a user's own would be; so
the commands run as programs of their own.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import pkmcal
from mujoco_machines import Simulated
from pkmcal.exporters.c import numbers_of

COMPILER = shutil.which("gcc") or shutil.which("cc")
CARRIER = '''
"""An arm about a pivot, a ramp between two points, and a post on the platform."""

from typing import ClassVar, Literal

import numpy as np

from pkmcal.files import Schema
from pkmcal.geometry.rigid import cross, dot
from pkmcal.mechanisms.carriers.contract import (
    BaseCarrier, Chain, Direction, Stroke, PlatformCarrier, vectors,
)

Point = tuple[float, float, float]


class RockerDocument(Schema):
    joint: Literal["rocker"]
    center: Point
    pivot: Point
    axis: Direction
    motor: int | None = None
    range: Stroke | None = None


class RampDocument(Schema):
    joint: Literal["ramp"]
    center: Point
    top: Point
    motor: int | None = None
    range: Stroke | None = None


class PostDocument(Schema):
    joint: Literal["post"]
    center: Point
    post: Point


def unit(v):
    return v / np.sqrt(dot(v, v))[..., None]


class Rocker(BaseCarrier):
    driven: ClassVar = True
    unit: ClassVar = "rad"
    joints: ClassVar = ("rocker",)
    schema: ClassVar = RockerDocument
    shared: ClassVar = ("pivot", "axis")
    parameters: ClassVar = (
        *vectors("center", "m", "center"),
        *vectors("pivot", "m", "center"),
        *vectors("axis", "1", "axis"),
    )

    @staticmethod
    def place(parameters, readings):
        center, pivot, v = parameters[..., :3], parameters[..., 3:6], unit(parameters[..., 6:])
        high = dot(center - pivot, v)[..., None] * v
        arm = center - pivot - high
        c, s = np.cos(readings)[..., None], np.sin(readings)[..., None]
        side = cross(v, arm)
        return pivot + high + c * arm + s * side, c * side - s * arm

    @staticmethod
    def reading(parameters, point_b, length, near):
        center, pivot, v = parameters[..., :3], parameters[..., 3:6], unit(parameters[..., 6:])
        foot = pivot + dot(center - pivot, v)[..., None] * v
        arm, d = center - foot, point_b - foot
        p, s = dot(d, arm), dot(d, cross(v, arm))
        half = np.arccos((dot(d, d) + dot(arm, arm) - length**2) / 2 / np.hypot(p, s))
        both = np.arctan2(s, p) + np.stack([half, -half])
        both = near + (both - near + np.pi) % (2 * np.pi) - np.pi
        return np.where(np.abs(both[0] - near) < np.abs(both[1] - near), both[0], both[1])

    @staticmethod
    def chain(parameters):
        center, pivot = parameters[..., :3], parameters[..., 3:6]
        return Chain("turn", pivot, unit(parameters[..., 6:]), center - pivot)


class Ramp(BaseCarrier):
    driven: ClassVar = True
    joints: ClassVar = ("ramp",)
    schema: ClassVar = RampDocument
    parameters: ClassVar = (*vectors("center", "m", "center"), *vectors("top", "m", "center"))

    @staticmethod
    def place(parameters, readings):
        center, v = parameters[..., :3], unit(parameters[..., 3:] - parameters[..., :3])
        return center + readings[..., None] * v, v

    @staticmethod
    def reading(parameters, point_b, length, near):
        center, v = parameters[..., :3], unit(parameters[..., 3:] - parameters[..., :3])
        d = point_b - center
        half = np.sqrt(length**2 - dot(d, d) + dot(d, v) ** 2)
        both = dot(d, v) + np.stack([half, -half])
        return np.where(np.abs(both[0] - near) < np.abs(both[1] - near), both[0], both[1])

    @staticmethod
    def chain(parameters):
        center, v = parameters[..., :3], unit(parameters[..., 3:] - parameters[..., :3])
        return Chain("slide", center, v, np.zeros_like(center))


class Post(PlatformCarrier):
    joints: ClassVar = ("post",)
    schema: ClassVar = PostDocument
    ways: ClassVar = ("post",)
    parameters: ClassVar = (*vectors("center", "m", "center"), *vectors("post", "m", "center"))

    @staticmethod
    def place(parameters, T_base_platform, internal=None):
        own = parameters[..., :3] + parameters[..., 3:]
        arm = (T_base_platform[..., :3, :3] @ own[..., None])[..., 0]
        return arm + T_base_platform[..., :3, 3], arm

    @staticmethod
    def chain(parameters):
        none = np.zeros_like(parameters[..., :3])
        return Chain("fixed", parameters[..., :3], none, parameters[..., 3:])
'''
MACHINE = """
name: mixed
motion: translation
legs:
  - base: {joint: rocker, center: [0.01, 0.185, 0.003], pivot: [0.03, 0.085, 0],
      axis: [-1, 0.02, 0.01], range: [-0.4, 1.2]}
    platform: {joint: spherical, center: [0, 0.035, 0]}
    length: {actuated: false, constant: 0.22}
  - base: {joint: crank, center: [-0.0736, -0.0425, 0], axis: [0.5, -0.8660254038, 0], arm: 0.1,
      range: [-0.4, 1.2]}
    platform: {joint: post, center: [-0.0303, -0.0175, -0.02], post: [0, 0, 0.02]}
    length: {actuated: false, constant: 0.22}
  - base: {joint: ramp, center: [0.2, -0.12, 0.05], top: [0.11, -0.06, -0.18], range: [0.0, 0.2]}
    platform: {joint: spherical, center: [0.0303, -0.0175, 0]}
    length: {actuated: false, constant: 0.22}
home: {position: [0.0, 0.0, -0.2]}
"""


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The files of a format for a machine with the new carriers, by their names."""
    folder = tmp_path_factory.mktemp("carrier")
    (folder / "my_carriers.py").write_text(CARRIER)
    (folder / "mixed.yaml").write_text(MACHINE)
    paths = (str(Path(pkmcal.__file__).parents[1]), str(folder))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    environment["PKMCAL_CARRIERS"] = "my_carriers"

    @cache
    def of(name):
        words = ("export", str(folder / "mixed.yaml"), "--to", name, "-o", str(folder / name))
        done = subprocess.run(
            [sys.executable, "-m", "pkmcal", *words],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return folder / name

    return of


@pytest.mark.skipif(COMPILER is None, reason="NO C COMPILER (gcc or cc)")
def test_c_of_a_new_carrier(exported, tmp_path):
    """The self-test holds the compiled source against our kinematics."""
    sources = sorted(map(str, exported("c").glob("*.c")))
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    program = tmp_path / "selftest"
    subprocess.run([COMPILER, *flags, *sources, "-o", program, "-lm"], check=True)
    done = subprocess.run([program], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert "PASS: 12 reference poses of mixed" in done.stdout
    text = (exported("c") / "pkmcal_kinematics.c").read_text()
    assert [text.count(f"{drive}, /* drive */") for drive in ("TURN", "SLIDE")] == [2, 1]


def test_mujoco_of_a_new_carrier(exported):
    """MuJoCo's forward kinematics at the reference readings of the C self-test."""
    simulated = Simulated((exported("mujoco") / "mixed.xml").read_text(encoding="utf-8"))
    pairs = (exported("c") / "pkmcal_selftest.c").read_text()
    readings = numbers_of(pairs, "READINGS").reshape(-1, 3)
    places = numbers_of(pairs, "POSES").reshape(-1, 12)[:, 9:]
    for q, place in zip(readings[:4], places[:4], strict=True):
        simulated.home()
        np.testing.assert_allclose(simulated.drive(q)[:3, 3], place, atol=1e-12)
        assert np.abs(simulated.closure()[0]).max() < 1e-12
