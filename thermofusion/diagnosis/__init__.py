"""What the data say against the model: named faults, their size, what was done, and what a user can do."""

from .diagnose import diagnose
from .poses import of_knocks, of_poses
from .words import VOCABULARY, Diagnosis

__all__ = ["VOCABULARY", "Diagnosis", "diagnose", "of_knocks", "of_poses"]
