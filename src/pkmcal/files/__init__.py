"""Files in and out: YAML with line numbers, schemas, CSV tables, outputs whole or not at all."""

from pkmcal.files.alone import alone_in
from pkmcal.files.cache import remember, remembered
from pkmcal.files.documents import (
    Document,
    Keys,
    closest,
    json_text,
    parse_yaml,
    plain,
    read_json,
    read_text,
    read_yaml,
    shown,
    wanted_file,
    yaml_text,
)
from pkmcal.files.edits import with_numbers
from pkmcal.files.exif import Exif, read_exif, with_exif
from pkmcal.files.headers import ENDINGS, stated_size
from pkmcal.files.quantities import (
    TOO_LARGE,
    Metres,
    Point,
    Radians,
    Reading,
    Share,
    any_unit,
    no_such,
    with_unit,
)
from pkmcal.files.regular import check_regular
from pkmcal.files.schema import Schema, field_path, validate
from pkmcal.files.tables import CsvTable, csv_text, read_csv
from pkmcal.files.writing import (
    check_own_folder,
    check_writable,
    entries,
    remove_folder,
    settle,
    staged_file,
    staged_folder,
    write_bytes,
    write_folder,
    write_text,
)
from pkmcal.wording import listed

__all__ = [
    "ENDINGS",
    "TOO_LARGE",
    "CsvTable",
    "Document",
    "Exif",
    "Keys",
    "Metres",
    "Point",
    "Radians",
    "Reading",
    "Schema",
    "Share",
    "alone_in",
    "any_unit",
    "check_own_folder",
    "check_regular",
    "check_writable",
    "closest",
    "csv_text",
    "entries",
    "field_path",
    "json_text",
    "listed",
    "no_such",
    "parse_yaml",
    "plain",
    "read_csv",
    "read_exif",
    "read_json",
    "read_text",
    "read_yaml",
    "remember",
    "remembered",
    "remove_folder",
    "settle",
    "shown",
    "staged_file",
    "staged_folder",
    "stated_size",
    "validate",
    "wanted_file",
    "with_exif",
    "with_numbers",
    "with_unit",
    "write_bytes",
    "write_folder",
    "write_text",
    "yaml_text",
]
