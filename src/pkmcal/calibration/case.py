"""Prior scene of a session, and the case: session, images, boards and prior scene."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from pkmcal.arrays import Array
from pkmcal.boards.views import Boards
from pkmcal.identify.bundle import MarginalPrior
from pkmcal.measurements import EdgeSet
from pkmcal.mechanisms import Machine
from pkmcal.observe.image_batches import StationImages
from pkmcal.outcome.finding import Finding
from pkmcal.session.load import Session


class PriorScene(NamedTuple):
    """Machine, stations and platform poses from which an estimate starts.

    T_camera_base : (S, 4, 4) of the stations, NaN where unknown.
    T_base_platform : (K, 4, 4) of the configurations.
    edges : silhouettes of each localized hand-held image, by station.
    prior : marginal prior of the machine from these edges and the nominal model.
    scatter : ratio of the scatter of silhouettes to their standard deviations as measured; these
        edges are scaled by it.
    findings : notes on poses that could not be tested.
    """

    machine: Machine
    T_camera_base: Array
    T_base_platform: Array
    edges: Mapping[int, EdgeSet] = MappingProxyType({})
    prior: MarginalPrior | None = None
    scatter: float = 1.0
    findings: tuple[Finding, ...] = ()

    @classmethod
    def as_drawn(cls, session: Session, T_camera_base: Array) -> PriorScene:
        """Scene of the nominal model at the session's readings.

        Where the nominal model does not close exactly, the nearest platform pose is used.
        """
        return cls(session.machine, T_camera_base, session.forward.T_base_platform)


class Case(NamedTuple):
    """A session with the images of its stations that observe legs, the boards in all images, and
    the prior scene.
    """

    session: Session
    images: list[StationImages]
    boards: Boards
    scene: PriorScene
