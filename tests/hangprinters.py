"""A Hangprinter's configuration, and machines from such texts."""

from __future__ import annotations

from pathlib import Path

import pkmcal
from pkmcal.files import parse_yaml, validated_document
from pkmcal.mechanisms import MechanismDocument, machine_from_document

CONFIG = """\
; Hangprinter parameters
M669 K6 N4 A-15.5:-1610.25:-131.5 B1314.5:1268.5:-121.25 C-1415.75:707.5:-121.75 D18.25:-0.25:2299.5
M666 Q0.038 R75.1:74.9:75.2:75.05 U2:2:2:4 O1:1:1:2 L20:20:20:20 H255:255:255:255 J25:25:25:25
"""


def machine_of(text, folder):
    """Machine that `pkmcal new` makes of a configuration, which is written into the folder."""
    (folder / "config.g").write_text(text, encoding="utf-8")
    texts = pkmcal.new(from_file=folder / "config.g").texts
    document = parse_yaml(texts["mechanism.yaml"], Path("mechanism.yaml"))
    return machine_from_document(validated_document(document, MechanismDocument))
