"""Files in and out: YAML with line numbers, schemas, CSV tables, outputs whole or not at all."""

from pkmcal.files.cache import remember, remembered
from pkmcal.files.documents import (
    Document,
    Keys,
    closest,
    field_path,
    json_text,
    json_value,
    parse_yaml,
    read_json,
    read_text,
    read_yaml,
    shown,
    wanted_file,
    yaml_text,
)
from pkmcal.files.edits import with_numbers
from pkmcal.files.exif import Exif, read_exif, with_exif
from pkmcal.files.headers import IMAGE_FILE_ENDINGS, stated_size
from pkmcal.files.locks import output_lock
from pkmcal.files.quantities import (
    LARGEST_UNITLESS_LENGTH,
    Metres,
    Point,
    Radians,
    Reading,
    Share,
    any_unit,
    no_such,
    written_unit,
)
from pkmcal.files.refusals import next_step_after
from pkmcal.files.regular import check_regular
from pkmcal.files.schema import Schema, validated_document
from pkmcal.files.tables import CsvTable, csv_text, read_csv
from pkmcal.files.writing import (
    alone_in,
    check_own_folder,
    check_writable,
    default_output,
    entries,
    place_below,
    remove_folder,
    staged_file,
    staged_folder,
    write_bytes,
    write_folder,
    write_text,
)

__all__ = [
    "IMAGE_FILE_ENDINGS",
    "LARGEST_UNITLESS_LENGTH",
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
    "default_output",
    "entries",
    "field_path",
    "json_text",
    "json_value",
    "next_step_after",
    "no_such",
    "output_lock",
    "parse_yaml",
    "place_below",
    "read_csv",
    "read_exif",
    "read_json",
    "read_text",
    "read_yaml",
    "remember",
    "remembered",
    "remove_folder",
    "shown",
    "staged_file",
    "staged_folder",
    "stated_size",
    "validated_document",
    "wanted_file",
    "with_exif",
    "with_numbers",
    "write_bytes",
    "write_folder",
    "write_text",
    "written_unit",
    "yaml_text",
]
