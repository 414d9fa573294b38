"""What commands found, as pages for people; :mod:`pkmcal.report.page` is the one of all of them."""
