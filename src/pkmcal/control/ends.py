"""How a servoing run can end, and what the user is told."""

from __future__ import annotations

from enum import Enum


class End(Enum):
    """A run's end: a word for files, what happened, and what would help.

    ``good`` is a platform at its goal; every other end is a failure.
    """

    REACHED = (
        "reached",
        "the platform reached the goal",
        "",
    )
    SLOW = (
        "slow",
        "the platform was still on its way when the time was up",
        "give it more time, a higher gain or faster drives",
    )
    UNSTEADY = (
        "unsteady",
        "noise of the edges kept the platform away from the goal",
        "let the camera see more legs, control by edges, or lower the gain",
    )
    OTHER_POSE = (
        "other_pose",
        "the legs look as wanted, but the platform is at another pose",
        "let the camera see more legs, start nearer to the goal, or compare the readings with"
        " those at the goal",
    )
    STUCK = (
        "stuck",
        "the control came to rest before the goal, where the errors of the legs cancel",
        "let the camera see more legs, or lead the platform through a pose in between",
    )
    DIVERGED = (
        "diverged",
        "the control did not converge; the legs are no nearer to the goal than at the start",
        "calibrate the camera's place, or lower the gain or the delay",
    )
    LOST_LEG = (
        "lost_leg",
        "a leg left the camera's view, so the control was stopped",
        "move the camera back, or lead the platform through a pose in between",
    )
    LEFT_WORKSPACE = (
        "left_workspace",
        "a drive came to the end of its range, or a leg could not follow",
        "lead the platform through a pose in between, or improve the geometry that the control"
        " believes",
    )
    SINGULAR = (
        "singular",
        "the platform came to a singular pose, where the drives do not hold it",
        "choose a start in the goal's assembly, or a path that keeps away from singular poses",
    )
    WRONG_ASSEMBLY = (
        "wrong_assembly",
        "the start is in another assembly than the goal; a way between them crosses a singular"
        " pose",
        "assemble the machine as at the goal before the control begins",
    )

    def __init__(self, word: str, what: str, help_: str) -> None:
        self.word = word
        self.what = what
        self.help = help_

    @property
    def good(self) -> bool:
        """Whether the platform is at its goal."""
        return self is End.REACHED

    @property
    def sentence(self) -> str:
        """What happened and what would help."""
        what = self.what[0].upper() + self.what[1:] + "."
        return f"{what} {self.help[0].upper()}{self.help[1:]}." if self.help else what
