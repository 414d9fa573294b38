"""Versions of the program and of the packages that numbers depend on."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version

PACKAGES_WITH_VERSION = ("numpy", "scipy", "opencv-contrib-python-headless")


@cache
def versions() -> Mapping[str, str]:
    """Versions of pkmcal, Python and the packages that numbers depend on."""
    results = {"pkmcal": version("pkmcal"), "python": platform.python_version()}
    for name in PACKAGES_WITH_VERSION:
        try:
            results[name] = version(name)
        except PackageNotFoundError:
            continue
    return results
