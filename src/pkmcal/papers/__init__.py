"""The papers' own methods, to compare with and to start from: each equation a function.

- [A] ``four_step`` (the steps in turn), ``leg_axes`` (1), ``four_step_base`` (2),
  ``four_step_platform`` (3, 4), with ``legs`` (the machine as the steps see it),
  ``registration`` (rigid bodies), ``four_step_checks`` and ``conditions`` (what data they need);
  ``axis_measurements`` (its Table 1).
- [B] ``linear``, base centres from edges, each leg alone; ``linear_together``, all of them with the
  drawing.
- [C] ``hand_eye`` (camera and board), ``inverse_kinematic`` on the poses of ``measured_platform``,
  ``rotation_axis``.

``methods`` makes results of them, with standard deviations. What a paper has differently from what
holds is named *printed*; :doc:`formulation` says why.
"""

from typing import Literal

PaperMethod = Literal["four-step", "linear", "inverse-kinematic"]
"""Of them, those that ``methods`` has."""
