"""Recordings that are given in place of images or tables: videos, ROS bags and MCAP files."""

from __future__ import annotations

from pkmcal.errors import InputError

RECORDING_HEAD_BYTES = 16
"""Bytes from which the kind of a recording is recognised."""
_VIDEO_STEP = (
    "Write images of moments at which the machine stands still, such as by"
    " ffmpeg -i FILE -vf fps=1 images/%04d.png, and name the images"
)
_BAG_STEP = (
    "Write its images as PNG or JPEG files and its poses or readings as a CSV table; the Python"
    " package rosbags reads it without ROS"
)
_MCAP_STEP = (
    "Write its images as PNG or JPEG files and its poses or readings as a CSV table; the Python"
    " package mcap reads it"
)
_RECORDINGS: tuple[tuple[int, bytes, str, str], ...] = (
    (4, b"ftyp", "a video (MP4 or MOV)", _VIDEO_STEP),
    (8, b"AVI ", "a video (AVI)", _VIDEO_STEP),
    (0, b"\x1aE\xdf\xa3", "a video (Matroska or WebM)", _VIDEO_STEP),
    (0, b"#ROSBAG V", "a ROS bag", _BAG_STEP),
    (0, b"SQLite format 3\0", "a ROS 2 bag or another SQLite database", _BAG_STEP),
    (0, b"\x89MCAP0\r\n", "an MCAP recording", _MCAP_STEP),
)
"""Position and bytes of the signature, name of the format, and what to do with it."""
_IMAGE_BRANDS = (b"avif", b"avis", b"crx ")
"""Images in the container of MP4 videos: AVIF, and raw images of Canon."""


def recording_error(head: bytes, label: str, expected: str) -> InputError | None:
    """Error that names the format of a recording and the step to images or a table; None for
    other files.

    head : the file's first RECORDING_HEAD_BYTES bytes. HEIF images begin as MP4 videos do, so
    they must be recognised before. label : the file's name in messages.
    """
    if head[8:12] in _IMAGE_BRANDS:
        return None
    for start, signature, name, step in _RECORDINGS:
        if head[start : start + len(signature)] == signature:
            return InputError(
                "the file is a recording, which pkmcal does not read",
                where=label,
                found=name,
                expected=expected,
                next_step=step,
            )
    return None
