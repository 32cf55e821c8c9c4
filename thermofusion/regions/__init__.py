"""Regions of interest: as drawn, and what they read."""

from .budget import BudgetRow, UncertaintyBudget, between_visits
from .measure import Difference, Measured, Measurer, Reading
from .region import Brush, Lasso, Line, Region, Slab, Spot, read_regions, write_regions

__all__ = [
    "Brush",
    "BudgetRow",
    "Difference",
    "Lasso",
    "Line",
    "Measured",
    "Measurer",
    "Reading",
    "Region",
    "Slab",
    "Spot",
    "UncertaintyBudget",
    "between_visits",
    "read_regions",
    "write_regions",
]
