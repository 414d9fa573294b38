"""Document of a session's page, with the page's requests and the program's answers.

Pixels are the camera's, with centres at integers, as in the block of images. Poses are
T_camera_base, m.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pkmcal.files import Schema
from pkmcal.outcome.blocks.base import Pose, Text
from pkmcal.outcome.blocks.images import Image, Layer, Pixel
from pkmcal.outcome.blocks.machine import Property
from pkmcal.outcome.finding import Mark

JointEnd = Literal["base", "platform"]
MachineChoice = Literal["nominal", "calibration"]
"""Overlaid machine: the nominal one at the session's poses, or the calibrated one."""


class SessionStation(Schema):
    """Station with its images.

    legs : whether it can be localized by the legs in its images.
    handheld : a single image by hand.
    posed : whether session.yaml has its pose.
    images : without overlays, which the page requests.
    """

    name: Text
    legs: bool
    handheld: bool
    posed: bool
    images: tuple[Image, ...]


class Pin(Schema):
    """What a person says of a pixel of an image: a leg's joint is there, or the leg itself.

    image : index in the station.
    end : which joint; axis for any place along the leg.
    leg : from 1.
    """

    image: int
    end: JointEnd | Literal["axis"]
    leg: int = Field(ge=1)
    pixel: Pixel


class Gesture(Schema):
    """Drag from one pixel to another, or a change of the distance about a pixel.

    factor : ratio of the new distance to the old one.
    """

    kind: Literal["aim", "turn", "roll", "distance"]
    start: Pixel
    end: Pixel
    factor: float = Field(default=1.0, gt=0.01, lt=100)


class ViewRequest(Schema):
    """Request about an image with the machine to overlay.

    station, image : indices.
    pose : None for the pose of the files.
    anywhere : search the pose globally rather than near the given one.
    """

    station: int
    image: int
    machine: MachineChoice = "nominal"
    pose: Pose | None = None
    gesture: Gesture | None = None
    pins: tuple[Pin, ...] = ()
    anywhere: bool = False


class JointPixel(Schema):
    """Joint of the overlaid machine in the image; leg : from 1."""

    leg: int
    end: JointEnd
    at: Pixel


class OverlayAnswer(Schema):
    """Overlaid machine after the request's gesture and pins.

    place : the pose as session.yaml has it.
    layers : the machine and its joints.
    """

    pose: Pose
    place: tuple[Property, ...]
    layers: tuple[Layer, ...]
    joints: tuple[JointPixel, ...]


class LegCount(Schema):
    """Numbers of a leg's edges; leg : from 1. predicted : within the image."""

    leg: int
    measured: int
    predicted: int


class EdgesAnswer(Schema):
    """Measurements in one image against the overlaid machine.

    mark : whether the image fits; null where nothing can be compared.
    texts : sentences on the agreement.
    reasons : sentences on the edges that were not measured.
    median : median offset of the edges, px; null without any.
    layers : measured and missing edges, and corners of a board.
    """

    mark: Mark | None
    texts: tuple[Text, ...]
    legs: tuple[LegCount, ...]
    reasons: tuple[Text, ...]
    median: float | None
    layers: tuple[Layer, ...]


class LocalizationAnswer(Schema):
    """Result of a localization: the overlay at the pose, which is unchanged without success.

    places : poses between which a person can choose, likeliest first, without success.
    """

    localized: bool
    text: Text
    overlay: OverlayAnswer
    places: tuple[Pose, ...]


class SavedAnswer(Schema):
    """A pose was written into session.yaml."""

    text: Text
