"""What the data say against the model: named faults, their size, what was done, and what a user can do."""

from .diagnose import VOCABULARY, diagnose
from .words import Diagnosis

__all__ = ["VOCABULARY", "Diagnosis", "diagnose"]
