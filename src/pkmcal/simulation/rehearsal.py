"""Inputs of the simulated session that rehearses a plan (``pkmcal plan``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import ConfigDict, Field

from pkmcal.boards.board import Board, board_from_document
from pkmcal.cameras import Camera
from pkmcal.cameras.files import camera_from_document
from pkmcal.errors import InputError
from pkmcal.files import Document, Schema, read_json, validated_document
from pkmcal.geometry.rigid import inverse
from pkmcal.mechanisms import Machine, MechanismDocument, checked_machine
from pkmcal.placement.stations import StationPose
from pkmcal.simulation.truth import RequestedConfigurations

PLAN_FILE = "plan.json"


class _Part(Schema):
    """Part of the plan's document; fields that the rehearsal does not need are ignored."""

    model_config = ConfigDict(extra="ignore")


class _Configuration(_Part):
    name: str
    stations: tuple[str, ...]
    joints: tuple[float, ...]


_Row = tuple[float, float, float, float]


class _Station(_Part):
    name: str
    T_base_camera: tuple[_Row, _Row, _Row, _Row]
    camera: dict[str, Any]
    observe: tuple[Literal["legs", "board"], ...]


class _Plan(_Part):
    pkmcal_plan: Literal[1] = Field(description="the file's version, 1")
    mechanism: MechanismDocument
    configurations: tuple[_Configuration, ...]
    stations: tuple[_Station, ...] = Field(min_length=1, description="the plan's cameras")
    board: dict[str, Any] | None = None
    joint_noise: float
    handheld: bool


class Rehearsal(NamedTuple):
    """Planned machine, cameras and their poses, configurations, and the board, if any.

    observe : what the cameras observe. joint_noise : standard deviation of a reading, m or rad.
    handheld : whether each image is from a place of its own.
    """

    machine: Machine
    cameras: tuple[Camera, ...]
    places: tuple[StationPose, ...]
    requested: RequestedConfigurations
    board: Board | None
    observe: tuple[str, ...]
    joint_noise: float
    handheld: bool


def rehearsal_of(plan: Path | str) -> Rehearsal:
    """Rehearsal of a plan.

    plan : the plan's folder, or its plan.json. Raises InputError if there is no plan, or if its
    readings do not fit its machine.
    """
    path = Path(plan) / PLAN_FILE if Path(plan).is_dir() else Path(plan)
    if not path.is_file():
        raise InputError(
            "there is no plan here",
            where=str(plan),
            expected=f"a folder that pkmcal plan wrote, or its {PLAN_FILE}",
        )
    document = read_json(path, label=str(path))
    results = validated_document(document, _Plan)
    number = {station.name: k for k, station in enumerate(results.stations)}
    pairs = [
        (number[name], k)
        for k, one in enumerate(results.configurations)
        for name in one.stations
        if name in number
    ]
    machine = checked_machine(results.mechanism, document, "mechanism")
    if any(len(one.joints) != machine.n_joints for one in results.configurations):
        raise InputError(
            "the plan's readings are not those of its machine",
            where=f"{path}, configurations",
            expected=f"{machine.n_joints} a configuration",
        )
    joints = np.array([one.joints for one in results.configurations])
    return Rehearsal(
        machine,
        tuple(camera_from_document(_inside(document, s.camera)) for s in results.stations),
        tuple(StationPose.of(inverse(np.array(s.T_base_camera))) for s in results.stations),
        RequestedConfigurations(
            tuple(one.name for one in results.configurations),
            joints,
            tuple(number),
            np.array(pairs, dtype=int).reshape(-1, 2),
        ),
        None if results.board is None else board_from_document(_inside(document, results.board)),
        tuple(dict.fromkeys(word for station in results.stations for word in station.observe)),
        results.joint_noise,
        results.handheld,
    )


def _inside(document: Document, data: dict[str, Any]) -> Document:
    return Document(document.path, document.label, data, {})
