"""The error family: content of messages, and their form for programs."""

import json
import pickle

import pytest

from pkmcal import errors
from pkmcal.errors import GeometryError, InputError, PkmcalError, ResultError

FULL = {
    "what": "this is not a number",
    "where": "joints.csv, line 4, column leg2",
    "found": "'abc'",
    "expected": "a number",
    "next_step": "Correct the cell",
}


def test_all_parts_make_two_sentences():
    assert str(InputError(**FULL)) == (
        "joints.csv, line 4, column leg2: this is not a number; found 'abc', expected a number."
        " Correct the cell."
    )


def test_only_what_makes_one_sentence():
    assert str(InputError("the file is empty.")) == "the file is empty."


def test_an_empty_value_is_called_nothing():
    assert InputError("this cannot be", found="").found == "nothing"


def test_a_found_zero_is_shown():
    assert str(InputError("too few", found=0, expected=2)) == "too few; found 0, expected 2."


@pytest.mark.parametrize(
    ("step", "sentence"),
    [
        ("try again", " Try again."),
        ("joints.csv has it too", " joints.csv has it too."),
        ("Try again.", " Try again."),
    ],
)
def test_next_step_is_a_sentence_of_its_own(step, sentence):
    assert str(InputError("no", next_step=step)) == "no." + sentence


def test_exit_codes_are_those_of_the_command_line():
    codes = [kind.exit_code for kind in (PkmcalError, ResultError, GeometryError, InputError)]
    assert codes == [1, 1, 1, 2]


def test_every_error_belongs_to_the_family():
    kinds = [
        kind
        for kind in vars(errors).values()
        if isinstance(kind, type) and kind.__module__ == errors.__name__
    ]
    assert len(kinds) >= 4
    assert all(issubclass(kind, PkmcalError) for kind in kinds)


def test_as_dict_is_json_and_complete():
    values = json.loads(json.dumps(InputError(**FULL).as_dict()))
    assert values["error"] == "InputError"
    assert values["exit_code"] == 2
    assert values["message"].startswith("joints.csv, line 4")
    assert {name: values[name] for name in FULL} == FULL


def test_errors_survive_the_way_back_from_a_worker_process():
    error = ResultError(**FULL)
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is ResultError
    assert copy.as_dict() == error.as_dict()


def test_located_adds_the_place_and_keeps_the_rest():
    bare = InputError("up is zero", found="[0, 0, 0]")
    placed = bare.located("session.yaml, line 9")
    assert str(placed) == "session.yaml, line 9: up is zero; found [0, 0, 0]."
    assert bare.where is None
    assert placed.located("left").where == "left: session.yaml, line 9"


def test_another_field_keeps_the_rest():
    error = ResultError(**FULL, code="readings.sign")
    other = error.with_fields(found="nothing")
    assert type(other) is ResultError
    assert other.as_dict() == {**error.as_dict(), "found": "nothing", "message": str(other)}


def test_names_that_nothing_can_have_are_shortened():
    error = InputError("no", where=f"a/{'n' * 5000} line 2", found="n" * 5000)
    short = f"{'n' * 40}…{'n' * 20}"
    assert str(error) == f"a/{short} line 2: no; found {short}."
    values = InputError("no", found="w " * 5000, next_step="m" * 5000)
    assert len(str(values)) < 700
    path = "/" + "/".join(["folder" * 20] * 20)
    assert path in str(InputError("no", where=path))  # a long path is needed whole
