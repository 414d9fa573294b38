"""pkmcal calibrates parallel kinematic machines from images.

    >>> import pkmcal
    >>> result = pkmcal.calibrate("session")                      # doctest: +SKIP
    >>> print(result.summary())                                   # doctest: +SKIP
    >>> result.save("out")                                        # doctest: +SKIP
    >>> machine = pkmcal.load_mechanism("out/mechanism.yaml")     # doctest: +SKIP

Public names are imported on first use, so that ``import pkmcal`` and the command line's help are
quick: OpenCV and SciPy alone take most of a second.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from pkmcal import errors

if TYPE_CHECKING:
    from pkmcal.api.calibrate import calibrate, load_result
    from pkmcal.api.plan import plan
    from pkmcal.api.show import show
    from pkmcal.api.simulate import simulate
    from pkmcal.cameras import load_camera
    from pkmcal.judge.machine_errors import compare
    from pkmcal.mechanisms import Machine, load_mechanism
    from pkmcal.session.load import load_session
    from pkmcal.studies.findings import study

__version__ = "0.1.0"

__all__ = [
    "Machine",
    "__version__",
    "calibrate",
    "compare",
    "errors",
    "load_camera",
    "load_mechanism",
    "load_result",
    "load_session",
    "plan",
    "show",
    "simulate",
    "study",
]

_HOMES = {
    "Machine": "pkmcal.mechanisms",
    "calibrate": "pkmcal.api.calibrate",
    "compare": "pkmcal.judge.machine_errors",
    "load_camera": "pkmcal.cameras",
    "load_mechanism": "pkmcal.mechanisms",
    "load_result": "pkmcal.api.calibrate",
    "load_session": "pkmcal.session.load",
    "plan": "pkmcal.api.plan",
    "show": "pkmcal.api.show",
    "simulate": "pkmcal.api.simulate",
    "study": "pkmcal.studies.findings",
}
"""Modules of the public names."""


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'pkmcal' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
