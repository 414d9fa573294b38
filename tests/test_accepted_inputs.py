"""Inputs that are well formed and make no sense end in a sentence, whatever reads them."""

import json
import shutil

import numpy as np
import pytest

from conftest import run
from faults import replaced
from fuzz import bases
from pkmcal.calibration.machine_source import load_source
from pkmcal.calibration.saved_calibration import load
from pkmcal.errors import InputError
from pkmcal.files import csv_text, read_csv


@pytest.fixture(scope="module")
def tracker(tmp_path_factory):
    """A session of a tracker, and its calibration on disk."""
    folder = tmp_path_factory.mktemp("inputs") / "session"
    bases.measured(folder, seed=1, count=14)
    assert run("calibrate", folder).code in (0, 1)
    return folder


@pytest.fixture
def copy(tracker, tmp_path):
    return shutil.copytree(tracker, tmp_path / "session", ignore=lambda *_: ["calibration"])


def refused(*words, code=2):
    """The sentence with which a command refuses."""
    done = run(*words)
    assert done.code == code, done
    assert "Warning" not in done.err
    return done.err + done.out


def second_tracker(folder, table):
    noise = "{position: 2.0e-05, rotation: 0.0001}"
    other = f"  other: {{tracker: {{poses: {table}, noise: {noise}}}}}\n"
    replaced(folder / "session.yaml", "stations:\n", f"stations:\n{other}")


@pytest.mark.parametrize("table", ["poses.csv", "./poses.csv", "link.csv"])
def test_one_table_under_two_stations(copy, table):
    (copy / "link.csv").symlink_to("poses.csv")
    second_tracker(copy, table)
    for command in ("check", "calibrate"):
        assert "stations.tracker.tracker.poses" in refused(command, copy)


def test_two_trackers_with_tables_of_their_own(copy):
    shutil.copy(copy / "poses.csv", copy / "more.csv")
    second_tracker(copy, "more.csv")
    assert run("calibrate", copy).code in (0, 1)


@pytest.mark.parametrize("method", ["linear", "four-step"])
def test_methods_of_legs_without_edges(copy, method):
    assert "legs" in refused("calibrate", copy, "--method", method, code=1)


def test_the_inverse_kinematic_method_on_points(copy):
    table = read_csv(copy / "poses.csv")
    points = csv_text(table.columns[:3], table.names, table.values[:, :3])
    (copy / "poses.csv").write_text(points)
    assert "whole poses" in refused("calibrate", copy, "--method", "inverse-kinematic")


@pytest.mark.parametrize("but_radii", [False, True])
def test_nothing_is_left_to_be_calibrated(copy, but_radii):
    entries = ["base.center", "platform.center", "length.offset", "scale"]
    entries += [] if but_radii else ["tubes[1].radius", "tubes[2].radius"]
    fixed = [f"legs[*].{entry}" for entry in entries]
    replaced(copy / "mechanism.yaml", "fixed: []", f"fixed: {json.dumps(fixed)}")
    for command in ("check", "calibrate", "plan"):
        assert "nothing to calibrate" in " ".join(refused(command, copy).split())


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("center", value) for value in ("2", "0.2", "1e15", "0", "-1", "1e-20", ".inf")),
        *((name, "2") for name in ("offset", "radius", "arm", "axis", "angle", "scale")),
        *((name, "0") for name in ("axis", "angle")),  # a scale may be exact
    ],
)
def test_tolerances_without_information(copy, name, value):
    old = (copy / "mechanism.yaml").read_text()
    at = old.index("tolerance: {")
    line = old[at : old.index("\n", at)]
    replaced(copy / "mechanism.yaml", line, f"tolerance: {{{name}: {value}}}")
    for command in ("plan", "calibrate"):
        assert f"tolerance.{name}" in refused(command, copy)


def test_a_tolerance_in_the_wrong_unit_is_reported_to_be_one(copy):
    replaced(copy / "mechanism.yaml", "{center: 0.002,", "{center: 2,")
    assert "2 mm" in refused("check", copy)


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("position: 2.0e-05", "position: 2", "noise.position"),
        ("noise: 3.0e-06}", "noise: 3}", "joints.noise"),
    ],
)
def test_noise_in_the_wrong_unit(copy, old, new, field):
    replaced(copy / "session.yaml", old, new)
    assert field in refused("calibrate", copy)


# ------------------------------------------------------------------ calibration.json


def places(value, keys=()):
    """Every place of a document; of lists, the first entry."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield (*keys, key)
            yield from places(item, (*keys, key))
    elif isinstance(value, list) and value:
        yield (*keys, 0)
        yield from places(value[0], (*keys, 0))


def put(document, keys, value):
    for key in keys[:-1]:
        document = document[key]
    document[keys[-1]] = value


OPTIONAL = ("tool", "bed", "residuals", "statistics", "session", "rejected", "warnings", "targets",
            "stations", "cameras")  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("key", OPTIONAL)
def test_what_loads_of_a_calibration_can_be_used(tracker, tmp_path, key):
    """Each of a document's values replaced by another type: refused by name, or without effect."""
    path = tmp_path / "calibration.json"
    plain = json.loads((tracker / "calibration" / "calibration.json").read_text())
    plain |= {
        "bed": {"z": 0.1},
        "rejected": [{"reason": "a", "count": 1, "cases": [["tracker", "100", 1, 1, 1]]}],
        "residuals": {
            "edges": [[1, 1, 1, 1, 1, 1.0, 0.1, 0.1, 0]],
            "poses": [[1, 1, 1, 1.0, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1]],
        },
        "cameras": [{"file": "a.yaml", "edge_shift": 0.1}],
        "session": {**plain["session"], "joints": {"noise": 1e-6, "columns": ["leg1"]}},
        "identifiability": None,
    }
    faults = []
    for keys in [(key,), *((key, *rest) for rest in places(plain[key]))]:
        for wrong in ("x", True, {"x": "x"}, [["x"]]):
            changed = {**plain, key: json.loads(json.dumps(plain[key]))}
            put(changed, keys, wrong)
            path.write_text(json.dumps(changed))
            try:
                saved = load(path)
            except InputError as error:
                faults.append(str(error))
                continue
            source = load_source(path)
            assert source.bed is None or np.isfinite(source.bed)
            assert saved.summary()
            assert source.header()
    assert faults
    # a station's other name is not in the covariance
    assert all(key[:7] in fault for fault in faults)


@pytest.mark.parametrize(("key", "value"), [
    ("tool", "x"), ("bed", "x"), ("tool", {"region": "x"}), ("tool", {"region": {"x": 3}}),
    ("bed", {"z": "x"}), ("session", {"joints": "x"}), ("statistics", {"chi2": "x"}),
    ("residuals", {"edges": [[1]]}), ("residuals", {"poses": "x"}), ("rejected", "x"),
    ("warnings", 3),
])  # fmt: skip
def test_commands_refuse_a_calibration_of_other_types(tracker, tmp_path, key, value):
    shutil.copytree(tracker / "calibration", tmp_path / "calibration")
    path = tmp_path / "calibration" / "calibration.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    for words in (
        ("export", tmp_path / "calibration", "--to", "json"),
        ("diff", tracker / "calibration", tmp_path / "calibration", "-o", tmp_path / "diff"),
        ("watch", tmp_path / "calibration", tracker),
    ):
        assert key in refused(*words)


# ------------------------------------------------------------------ links that lead to themselves


@pytest.mark.parametrize("words", [
    "calibrate LOOP", "check LOOP", "validate CAL LOOP", "validate LOOP S", "watch CAL LOOP",
    "diff CAL LOOP", "diff S/mechanism.yaml CAL -o LOOP", "export LOOP --to c",
    "export CAL --to c -o LOOP", "export CAL --to ros --session LOOP", "plan LOOP",
    "plan S --after LOOP", "plan h4 --camera LOOP", "simulate LOOP", "simulate X --plan LOOP",
    "simulate X --machine LOOP", "new LOOP", "new X --machine LOOP", "new X --printer LOOP",
    "board LOOP", "camera LOOP", "camera S/session.yaml --board LOOP", "study LOOP", "servo LOOP",
    "servo h4 --session LOOP", "view LOOP", "view S --calibration LOOP",
    "calibrate S -o LOOP", "calibrate S -o LOOP/x",
])  # fmt: skip
def test_a_link_to_itself_is_a_users_mistake(tracker, tmp_path, words):
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    places = {"LOOP": loop, "CAL": tracker / "calibration", "S": tracker, "X": tmp_path / "x"}
    given = [
        str(places[head]) + rest if head in places else word
        for word in words.split()
        for head, rest in [(word.partition("/")[0], "".join(word.partition("/")[1:]))]
    ]
    assert refused(*given)
    assert not (tmp_path / "x").exists()
