"""Plot of the tool's standard deviation against the number of configurations of a plan."""

from __future__ import annotations

from pkmcal.outcome.blocks.plot import (
    DotsMark,
    LineMark,
    Plot,
    Point,
    RuleMark,
    line_points,
    log_axis,
    rounded,
)
from pkmcal.planning.plan import MeasurementPlan
from pkmcal.wording import brief


def curve_plot(plan: MeasurementPlan) -> Plot:
    """Standard deviation of the best configurations, and of as many by chance."""
    here = plan.promised
    x = [float(accuracy.count) for accuracy in plan.curve]
    y = [accuracy.position * 1e3 for accuracy in plan.curve]
    chance = plan.by_chance.position * 1e3
    configurations = "configurations" + ("" if plan.subject.handheld else " from each place")
    best = tuple(
        Point(x=n, y=rounded(sigma), tip=f"{n:g} {configurations}: {brief(sigma)} mm")
        for n, sigma in zip(x, y, strict=True)
    )
    by_chance = Point(
        x=float(here.count), y=rounded(chance), tip=f"{here.count:g} by chance: {brief(chance)} mm"
    )
    return Plot(
        name="curve",
        title="How σ falls with the number of configurations",
        caption="Mean over the workspace, both axes logarithmic: by chance alone, four times as"
        " many halve it. Up to this plan's number the best of the plan; beyond it, each again.",
        alt="The tool's standard deviation against the number of"
        f" {configurations}, from {brief(y[0])} to {brief(y[-1])} mm; the table has the numbers",
        x=log_axis(configurations, x),
        y=log_axis("σ of the tool's position, mm", (*y, chance)),
        marks=(
            RuleMark(name="this plan", axis="x", at=float(here.count), colour="quiet"),
            LineMark(name="", colour="calibrated", points=line_points(x, y)),
            DotsMark(name="the best", colour="calibrated", points=best, radius=3),
            DotsMark(
                name="by chance", colour="nominal", points=(by_chance,), symbol="cross", radius=5
            ),
        ),
    )
