"""Public functions of ``import pkmcal``: the commands' work, with results that have a summary."""
