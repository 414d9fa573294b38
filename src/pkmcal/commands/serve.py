"""A page on this computer, until the program is interrupted."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

from pkmcal import terminal
from pkmcal.commands import console

if TYPE_CHECKING:
    from pkmcal.web.guard import Guard


def serve(
    application: Callable[[str, int], Guard], port: int, *, no_browser: bool, as_json: bool
) -> int:
    """Serve a page, print its address, open a browser where there is one; return the exit code.

    application : from the page's token and port. port : 0 for a free one.
    Raises InputError if the port is taken.
    """
    from pkmcal.web import serving

    def announce(address: str) -> None:
        if as_json:
            console.print_json({"url": address})
        else:
            out = terminal.out()
            out.print(f"The page is at\n\n  {address}\n", soft_wrap=True)
            out.print("It is served to this computer only, until you press Ctrl-C.")
        sys.stdout.flush()
        if not no_browser and not as_json and console.can_show():
            import webbrowser

            webbrowser.open(address)

    serving.serve(application, port, announce)
    return 0
