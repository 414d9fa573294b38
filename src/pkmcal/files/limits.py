"""Limits on the size of inputs.

Each limit is several times what any machine or session needs, and is checked before the limited
work takes time or memory. docs/files.md lists the limits for users.
"""

from __future__ import annotations

from pkmcal.errors import InputError

LARGEST_TEXT_FILE = 2**26
"""Bytes of a text file: 64 MB of calibration.json hold the residuals of 100,000 images."""
LARGEST_WRITTEN_FILE = 2**20
"""Bytes of a hand-written file: a session of 200 stations with comments has 100 kB."""
MOST_YAML_NODES = 50_000
"""Keys and values of a YAML file as written. A large machine has a thousand; reading these takes
two seconds."""
MOST_VALUES = 200_000
"""Values after the expansion of aliases. Aliases of aliases expand one short line to billions of
values, which would fill the memory."""
MOST_CHARACTERS = 10_000_000
"""Characters of all texts after the expansion of aliases."""
MOST_NESTED_LEVELS = 50
"""Levels of nested lists and mappings: a machine has six; JSON readers fail at some two hundred."""
MOST_MACHINE_LEGS = 32
"""Legs of a machine; redundant ones have eight."""
MOST_LEG_TUBES = 16
"""Tubes of a leg; a telescopic leg has five. Each is measured in every image."""
MOST_STATIONS = 200
"""Entries of ``stations``: fixed cameras and trackers."""
MOST_IMAGES = 20_000
"""Images of a station, of all configurations together: ten each of two thousand."""
MOST_PIXELS = 2**28
"""Pixels of an image: 268 million, some twice as many as the largest cameras have. Decoding takes
four bytes each."""
MOST_HANDHELD_IMAGES = 500
"""Hand-held images, each of which is a station of its own."""
MOST_ROWS = 10_000
"""Rows of a table, which are configurations: a bed of 10,000 heights takes a minute."""
MOST_COLUMNS = 100
"""Columns of a table; three for each leg leave room."""
MOST_FAULTS_NAMED = 50
"""Faults of one file that are examined closely; the others are reported once these are fixed."""


def check_count(number: int, most: int, what: str, where: str | None = None) -> None:
    """Raise `InputError` where a number exceeds its limit; what : in the plural, "stations"."""
    if number > most:
        raise InputError(
            f"there are too many {what}",
            where=where,
            found=str(number),
            expected=f"at most {most}",
        )
