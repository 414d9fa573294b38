"""Photographs that are upside down against their camera's file, told by their edges.

A program that turns photographs by half shows the machine as well as before, from a station that is
turned, too, and no look at them tells. But the camera's centre is then on the other side of the
picture's middle, which no place of the camera makes up for. So the way from a camera to the same
one turned is a departure of one number (:mod:`pkmcal.identify.score`), whose fit is 0 where the
file is right and 1 where the photographs are upside down. Where the edges are sure of that, these
are measured by the camera turned by half.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.calibration.gather import edges_by_camera
from pkmcal.calibration.turns import Turns
from pkmcal.cameras import Camera
from pkmcal.identify.bundle import as_ended
from pkmcal.identify.score import Departures
from pkmcal.measurements import Effect
from pkmcal.session.load import Session
from pkmcal.wording import listed

ODDS_FOR_UPSIDE_DOWN = 1000.0
"""Odds from which the edges overrule the file."""
MOST_FROM_TURNED = 0.5
"""Share of the way by which what fits may be off its end: else neither is the photographs' camera,
though one may be nearer."""


@dataclass(frozen=True)
class UpsideDown:
    """A camera's file against which photographs are upside down. entries : of session.yaml's
    stations. camera : the one that took them, as they are.
    """

    file: str
    entries: tuple[str, ...]
    camera: Camera

    @property
    def sentence(self) -> str:
        """A hint for the verdict."""
        fields = self.camera.document()
        wanted = [f"center: {_numbers(fields['center'])}"]
        if np.any(fields["distortion"]):
            wanted.append(f"distortion: {_numbers(fields['distortion'])}")
        return (
            f"The photographs of {listed(self.entries)} are upside down against {self.file}: so say"
            f" their edges, at odds of more than {ODDS_FOR_UPSIDE_DOWN:.0f} to 1. They are measured"
            f" so; turn them by half, or write {' and '.join(wanted)} in that file, and every"
            " command knows it."
        )


def _numbers(values: list[float]) -> str:
    return f"[{', '.join(f'{value:.6g}' for value in values)}]"


def upside_down(session: Session, turns: Turns) -> tuple[UpsideDown, ...]:
    """The cameras against whose files the photographs are upside down; none of those that are
    estimated with the machine.
    """
    if turns.cameras.active or not len(turns.measurements.edges):
        return ()
    measured = turns.measurements
    cameras = {station.camera_file: station.camera for station in session.stations}
    every = [station.camera for station in session.stations]
    edges = edges_by_camera(turns.observation, every)
    files = np.array([station.camera_file for station in session.stations])
    effects = list[Effect]()
    for file, camera in cameras.items():
        way = camera.turned_by_half().parameters - camera.parameters
        mine = (files[measured.edges.station] == file)[:, None, None]
        effects.append(Effect(edges=np.where(mine, edges[..., : len(way)] @ way[:, None], 0.0)))
    tests = Departures(*as_ended(measured, turns.estimate), effects)
    out = list[UpsideDown]()
    for number, (file, camera) in enumerate(cameras.items()):
        (fit,) = tests.fitted([number])
        value, sigma = float(fit.value[0]), float(fit.sigma[0])
        sure = (2 * value - 1) / sigma**2 > 2 * np.log(ODDS_FOR_UPSIDE_DOWN)
        if sure and abs(value - 1) < MOST_FROM_TURNED:
            own = [station.entry for station in session.stations if station.camera_file == file]
            out.append(UpsideDown(file, tuple(dict.fromkeys(own)), camera.turned_by_half()))
    return tuple(out)


def turned_round(session: Session, found: tuple[UpsideDown, ...]) -> Session:
    """The session with the cameras that took its photographs."""
    cameras = {one.file: one.camera for one in found}
    stations = tuple(
        replace(station, camera=cameras.get(station.camera_file, station.camera))
        for station in session.stations
    )
    return replace(session, stations=stations)
