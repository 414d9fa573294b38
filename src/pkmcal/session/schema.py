"""Schema of session.yaml; consistency across fields and files is checked by `session.load`."""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Discriminator, Field, Tag, create_model

from pkmcal.cameras.response import Response
from pkmcal.files import (
    MOST_STATIONS,
    FieldError,
    Metres,
    Point,
    Radians,
    Reading,
    Schema,
    closest,
    quoted,
)
from pkmcal.measurements.contract import NOISE_FIELD_RANGE, LinkKind, kinds_of

BoardBody = Literal["base", "platform"]
"""Bodies to which a board can be fixed."""
Vector = tuple[float, float, float]
OBSERVE_WORDS = ("legs", "board")
OBSERVE_EXPECTED = "legs, board, or [legs, board]"
"""Objects that a station can observe, in the order of output."""


class JointsDocument(Schema):
    """Entry ``joints``: file and noise of the readings."""

    file: str = Field(description="the readings' file, for example joints.csv")
    noise: Annotated[Reading, NOISE_FIELD_RANGE] = Field(
        description="the standard deviation of a reading in metres or radians, such as 3.0e-6"
    )


class PoseDocument(Schema):
    """Entry ``pose``: rough camera pose in the base frame, m."""

    position: Point = Field(description="the camera's place in the base frame, [x, y, z] in m")
    look_at: Point = Field(description="a point in the image's middle, base frame, [x, y, z] in m")
    up: Vector = (0.0, 0.0, 1.0)


def _observe_words(value: Any) -> tuple[str, ...]:
    """Normalise ``observe``: one word or a list, as a tuple in the order of OBSERVE_WORDS."""
    words: list[Any] = value if isinstance(value, list) else [value]
    if not words:
        raise FieldError("the list is empty", found="[]", expected=OBSERVE_EXPECTED)
    for word in words:
        if word not in OBSERVE_WORDS:
            guess = closest(word, OBSERVE_WORDS) if isinstance(word, str) else None
            raise FieldError(
                "no station can observe this",
                found=quoted(word),
                expected=guess or OBSERVE_EXPECTED,
            )
    if len(set(words)) < len(words):
        raise FieldError(
            "the same word stands twice", found=quoted(words), expected=OBSERVE_EXPECTED
        )
    return tuple(word for word in OBSERVE_WORDS if word in words)


class StationDocument(Schema):
    """Entry of ``stations``: a camera at one place, or hand-held at one place for each image."""

    camera: str = Field(description="the camera's file, for example cameras/front.yaml, or exif")
    images: str = Field(description="a pattern such as images/front/{configuration}.png")
    observe: Annotated[tuple[str, ...], BeforeValidator(_observe_words)] = Field(
        description="legs, board, or [legs, board]"
    )
    pose: PoseDocument | None = None
    handheld: bool = False
    poses: dict[str, PoseDocument] = Field(
        default_factory=dict[str, PoseDocument],
        description="rough poses of single hand-held images, by configuration and repeat such as"
        " 0003-2",
    )
    response: Response | None = Field(
        default=None,
        description="how the images code light: linear, as sensors count it, or srgb, as"
        " telephones write it; found out where it is left out",
    )


class NoiseDocument(Schema):
    """Entry ``noise`` of a tracker: standard deviations."""

    position: Annotated[Metres, NOISE_FIELD_RANGE] | None = Field(
        default=None, description="the standard deviation of a coordinate in metres, such as 2.0e-5"
    )
    rotation: Annotated[Radians, NOISE_FIELD_RANGE] | None = Field(
        default=None, description="the standard deviation of a turn in radians, such as 1.0e-4"
    )


class TrackerDocument(Schema):
    """Entry ``tracker``: a laser tracker, a measuring machine or a probe instead of a camera."""

    poses: str = Field(description="the table of what it measured, for example poses.csv")
    noise: NoiseDocument = Field(
        default_factory=NoiseDocument, description="noise: {position: 2.0e-5, rotation: 1.0e-4}"
    )
    level: bool = False


class TrackerStationDocument(Schema):
    """Entry of ``stations`` with a tracker at one place."""

    tracker: TrackerDocument


def _station_tag(value: Any) -> str:
    """Tag of an entry of ``stations``: with a tracker or with a camera."""
    tracker = "tracker" in value if isinstance(value, dict) else hasattr(value, "tracker")
    return "with a tracker" if tracker else "with a camera"


AnyStation = Annotated[
    Annotated[StationDocument, Tag("with a camera")]
    | Annotated[TrackerStationDocument, Tag("with a tracker")],
    Discriminator(_station_tag),
]


class BoardDocument(Schema):
    """Entry ``board``: its file, and the body it is fixed to."""

    file: str = Field(description="the board's file, for example board.yaml")
    fixed_to: BoardBody = "platform"


def _board_entry(value: Any) -> Any:
    """Normalise ``board``: a file name alone means a board on the platform."""
    return {"file": value} if isinstance(value, str) else value


class WorkspaceDocument(Schema):
    """Entry ``workspace``: region in which the tool must be accurate."""

    x: tuple[Metres, Metres] | None = Field(default=None, description="[lowest, highest] x in m")
    y: tuple[Metres, Metres] | None = Field(default=None, description="[lowest, highest] y in m")
    z: tuple[Metres, Metres] | None = Field(default=None, description="[lowest, highest] z in m")
    turn: Radians | None = Field(
        default=None, description="how far the platform turns from home in rad, such as 0.26"
    )


class SessionDocument(Schema):
    """session.yaml without the keys of kinds of measurement; see :func:`session_schema`."""

    pkmcal: Literal[1] = Field(description="the line pkmcal: 1, the format's version")
    mechanism: str = Field(description="a mechanism's file, or a built-in's name")
    joints: JointsDocument = Field(description="file and noise of the joint readings")
    stations: dict[str, AnyStation] = Field(
        default_factory=dict,
        max_length=MOST_STATIONS,
        description="one entry a camera, or a tracker, in one place",
    )
    board: Annotated[BoardDocument | None, BeforeValidator(_board_entry)] = None
    paths: dict[str, list[str]] | None = Field(
        default=None, description="straight paths by configurations, paths: {line: [c01, c02, c03]}"
    )
    workspace: WorkspaceDocument | None = None
    notes: str | None = Field(default=None, description="your own words, as text")

    def observers(self, word: str) -> list[str]:
        """Names of the stations that observe ``word``, legs or board."""
        return [name for name, station in self.cameras.items() if word in station.observe]

    @property
    def cameras(self) -> dict[str, StationDocument]:
        """Stations with a camera."""
        return {k: s for k, s in self.stations.items() if isinstance(s, StationDocument)}

    @property
    def trackers(self) -> dict[str, TrackerStationDocument]:
        """Stations with a tracker."""
        return {k: s for k, s in self.stations.items() if isinstance(s, TrackerStationDocument)}

    def links(self) -> dict[str, Schema]:
        """Entries of measurements that depend on two configurations, by kind, if present."""
        nodes = {code: getattr(self, kind.key, None) for code, kind in kinds_of(LinkKind).items()}
        return {code: node for code, node in nodes.items() if node is not None}


@cache
def session_schema() -> type[SessionDocument]:
    """Schema of the whole session.yaml, with the keys of all kinds of measurement."""
    fields: dict[str, Any] = {
        kind.key: (kind.schema | None, None) for kind in kinds_of(LinkKind).values()
    }
    return create_model("SessionDocument", __base__=SessionDocument, **fields)
