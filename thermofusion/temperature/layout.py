"""Where each unknown of the cross-calibration stands in its parameter vector."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Layout:
    """p = [offsets, field, shape, gain, sensor]: one offset a view (or one for all), combinations of field patterns, s,
    γ, and the coefficients of a sensor's `Pattern` where there is one."""

    n_offsets: int
    n_patterns: int
    n_sensor: int = 0

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.n_offsets + self.n_patterns + 2 + self.n_sensor

    @property
    def offsets(self) -> slice:
        """b, W m-2 sr-1."""
        return slice(0, self.n_offsets)

    @property
    def field(self) -> slice:
        """Coefficients of φ, W m-2 sr-1."""
        return slice(self.n_offsets, self.n_offsets + self.n_patterns)

    @property
    def linear(self) -> slice:
        """Offsets and field together: all that is a radiance."""
        return slice(0, self.n_offsets + self.n_patterns)

    @property
    def shape(self) -> int:
        """s, dimensionless."""
        return self.n_offsets + self.n_patterns

    @property
    def gain(self) -> int:
        """γ, dimensionless."""
        return self.n_offsets + self.n_patterns + 1

    @property
    def shared(self) -> slice:
        """All that views have in common: field, shape, gain."""
        return slice(self.n_offsets, self.n_offsets + self.n_patterns + 2)

    @property
    def sensor(self) -> slice:
        """Coefficients of the sensor's pattern, W m-2 sr-1."""
        return slice(self.size - self.n_sensor, self.size)
