"""Regions of a workspace: poses spread over the reachable part of them."""

from __future__ import annotations

import numpy as np
import pytest

from faults import raises, replaced
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import pose_difference
from pkmcal.mechanisms import catalogue, load_mechanism
from pkmcal.mechanisms.region import Region, poses_in
from pkmcal.session.load import load_session
from test_session import folder  # noqa: F401 - a fixture
from test_workspace import cube


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_every_machine_takes_what_it_is_given(name):
    limits = load_mechanism(name).limits()
    z = float(limits.home[2, 3])
    for region in (Region(), Region(x=(-0.02, 0.03), z=(z - 0.01, z + 0.01), turn=0.1)):
        poses = poses_in(limits, region, 30)
        assert poses.shape == (30, 4, 4)
        assert load_mechanism(name).reachable(poses).inside.all()
        assert region.holds(limits, poses).all()


def test_poses_fill_the_box_evenly():
    """About as many points in every cell of a box; none beyond a machine's reach."""
    limits = cube().limits()
    poses = poses_in(limits, Region(x=(0.0, 0.5), y=(-0.05, 0.05)), 512)
    low, high = np.array([0.0, -0.05, -0.1]), np.array([0.1, 0.05, 0.1])
    cells = np.floor(4 * (poses[:, :3, 3] - low) / (high - low)).astype(int)
    cells = np.minimum(cells, 3)  # rods of 1000 m turn, and let it a few micrometres further
    count = np.bincount(cells @ [16, 4, 1], minlength=64)
    assert count.sum() == 512
    assert count.min() >= 4  # of 8; points drawn at random leave some cell with 1 or none
    assert count.max() <= 12


def test_the_seed_decides():
    limits = load_mechanism("gough-stewart").limits()
    region = Region(turn=0.2)
    first = poses_in(limits, region, 20, seed=3)
    np.testing.assert_array_equal(first, poses_in(limits, region, 40, seed=3)[:20])
    assert np.abs(first - poses_in(limits, region, 20, seed=4)).max() > 1e-3


def test_turns_are_those_of_the_motion_and_fill_the_ball():
    hexapod, h4 = (load_mechanism(name).limits() for name in ("gough-stewart", "h4"))
    turns = pose_difference(poses_in(hexapod, Region(turn=0.2), 400), hexapod.home)[:, :3]
    size = np.linalg.norm(turns, axis=1)
    assert 0.19 < size.max() <= 0.2 + 1e-9
    # half of a ball's volume lies beyond 0.794 of its radius; 0.13 is five deviations of chance
    assert abs(np.mean(size > 0.2 * 0.5 ** (1 / 3)) - 0.5) < 0.13
    turns = pose_difference(poses_in(h4, Region(turn=0.2), 50), h4.home)[:, :3]
    assert np.abs(turns[:, :2]).max() == 0
    assert np.ptp(turns[:, 2]) > 0.3


def test_a_machine_that_moves_aside_by_turning_only_turns_unless_forbidden():
    limits = load_mechanism("3-rps").limits()
    turned = [
        np.linalg.norm(pose_difference(poses_in(limits, region, 30), limits.home)[:, :3], axis=1)
        for region in (Region(), Region(turn=0.0))
    ]
    assert turned[0].max() > 0.2
    assert turned[1].max() < 1e-6


def test_a_region_out_of_reach_is_reported():
    limits = load_mechanism("gough-stewart").limits()
    with raises(InputError, found="z from 1 to 2 m"):
        poses_in(limits, Region(z=(1.0, 2.0)), 5)
    corner = Region(x=(0.12, 0.13), y=(0.12, 0.13), z=(0.42, 0.43))
    found = "x 120 to 130 mm, y 120 to 130 mm, z 420 to 430 mm; 5120 poses tried"
    with raises(InputError, found=found) as caught:
        poses_in(limits, corner, 5)
    assert caught.value.expected.endswith("home, [0, 0, 359] mm")


def test_a_session_states_where_the_tool_is_to_be_right(folder):  # noqa: F811
    from pkmcal.session.load import load_session

    assert load_session(folder).workspace is None
    replaced(
        folder / "session.yaml", "stations:", "workspace: {x: [-0.1, 0.1], turn: 0.2}\nstations:"
    )
    session = load_session(folder)
    assert session.workspace == Region(x=(-0.1, 0.1), turn=0.2)
    assert session.document["workspace"]["x"] == [-0.1, 0.1]


@pytest.mark.parametrize(
    ("line", "key", "found", "expected"),
    [
        ("{x: [0.1, -0.1]}", "", "[0.1, -0.1]", "[lowest, highest] in metres"),
        ("{z: [0.1]}", ".z", "[0.1]", "[lowest, highest] z in m"),
        ("{turn: 15}", "", "15", "radians from 0 to 3.14; 15 degrees are 0.262"),
        ("{w: [0, 1]}", ".w", "w", "turn, x, y and z"),
    ],
)
def test_a_workspace_that_is_none_is_reported(folder, line, key, found, expected):  # noqa: F811
    replaced(folder / "session.yaml", "stations:", f"workspace: {line}\nstations:")
    where = f"session.yaml, line 4, workspace{key}"
    with raises(InputError, where=where, found=found, expected=expected):
        load_session(folder)
