"""Methods of the papers, for comparison and as starting values; one function for each equation.

- [A] ``four_step`` (the steps in order), ``leg_axes`` (1), ``four_step_base`` (2),
  ``four_step_platform`` (3, 4), with ``legs`` (joints and frames of the nominal model),
  ``registration`` (rigid bodies), ``four_step_checks`` and ``conditions`` (what the data must
  contain); ``axis_measurements`` (its Table 1).
- [B] ``linear``, base centres from edges, leg by leg; ``linear_together``, all base centres
  jointly with the nominal model.
- [C] ``hand_eye`` (camera and board), ``inverse_kinematic`` on the poses of ``measured_platform``,
  ``rotation_axis``.

``methods`` returns their estimates with standard deviations. A form that follows a paper where the
paper is in error is named *printed*; :doc:`formulation` gives the reasons.
"""

from typing import Literal

PaperMethod = Literal["four-step", "linear", "inverse-kinematic"]
"""Methods for which ``methods`` returns estimates."""
