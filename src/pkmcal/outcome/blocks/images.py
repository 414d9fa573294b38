"""Block of images with overlays: shapes in pixels, and rectified strips along measured edges.

Pixels are the camera's, with centres at integers, x to the right and y down in the image as the
camera file describes it. A viewer turns image and overlay together by ``quarter_turns`` to show
the image upright.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from pkmcal.files import Schema
from pkmcal.outcome.blocks.base import Key, Text

Pixel = tuple[float, float]
LayerName = Literal["machine", "edges", "rejected", "joints", "nominal", "corners", "residuals"]


def omitted(default: Any) -> Any:
    """Field that documents omit where it has its default; a page has thousands of shapes."""
    return Field(
        default,
        exclude_if=lambda value: value == default,
        json_schema_extra={"omittedAtDefault": True},
    )


class Polyline(Schema):
    """Curve in an image.

    key : what it belongs to; a leg's key gives the colour.
    tip : tooltip.
    dashed : measured, but not in use.
    strip : index of its strip in the image's ``strips``, absent without one.
    """

    shape: Literal["polyline"] = "polyline"
    points: tuple[Pixel, ...]
    key: Key = omitted("")
    tip: Text = omitted("")
    dashed: bool = omitted(False)
    strip: int | None = omitted(None)


class Ring(Schema):
    """Circle of a fixed size around a pixel.

    label : text beside it, such as a leg's number.
    filled : the joint was placed here by hand.
    """

    shape: Literal["ring"] = "ring"
    at: Pixel
    key: Key = omitted("")
    tip: Text = omitted("")
    dashed: bool = omitted(False)
    label: Text = omitted("")
    filled: bool = omitted(False)


class Cross(Schema):
    """Cross of a fixed size at a pixel."""

    shape: Literal["cross"] = "cross"
    at: Pixel
    key: Key = omitted("")
    tip: Text = omitted("")


class Arrow(Schema):
    """Displacement (px) from a pixel, drawn as many times as long as its layer's enlargement.

    key : what a click leads to.
    dashed : not significant, or not in use.
    label : text beside the tip, such as the length of a scale.
    """

    shape: Literal["arrow"] = "arrow"
    at: Pixel
    displacement: Pixel
    key: Key = omitted("")
    tip: Text = omitted("")
    dashed: bool = omitted(False)
    label: Text = omitted("")


Shape = Annotated[Polyline | Ring | Cross | Arrow, Field(discriminator="shape")]


class Layer(Schema):
    """Shapes that are switched on and off together.

    name : kind of the shapes, for title, shortcut and style.
    enlargement : of the arrows.
    """

    name: LayerName
    shapes: tuple[Shape, ...]
    enlargement: float = 1.0


class Overlay(Schema):
    """Layers over an image; title : which of several overlays, empty for the only one."""

    title: Text = ""
    layers: tuple[Layer, ...]


class Strip(Schema):
    """Image along an edge, sampled in native pixels across the predicted edge and along it.

    length : columns along the edge, from A to B. Rows are across it, outward first; the prediction
        is in the middle row.
    offset : offset of the fitted line from the prediction, px outward, at evenly spaced positions
        from the middle of the first column to that of the last.
    sigma : its standard deviation there, px.
    """

    length: int
    offset: tuple[float, ...]
    sigma: tuple[float, ...]


class Image(Schema):
    """Image with its overlays.

    title, caption : name and contents.
    group : for the filter, such as the station; empty for none.
    key : of the image, so that a selection elsewhere finds it.
    width, height : of the camera's image, px.
    quarter_turns : clockwise, that turn it upright, as EXIF says.
    webp : base64, of at most these pixels; empty if the file cannot be read.
    url : of the image beside a page that is served, in place of ``webp``.
    overlays : of which a viewer shows one at a time.
    strip_webp : the strips one below the other, base64; empty without any.
    strip_rows : rows of each strip.
    """

    title: Text
    caption: Text
    group: Text = ""
    key: Key = ""
    width: int
    height: int
    quarter_turns: int = 0
    webp: str = ""
    url: str = Field(default="", pattern=r"^(image/\d+/\d+)?$")
    overlays: tuple[Overlay, ...] = ()
    strip_webp: str = ""
    strip_rows: int = 0
    strips: tuple[Strip, ...] = ()


class Images(Schema):
    """Grid of images; each opens in the inspector.

    first : number of images until the reader asks for all.
    legs : number of legs, for the colours' key; 0 for none.
    size : width of an image in the grid.
    """

    kind: Literal["images"] = "images"
    images: tuple[Image, ...]
    first: int = 12
    legs: int = 0
    size: Literal["thumbnail", "figure"] = "thumbnail"
