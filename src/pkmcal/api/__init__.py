"""What ``import pkmcal`` gives: the commands' work as functions, results that show themselves."""
