"""One place compares all hypotheses about a session, and again after each repair."""

from __future__ import annotations

import numpy as np
import pytest

from pkmcal.boards.views import Boards
from pkmcal.calibration.calibrate import Clock, calibrate_session, settle
from pkmcal.calibration.handheld import localize_case
from pkmcal.errors import InputError
from pkmcal.outcome.finding import note
from pkmcal.outcome.hypotheses import HYPOTHESIS_THRESHOLDS, Explanation, refuse
from pkmcal.session.load import load_session
from test_pose_sessions import make, write_joints


def settled(folder):
    session = load_session(folder)
    case = localize_case(session, [], Boards(), np.random.default_rng(0))
    return settle(session, case, False, 0, Clock())


def test_the_likeliest_explanation_is_the_reason_of_a_refusal():
    one, other = (InputError(code, code=code) for code in ("one", "other"))
    untested = (note("tube.diameter_untested", "mechanism.yaml", why="of little"),)
    computed = []

    def explained(*given):
        return [lambda each=each: computed.append(each) or each for each in given]

    weak, strong = (
        Explanation(one, HYPOTHESIS_THRESHOLDS.act - 1),
        Explanation(other, HYPOTHESIS_THRESHOLDS.act + 1),
    )
    open_left = Explanation(untested=untested)
    with pytest.raises(InputError) as caught:
        refuse(*explained(weak, strong, open_left))
    assert caught.value is other
    assert computed == [weak, strong]  # the last costs a localization
    assert refuse(*explained(Explanation(), open_left)) == untested


def test_one_mistake_after_another_until_there_is_none(tmp_path):
    """Two motors that count the other way are named; beside them two configurations bear each
    other's names, which a result tells once the motors are put right.
    """
    made = make(tmp_path / "session", "gough-stewart", n=24)
    right, joints = made.joints.copy(), made.joints.copy()
    right[[5, 9]] = right[[9, 5]]
    joints[[5, 9]] = joints[[9, 5]]
    for motor in (0, 3):
        joints[:, motor] = joints[:, motor].min() + joints[:, motor].max() - joints[:, motor]
    write_joints(made.folder, joints)
    with pytest.raises(InputError) as caught:
        settled(made.folder)
    assert caught.value.code == "readings.reversed"
    assert ("motor1" in caught.value.what, "motor4" in caught.value.what) == (True, True)
    write_joints(made.folder, right)
    value = settled(made.folder)
    assert (value.repairs, value.findings) == ((), ())
    (named,) = calibrate_session(made.folder).verdict.of("configurations.misnamed")
    assert named.facts["configurations"] == ["005", "009"]
    assert np.all(value.stated.pose_weights[[5, 9]] < 0.5)
