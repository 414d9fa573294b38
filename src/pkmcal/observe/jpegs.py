"""Images scaled down, and as JPEG files."""

from __future__ import annotations

from typing import Any


def narrowed(image: Any, width: int) -> Any:
    """Image (h, w) scaled down to a width of at most ``width`` px."""
    import cv2

    if image.shape[1] <= width:
        return image
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    # linear interpolation costs an eighth, and skips no pixels up to a factor of two
    how = cv2.INTER_LINEAR if image.shape[1] <= 2 * width else cv2.INTER_AREA
    return cv2.resize(image, (width, height), interpolation=how)


def coded(image: Any, quality: int) -> bytes:
    """Image as the bytes of a JPEG file."""
    import cv2

    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
