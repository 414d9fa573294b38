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
    from pkmcal.api.board import board
    from pkmcal.api.calibrate import calibrate, load_result
    from pkmcal.api.camera import camera
    from pkmcal.api.check import check
    from pkmcal.api.diff import diff
    from pkmcal.api.export import export
    from pkmcal.api.new import new
    from pkmcal.api.plan import plan
    from pkmcal.api.reproduce import reproduce
    from pkmcal.api.servo import servo
    from pkmcal.api.show import show
    from pkmcal.api.simulate import simulate
    from pkmcal.api.study import study
    from pkmcal.api.validate import validate
    from pkmcal.api.view import view
    from pkmcal.api.watch import watch
    from pkmcal.cameras import load_camera
    from pkmcal.judge.machine_errors import compare
    from pkmcal.mechanisms import Machine, load_mechanism
    from pkmcal.session.load import load_session

__version__ = "0.1.0"

__all__ = [
    "Machine",
    "__version__",
    "board",
    "calibrate",
    "camera",
    "check",
    "compare",
    "diff",
    "errors",
    "export",
    "load_camera",
    "load_mechanism",
    "load_result",
    "load_session",
    "new",
    "plan",
    "reproduce",
    "servo",
    "show",
    "simulate",
    "study",
    "validate",
    "view",
    "watch",
]

_HOMES = {
    "Machine": "pkmcal.mechanisms",
    "board": "pkmcal.api.board",
    "calibrate": "pkmcal.api.calibrate",
    "camera": "pkmcal.api.camera",
    "check": "pkmcal.api.check",
    "compare": "pkmcal.judge.machine_errors",
    "diff": "pkmcal.api.diff",
    "export": "pkmcal.api.export",
    "load_camera": "pkmcal.cameras",
    "load_mechanism": "pkmcal.mechanisms",
    "load_result": "pkmcal.api.calibrate",
    "load_session": "pkmcal.session.load",
    "new": "pkmcal.api.new",
    "plan": "pkmcal.api.plan",
    "reproduce": "pkmcal.api.reproduce",
    "servo": "pkmcal.api.servo",
    "show": "pkmcal.api.show",
    "simulate": "pkmcal.api.simulate",
    "study": "pkmcal.api.study",
    "validate": "pkmcal.api.validate",
    "view": "pkmcal.api.view",
    "watch": "pkmcal.api.watch",
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
