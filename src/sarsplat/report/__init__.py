"""A run's report: pictures, scores and settings on one page that needs no network."""

from sarsplat.report.compare import Comparison, compare, write_comparison
from sarsplat.report.images import Look, decibel_png
from sarsplat.report.sheet import contact_sheet
from sarsplat.report.write import write_report

__all__ = ["Comparison", "Look", "compare", "contact_sheet", "decibel_png", "write_comparison", "write_report"]
