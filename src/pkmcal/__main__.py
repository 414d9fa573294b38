"""Entry point of ``python -m pkmcal``, the same as the command ``pkmcal``."""

import sys

from pkmcal.commands.cli import main

if __name__ == "__main__":
    sys.exit(main())
