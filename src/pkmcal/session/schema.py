"""The form of session.yaml; what it means, and whether it holds together, is `session`'s."""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Discriminator, Field, Tag, create_model

from pkmcal.cameras.response import Response
from pkmcal.files import MOST_STATIONS, Metres, Point, Radians, Reading, Schema, closest, quoted
from pkmcal.measurements.contract import NOISE_FIELD_RANGE, LinkKind, kinds_of

BoardBody = Literal["base", "platform"]
"""What a board may be fixed to."""
Vector = tuple[float, float, float]
OBSERVE_WORDS = ("legs", "board")
"""What a station can observe, in the order in which it is written back."""


class JointsDocument(Schema):
    """``joints``: where the readings are, and how good."""

    file: str = Field(description="the readings' file, for example joints.csv")
    noise: Annotated[Reading, NOISE_FIELD_RANGE] = Field(
        description="the standard deviation of a reading in metres or radians, such as 3.0e-6"
    )


class PoseDocument(Schema):
    """``pose``: a rough camera pose, by hand, in metres in the base frame."""

    position: Point = Field(description="the camera's place in the base frame, [x, y, z] in m")
    look_at: Point = Field(description="a point in the image's middle, base frame, [x, y, z] in m")
    up: Vector = (0.0, 0.0, 1.0)


def _words(value: Any) -> tuple[str, ...]:
    """``legs``, ``board`` or a list of them, as a tuple without order."""
    words: list[Any] = value if isinstance(value, list) else [value]
    if not words:
        raise ValueError("the list is empty; a station observes legs, board, or [legs, board]")
    for word in words:
        if word not in OBSERVE_WORDS:
            guess = closest(word, OBSERVE_WORDS) if isinstance(word, str) else None
            wanted = guess or "legs, board, or [legs, board]"
            raise ValueError(
                f"no station can observe this; found {quoted(word)}, expected {wanted}"
            )
    if len(set(words)) < len(words):
        raise ValueError(f"the same word stands twice; found {quoted(words)}")
    return tuple(word for word in OBSERVE_WORDS if word in words)


class StationDocument(Schema):
    """One entry of ``stations``: a camera in one place, or by hand, one place a photograph."""

    camera: str = Field(description="the camera's file, for example cameras/front.yaml, or exif")
    images: str = Field(description="a pattern such as images/front/{configuration}.png")
    observe: Annotated[tuple[str, ...], BeforeValidator(_words)] = Field(
        description="legs, board, or [legs, board]"
    )
    pose: PoseDocument | None = None
    handheld: bool = False
    response: Response | None = Field(
        default=None,
        description="how the photographs code light: linear, as sensors count it, or srgb, as"
        " telephones write it; found out where it is left out",
    )


class NoiseDocument(Schema):
    """``noise`` of a tracker, one standard deviation."""

    position: Annotated[Metres, NOISE_FIELD_RANGE] = Field(
        description="the standard deviation of a coordinate in metres, such as 2.0e-5"
    )
    rotation: Annotated[Radians, NOISE_FIELD_RANGE] | None = Field(
        default=None, description="the standard deviation of a turn in radians, such as 1.0e-4"
    )


class TrackerDocument(Schema):
    """``tracker``: a laser tracker, a measuring machine or a probe instead of a camera."""

    poses: str = Field(description="the table of what it measured, for example poses.csv")
    noise: NoiseDocument = Field(description="noise: {position: 2.0e-5, rotation: 1.0e-4}")
    level: bool = False


class TrackerStationDocument(Schema):
    """One entry of ``stations``: a tracker in one place."""

    tracker: TrackerDocument


def _station(value: Any) -> str:
    """Which of the two an entry of ``stations`` is."""
    tracker = "tracker" in value if isinstance(value, dict) else hasattr(value, "tracker")
    return "with a tracker" if tracker else "with a camera"


AnyStation = Annotated[
    Annotated[StationDocument, Tag("with a camera")]
    | Annotated[TrackerStationDocument, Tag("with a tracker")],
    Discriminator(_station),
]


class BoardDocument(Schema):
    """``board``: its file, and what it is fixed to."""

    file: str = Field(description="the board's file, for example board.yaml")
    fixed_to: BoardBody = "platform"


def _board(value: Any) -> Any:
    """A file alone stands for a board on the platform."""
    return {"file": value} if isinstance(value, str) else value


class WorkspaceDocument(Schema):
    """``workspace``: where the tool is to be right."""

    x: tuple[Metres, Metres] | None = Field(default=None, description="[lowest, highest] x in m")
    y: tuple[Metres, Metres] | None = Field(default=None, description="[lowest, highest] y in m")
    z: tuple[Metres, Metres] | None = Field(default=None, description="[lowest, highest] z in m")
    turn: Radians | None = Field(
        default=None, description="how far the platform turns from home in rad, such as 0.26"
    )


class SessionDocument(Schema):
    """session.yaml but for the keys of kinds of measurement that have their own; see
    :func:`session_schema`.
    """

    pkmcal: Literal[1] = Field(description="the line pkmcal: 1, the format's version")
    mechanism: str = Field(description="a mechanism's file, or a built-in's name")
    joints: JointsDocument = Field(description="file and noise of the joint readings")
    stations: dict[str, AnyStation] = Field(
        default_factory=dict,
        max_length=MOST_STATIONS,
        description="one entry a camera, or a tracker, in one place",
    )
    board: Annotated[BoardDocument | None, BeforeValidator(_board)] = None
    paths: dict[str, list[str]] | None = Field(
        default=None, description="straight paths by configurations, paths: {line: [c01, c02, c03]}"
    )
    workspace: WorkspaceDocument | None = None
    notes: str | None = Field(default=None, description="your own words, as text")

    def observers(self, word: str) -> list[str]:
        """Names of the stations that observe legs, or the board."""
        return [name for name, station in self.cameras.items() if word in station.observe]

    @property
    def cameras(self) -> dict[str, StationDocument]:
        """The stations with a camera."""
        return {k: s for k, s in self.stations.items() if isinstance(s, StationDocument)}

    @property
    def trackers(self) -> dict[str, TrackerStationDocument]:
        """The stations without one."""
        return {k: s for k, s in self.stations.items() if isinstance(s, TrackerStationDocument)}

    def links(self) -> dict[str, Schema]:
        """What stands under the keys of measurements that link configurations, by their kinds."""
        results = {code: getattr(self, kind.key, None) for code, kind in kinds_of(LinkKind).items()}
        return {code: node for code, node in results.items() if node is not None}


@cache
def session_schema() -> type[SessionDocument]:
    """The whole of session.yaml, with the keys of all kinds of measurement."""
    fields: dict[str, Any] = {
        kind.key: (kind.schema | None, None) for kind in kinds_of(LinkKind).values()
    }
    return create_model("SessionDocument", __base__=SessionDocument, **fields)
