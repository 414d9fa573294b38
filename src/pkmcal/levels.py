"""Levels that decisions of all packages share: what is rounding, negligible, few, a majority, or
more than noise.

Probabilities of false alarms are in :mod:`pkmcal.identify.false_alarm` and, of hypotheses, in
:mod:`pkmcal.outcome.hypotheses`. Limits of one algorithm are fields of its options.
Half or twice a level was tried only where its docstring gives the result.
"""

from __future__ import annotations

from math import atan, radians

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
NAMED_SHARE = NEGLIGIBLE**0.5
"""Share of the greatest of several changes, each in its own unit, from which a change is named: the
square of a smaller one is negligible beside the square of the greatest."""
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
LARGEST_NOMINAL_ERROR = UNEXPLAINED_SCALE * OUTLIER_SIGMAS
"""Largest error of a nominal model, in prior sigmas, beyond which the model is another machine's,
or the readings are wrong: 12. As of any standard deviation, the errors may be UNEXPLAINED_SCALE
times as large as a file states, and beyond OUTLIER_SIGMAS of those there is an outlier."""
FEWEST_EDGES = 24
"""Minimum number of edges of an estimate: with two numbers each, as many as the 48 unknowns of a
hexapod, two joint centres and an offset for each leg, and of its camera's pose."""
RELEVANT_FACTOR = 1.2
"""Factor on a standard deviation that matters: that of half as many images in addition."""
RELEVANT_SHARE = (1 - RELEVANT_FACTOR**-2) ** 0.5
"""Share of a standard deviation by one cause without which it would be smaller by
``RELEVANT_FACTOR``."""
CAUSE_SHARE = RELEVANT_SHARE**2
"""Share of a variance, or of the information, from which a single cause is named: without it the
standard deviation would differ by ``RELEVANT_FACTOR``."""
ALIGNED_ANGLE = atan(NAMED_SHARE)
"""Angle (rad) to an axis or a plane within which a direction has its name: its part across is less
than NAMED_SHARE of that along."""
TRANSLATION_TURN = radians(3.0)
"""Rotation (rad) of a platform below which it only translates: misaligned axes rotate a platform
that should only shift. It decides the words of an advice and which cells of a map are drawn, no
figure and no refusal."""
