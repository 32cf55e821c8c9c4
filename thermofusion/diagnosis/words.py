"""What a diagnosis says."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Diagnosis:
    """One fault. size_K : its effect on readings, K, None where none is known. size : the fault's own, in `unit`."""

    what: str
    evidence: str
    size_K: float | None
    where: str
    done: str
    advice: str = ""
    size: float | None = None
    unit: str = ""

    def line(self) -> str:
        """For the terminal."""
        sizes = [] if self.size is None else [f"{self.size:.3g} {self.unit}"]
        sizes += [] if self.size_K is None else [f"{self.size_K:.2f} K"]
        size = f" ({', '.join(sizes)})" if sizes else ""
        return f"{self.what}{size}, {self.where}: {self.done}; {self.advice}"
