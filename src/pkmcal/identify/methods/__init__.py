"""Methods of [A], [B] and [C], alternatives to the joint estimate, for comparison and as starts.

- [A] ``four_step`` (the steps in order), ``leg_axes`` (1), ``four_step_base`` (2),
  ``four_step_platform`` (3, 4), with ``registration`` (rigid bodies) and ``four_step_checks`` (what
  the data must contain).
- [B] ``linear``, base centres from edges, leg by leg; ``linear_together``, all base centres
  jointly with the nominal model.
- [C] ``inverse_kinematic``.

What every calibration uses stands one level up: [A]'s conditions and joints of the nominal model,
[C]'s camera and board (``hand_eye``), measured poses, and axis of rotation.

``estimates`` returns their estimates with standard deviations. A form that follows a paper where
the paper is in error is named *printed*; :doc:`formulation` gives the reasons.
"""
