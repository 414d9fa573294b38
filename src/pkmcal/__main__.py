"""``python -m pkmcal``, the same as the command ``pkmcal``."""

import sys

from pkmcal.cli import main

if __name__ == "__main__":
    sys.exit(main())
