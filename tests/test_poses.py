"""Sets of measured poses."""

from __future__ import annotations

import numpy as np

from pkmcal.measurements import PoseSet, concatenate


def some(n, station=0):
    return PoseSet(
        station=np.full(n, station),
        configuration=np.arange(n),
        mount=np.zeros(n, dtype=int),
        T_station_target=np.tile(np.eye(4), (n, 1, 1)) + np.arange(n)[:, None, None],
        whiten=np.tile(np.eye(6), (n, 1, 1)) * (1 + np.arange(n))[:, None, None],
    )


def test_empty():
    none = PoseSet.empty()
    assert len(none) == 0
    assert none.T_station_target.shape == (0, 4, 4)
    assert none.whiten.shape == (0, 6, 6)
    assert none.station.dtype.kind == "i"


def test_select_by_mask_and_by_place():
    poses = some(4)
    by_mask = poses.select(np.array([False, True, False, True]))
    by_place = poses.select(np.array([1, 3]))
    assert len(by_mask) == 2
    assert by_mask.configuration.tolist() == by_place.configuration.tolist() == [1, 3]
    np.testing.assert_array_equal(by_mask.whiten, poses.whiten[[1, 3]])
    np.testing.assert_array_equal(by_place.T_station_target, poses.T_station_target[[1, 3]])


def test_concatenate_keeps_the_order():
    joined = concatenate([some(2, 5), PoseSet.empty(), some(1, 3)])
    assert joined.station.tolist() == [5, 5, 3]
    assert joined.configuration.tolist() == [0, 1, 0]
    assert joined.whiten.shape == (3, 6, 6)
    assert len(concatenate([PoseSet.empty()])) == 0
