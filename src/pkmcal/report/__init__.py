"""What commands found, as pages that a person wants to read: :mod:`pkmcal.report.page` is the one page."""
