"""A study's setting whose runs are their own random numbers.

In a file of its own, because each process of a study imports the module of its setting, and a test
file imports most of pkmcal.
"""

from __future__ import annotations

import os
import time

from pkmcal.errors import InputError
from pkmcal.studies import tasks
from pkmcal.studies.tasks import Batch, Population, Sample

COUNT_KEY = ("count",)
"""Key of its one estimate."""


class Counting:
    """A setting whose runs are their own random numbers."""

    doing = "Counting"
    quantities = {"x": tasks.Quantity("mean")}  # noqa: RUF012 - a test's

    def __init__(self, fails: str = "", takes: float = 0.0, ballast: int = 0) -> None:
        self.fails, self.takes, self.ballast = fails, takes, bytes(ballast)

    def populations(self, runs):
        return [Population("numbers", runs, 5)]

    def draw(self, batch: Batch):
        if self.fails == "input":
            raise InputError("nothing to count")
        if self.fails == "dies":
            os._exit(9)
        return batch.generator(0).random(batch.runs)

    def solve(self, batch, data):
        return {COUNT_KEY: data}

    def judge(self, batch, data, value):
        time.sleep(self.takes)
        return {COUNT_KEY: Sample({"x": value[COUNT_KEY]})}
