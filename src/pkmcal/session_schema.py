"""The form of session.yaml; what it means, and whether it holds together, is `session`'s."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from pkmcal.files import Schema, closest, shown

Body = Literal["base", "platform"]
"""What a board may be fixed to."""
Vector = tuple[float, float, float]
WORDS = ("legs", "board")
"""What a station can observe, in the order in which it is written back."""


class JointsDocument(Schema):
    """``joints``: where the readings are, and how good."""

    file: str = Field(description="the readings' file, for example joints.csv")
    noise: Annotated[float, Field(gt=0)] = Field(
        description="the standard deviation of a reading in metres or radians, such as 3.0e-6"
    )


class PoseDocument(Schema):
    """``pose``: a rough camera pose, by hand, in metres in the base frame."""

    position: Vector = Field(description="the camera's place in the base frame, [x, y, z] in m")
    look_at: Vector = Field(description="a point in the image's middle, base frame, [x, y, z] in m")
    up: Vector = (0.0, 0.0, 1.0)


def _words(value: Any) -> tuple[str, ...]:
    """``legs``, ``board`` or a list of them, as a tuple without order."""
    words: list[Any] = value if isinstance(value, list) else [value]
    if not words:
        raise ValueError("the list is empty; a station observes legs, board, or [legs, board]")
    for word in words:
        if word not in WORDS:
            guess = closest(word, WORDS) if isinstance(word, str) else None
            wanted = guess or "legs, board, or [legs, board]"
            raise ValueError(f"no station can observe this; found {shown(word)}, expected {wanted}")
    if len(set(words)) < len(words):
        raise ValueError(f"the same word stands twice; found {shown(words)}")
    return tuple(word for word in WORDS if word in words)


class StationDocument(Schema):
    """One entry of ``stations``."""

    camera: str = Field(description="the camera's file, for example cameras/front.yaml")
    images: str = Field(description="a pattern such as images/front/{configuration}.png")
    observe: Annotated[tuple[str, ...], BeforeValidator(_words)] = Field(
        description="legs, board, or [legs, board]"
    )
    pose: PoseDocument | None = None


class BoardDocument(Schema):
    """``board``: its file, and what it is fixed to."""

    file: str = Field(description="the board's file, for example board.yaml")
    fixed_to: Body = "platform"


def _board(value: Any) -> Any:
    """A file alone stands for a board on the platform."""
    return {"file": value} if isinstance(value, str) else value


class SessionDocument(Schema):
    """The whole of session.yaml."""

    pkmcal: Literal[1] = Field(description="the line pkmcal: 1, the format's version")
    mechanism: str = Field(description="a mechanism's file, or a built-in's name")
    joints: JointsDocument = Field(description="file and noise of the joint readings")
    stations: Annotated[dict[str, StationDocument], Field(min_length=1)] = Field(
        description="one entry a camera in one place"
    )
    board: Annotated[BoardDocument | None, BeforeValidator(_board)] = None

    def observers(self, word: str) -> list[str]:
        """Names of the stations that observe legs, or the board."""
        return [name for name, station in self.stations.items() if word in station.observe]
