"""Every numeric option of every command, and every number of the public functions, has a range."""

import click
import numpy as np
import pytest

import pkmcal
from conftest import run
from faults import raises
from pkmcal.commands.cli import COMMANDS_IN_ORDER, command_named
from pkmcal.errors import InputError
from pkmcal.ranges import RANGES, Range, check_number
from pkmcal.simulation import Sensor

OPTIONS = [
    (command, option.opts[-1].lstrip("-").replace("-", "_"), option)
    for command in COMMANDS_IN_ORDER
    for option in command_named(command).params
    if isinstance(option, click.Option) and not option.is_flag
]
"""Command, name and option with a value, of all commands."""
RANGED = [(command, name, one.opts[-1]) for command, name, one in OPTIONS if one.callback]
BAD = ("nan", "-inf", "0", "1e308", "x")


def required_words(command):
    """Arguments that a command requires; the files do not exist."""
    words = []
    for one in command_named(command).params:
        if one.required:
            words += ["no-such"] if isinstance(one, click.Argument) else [one.opts[-1], "c"]
    return words


def test_every_numeric_option_is_in_the_table():
    assert len(RANGED) > 35
    assert {(command, name) for command, name, _ in RANGED} <= {
        (command, name) for command, each in RANGES.items() for name in each
    }
    for command, name, option in OPTIONS:
        assert option.callback or option.type not in (click.INT, click.FLOAT), (command, name)
        if option.callback:
            check_number(command, name, option.default)


@pytest.mark.parametrize(("command", "name", "flag"), RANGED)
def test_options_out_of_their_range_are_refused_first(command, name, flag):
    allowed = RANGES[command][name]
    for text in BAD:
        try:
            value = float(text)
        except ValueError:
            value = np.nan
        if allowed.least <= value <= allowed.most and not (
            allowed.above and value == allowed.least
        ):
            continue
        done = run(command, *required_words(command), f"{flag}={text}")
        assert done.code == 2
        assert flag in done.err
        assert "defect" not in done.err


def test_ends_of_a_range_belong_to_it_unless_it_begins_above():
    Range(0, 2).check(0, "x")
    Range(0, 2).check(np.float64(2), "x")
    Range(0, 2, whole=True).check(np.int64(2), "x")
    for allowed, value in (
        (Range(0, 2, above=True), 0), (Range(0, 2), 2.1), (Range(0, 2), np.nan), (Range(0, 2), "1"),
        (Range(0, 2), True), (Range(0, 2), None), (Range(0, 2, whole=True), 1.5),
    ):  # fmt: skip
        with pytest.raises(InputError) as caught:
            allowed.check(value, "x")
        assert caught.value.where == "x"


ODD = (np.nan, np.inf, -np.inf, -1, 1e308, 10**12, "1", True, [1])


@pytest.mark.parametrize("value", ODD, ids=repr)
@pytest.mark.parametrize("name", [n for n in RANGES["simulate"] if n not in ("noise", "blur")])
def test_numbers_of_simulate(tmp_path, name, value):
    if RANGES["simulate"][name].least == 0 and name == "seed" and value == 10**12:
        return
    given = [value, 0.0] if name == "shake" else value
    if name == "stations" and isinstance(value, str | list):
        return  # where they stand
    with pytest.raises(InputError):
        pkmcal.simulate(tmp_path / "x", "3-rpr", **{name: given})
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0, 1e308])
@pytest.mark.parametrize("name", ["blur", "read_noise"])
def test_numbers_of_a_sensor(tmp_path, name, value):
    with raises(InputError, where=f"sensor.{name}", found=f"{value:g}"):
        pkmcal.simulate(tmp_path / "x", "3-rpr", sensor=Sensor(**{name: value}))


@pytest.mark.parametrize("value", [np.nan, -1, 10**12, 2.5, "3", True], ids=repr)
def test_numbers_of_the_other_functions(tmp_path, value):
    for call, where, limits in (
        (lambda: pkmcal.calibrate(tmp_path, holdout=value), "holdout", "0 to 100000"),
        (lambda: pkmcal.plan("3-rpr", count=value), "3-rpr: --configurations", "2 to 200"),
        (lambda: pkmcal.study("3-rpr", runs=value), "runs", "2 to 1e+06"),
    ):
        with raises(InputError, where=where, expected=f"a whole number, {limits}"):
            call()


@pytest.mark.parametrize("value", [np.nan, -1.0, 1e308], ids=repr)
def test_noises_and_distances_of_the_other_functions(tmp_path, value):
    for call, where in (
        (lambda: pkmcal.plan("3-rpr", edge_noise=value), "edge_noise"),
        (lambda: pkmcal.plan("3-rpr", corner_noise=value), "corner_noise"),
        (lambda: pkmcal.plan("3-rpr", joint_noise=value), "joint_noise"),
        (lambda: pkmcal.plan("3-rpr", tracker=(1e-5, value)), "tracker"),
        (lambda: pkmcal.plan("3-rpr", seed=value), "seed"),
        (lambda: pkmcal.check(tmp_path, seed=value), "seed"),
        (lambda: pkmcal.camera(tmp_path, distance=value), "distance"),
        (lambda: pkmcal.servo("3-rpr", joint_noise=value), "joint_noise"),
        (lambda: pkmcal.servo("3-rpr", speed=value), "speed"),
    ):
        with raises(InputError, where=where):
            call()
