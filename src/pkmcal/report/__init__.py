"""The report: an estimate as one HTML page that a person wants to read.

Each section has a module that turns the estimate into small frozen views, and a template that
shows them; :mod:`pkmcal.report.page` puts them together.
"""

from pkmcal.report.page import report_html

__all__ = ["report_html"]
