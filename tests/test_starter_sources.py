"""Contract of the files that ``pkmcal new --from`` reads, over all sources."""

from __future__ import annotations

import pytest

import pkmcal
from pkmcal.errors import InputError
from pkmcal.starter.sources import read_source, starter_sources

HAL, MASLOW = "setp genhexkins.base.0.x 1\n", "CLBM:[{bl:2960.58}]\n"
FILES = {
    ("hexapod.hal", HAL): "JointCentres",
    ("hexapod.csv", "leg,base_x\n"): "JointCentres",
    ("config.g", "M669 K6 A0:-1600:-120\n"): "HangprinterConfiguration",
    ("printer.cfg", "[printer]\nkinematics: winch\n"): "KlipperMachine",
    ("log.txt", MASLOW): "MaslowLog",
    ("robot.xml", "<mujoco/>\n"): "BodiesModel",
}


@pytest.mark.parametrize(("name", "text"), FILES)
def test_one_source_claims_a_file(name, text, tmp_path):
    claiming = [type(s).__name__ for s in starter_sources() if s.claims(text, tmp_path / name)]
    assert claiming == [FILES[name, text]]


def test_every_source_has_an_example_and_words_of_its_own():
    sources = starter_sources()
    assert {type(source).__name__ for source in sources} == set(FILES.values())
    assert len({source.title for source in sources}) == len(sources)
    assert all(source.recognised for source in sources)


@pytest.mark.parametrize(("text", "kinds"), [("nothing\n", ()), ("", ()), (HAL + MASLOW, (0, 1))])
def test_a_file_of_no_kind_or_of_two_is_refused(text, kinds, tmp_path):
    """Titles or recognised words are named of the kinds in question alone."""
    (tmp_path / "file.txt").write_text(text)
    with pytest.raises(InputError) as refused:
        read_source(tmp_path / "file.txt", None, {})
    assert refused.value.where == "file.txt"
    claiming = [s for s in starter_sources() if s.claims(text, tmp_path / "file.txt")]
    assert len(claiming) == len(kinds)
    for source in starter_sources():
        named = source.recognised in str(refused.value.expected)
        assert named == (source in claiming or not claiming)


@pytest.mark.parametrize("given", [{"board": True}, {"legs": True}, {"places": 2}, {"leg": 0.3}])
def test_a_whole_session_takes_nothing_besides(given, tmp_path):
    positions = ", ".join(f"{{bl:{2900 + k}, br:3100, tr:3000, tl:3050}}" for k in range(6))
    (tmp_path / "log.txt").write_text(f"CLBM:[{positions}]\n")
    assert pkmcal.new(from_file=tmp_path / "log.txt").complete
    with pytest.raises(InputError) as refused:
        pkmcal.new(from_file=tmp_path / "log.txt", **given)
    assert refused.value.where == "--from"


def test_a_machine_that_does_not_reach_home_is_refused(tmp_path):
    """The second spool is too small for the line that it would have to take."""
    anchors = "M669 K6 A0:-1600:-120 B1390:800:-120 C-1390:800:-120 D0:0:2300\n"
    path = tmp_path / "config.g"
    for radius, reaches in ((30, True), (3, False)):
        spools = f"M666 Q0.05 R30:{radius}:30:30 U2:2:2:2 O1:1:1:1 L20:20:20:20 H255:255:255:255"
        path.write_text(f"{anchors}{spools}\n")
        if reaches:
            assert "mechanism.yaml" in pkmcal.new(from_file=path).texts
            continue
        with pytest.raises(InputError) as refused:
            pkmcal.new(from_file=path)
        assert (refused.value.where, refused.value.found) == ("config.g", "2")
