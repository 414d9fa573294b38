"""The commands, one a module; heavy imports stand inside them, so that help comes at once."""

from collections.abc import Callable

from pkmcal.commands.calibrate import calibrate
from pkmcal.commands.check import check
from pkmcal.commands.demo import demo
from pkmcal.commands.new import new
from pkmcal.commands.simulate import simulate

COMMANDS: dict[str, Callable[..., int]] = {
    "demo": demo,
    "new": new,
    "check": check,
    "calibrate": calibrate,
    "simulate": simulate,
}
"""In the order of the help: the order in which a newcomer needs them."""
