"""Levels that decisions of all packages share: what is rounding, negligible, few, a majority, or
more than noise.

Probabilities of false alarms are in :mod:`pkmcal.identify.false_alarm` and, of hypotheses, in
:mod:`pkmcal.outcome.hypotheses`. Limits of one algorithm are fields of its options.
Half or twice a level was tried only where its docstring gives the result.
"""

from __future__ import annotations

from math import radians

ROUNDING = 1e-9
"""Size, relative or in m and rad, below which a number is rounding: computations with exact
derivatives leave 1e-12 to 1e-14, decimal text of files less than a nanometre."""
NEGLIGIBLE = 0.01
"""Share of an effect or of a standard deviation that is negligible: added independently, it changes
the whole by 5e-5."""
FEW = 1 / 3
"""Share of the expected measurements below which too few were made."""
MAJORITY = 0.5
"""Share beyond which more are than are not."""
NEARLY_ALL = 0.9
"""Share from which the rest does not matter: a tenth less changes a standard deviation by 5 %."""
INSEPARABLE_CORRELATION = NEARLY_ALL**0.5
"""Correlation from which two numbers are hardly distinguished: one explains nine tenths of the
other's variance, and their combination is known 3.2 times better than each alone."""
CAUSE_SHARE = 0.3
"""Share of an effect from which a single cause is named beside others."""
NAMED_SHARE = 0.15
"""Share of the greatest of several changes, each in its prior sigma, from which a parameter is
named."""
OUTLIER_SIGMAS = 3.0
"""Standard deviations beyond which one of many measurements is an outlier: 3 in 1000 of normal
errors."""
CONTRADICTION_SIGMAS = 5.0
"""Standard deviations beyond which a statement is contradicted: 6 in 10^7 of normal errors."""
NOISE_EXCESS = 1.5
"""Ratio of errors to their standard deviations that is no reason for a report: standard deviations
contain noise, and shading and lenses add a few tenths in any images."""
UNEXPLAINED_SCALE = 4.0
"""Ratio of errors to their noise beyond which a model does not explain them; up to it standard
deviations are enlarged by the ratio."""
FALSE_ALARM = 0.005
"""Chance that a test of data that agree with their model finds anything: one session of two
hundred."""
OTHER_UNIT_RATIO = 10.0
"""Ratio of two lengths beyond which one is in another unit: inches for millimetres make 25.4, and
no nominal model is wrong by a factor of ten."""
LARGEST_NOMINAL_ERROR = 10.0
"""Largest error of a nominal model, in prior sigmas, which a file may state too small: beyond it
the model is another machine's, or the readings are wrong."""
FEWEST_EDGES = 24
"""Minimum number of edges of an estimate; a single image of a hexapod has as many."""
RELEVANT_FACTOR = 1.2
"""Factor on a standard deviation that matters: that of half as many images in addition."""
RELEVANT_SHARE = (1 - RELEVANT_FACTOR**-2) ** 0.5
"""Share of a standard deviation by one cause without which it would be smaller by
``RELEVANT_FACTOR``."""
ALIGNED_ANGLE = radians(10.0)
"""Angle (rad) to an axis or a plane within which a direction has its name."""
TRANSLATION_TURN = radians(3.0)
"""Rotation (rad) of a platform below which it only translates: misaligned axes rotate a platform
that should only shift."""
