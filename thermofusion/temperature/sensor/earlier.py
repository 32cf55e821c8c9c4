"""What is known of a camera's field before a scan: how large fields are, and what an earlier scan of it found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...recipe import EarlierFieldSection
from ...types import Float
from .field import ImageField
from .pattern import Pattern
from .shown import table

FIELD_PRIOR_K = {1: 0.15, 2: 0.15, 3: 0.07, 4: 0.07}  # rms of a field pattern by polynomial order; 0.1-0.3 K together
CHANGES = np.geomspace(0.03, 3.0, 41)  # by which a field may have changed, over what fields are
CHANGED_AT_ALL = 0.5  # beyond it the earlier field says no more than that fields are small
SAME_CAMERA = "give --field a result of the same camera"


def usual_K(field: ImageField) -> Float:
    """(K,) rms of each pattern of a field, as cameras have it."""
    return np.array([FIELD_PRIOR_K[n] for n in field.orders])


@dataclass(frozen=True, eq=False)
class FieldPrior:
    """The field's coefficients before the data, independent: mean (K,), W m-2 sr-1; precision (K,), 1/variance."""

    mean: Float
    precision: Float

    @classmethod
    def wide(cls, field: ImageField, slope_L: float) -> FieldPrior:
        """Of a camera that nothing is known of. slope_L : dL/dT, W m-2 sr-1 K-1."""
        usual = usual_K(field) * slope_L
        return cls(np.zeros(len(usual)), usual**-2.0)


@dataclass(frozen=True, eq=False)
class EarlierField:
    """The camera's field in an earlier scan: mean and sigma (K,), W m-2 sr-1; usual : (K,) what fields are."""

    mean: Float
    sigma: Float
    usual: Float

    @classmethod
    def of(cls, section: EarlierFieldSection | None, field: ImageField, slope_L: float) -> EarlierField | None:
        """As a recipe states it; None where it states none. Raises ScanError for a field of another image."""
        if section is None:
            return None
        refuse_another_image(section, field.width_px, field.height_px)
        return cls(np.array(section.K) * slope_L, np.array(section.sigma_K) * slope_L, usual_K(field) * slope_L)

    def change(self, found: Float, covariance: Float) -> float:
        """Share of the usual size of fields by which this one changed since: the mean over its likelihood.

        found (K,), covariance (K, K) : as the scan alone has it. The difference is spread as covariance + sigma² +
        share²·usual²; shares are alike likely on a logarithmic scale, and none is below the first of `CHANGES`.
        """
        off, own = found - self.mean, covariance + np.diag(self.sigma**2)
        log = np.empty(len(CHANGES))
        for k, share in enumerate(CHANGES):
            values, vectors = np.linalg.eigh(own + np.diag((share * self.usual) ** 2))
            log[k] = -0.5 * np.sum(np.log(values) + (vectors.T @ off) ** 2 / values)
        weight = np.exp(log - log.max())
        return float(weight @ CHANGES / weight.sum())

    def prior(self, change: float) -> FieldPrior:
        """What it says of a field that changed by such a share since."""
        return FieldPrior(self.mean, 1 / (self.sigma**2 + (change * self.usual) ** 2))


def refuse_another_image(section: EarlierFieldSection, width_px: int, height_px: int) -> None:
    """Raises ScanError if an earlier field is not of thermal images of this size."""
    if (section.width_px, section.height_px) != (width_px, height_px):
        raise ScanError(
            f"the earlier field is of {section.width_px} x {section.height_px} px, the thermal images of "
            f"{width_px} x {height_px}",
            hint=SAME_CAMERA,
        )


def handed_on(field: ImageField, sensor: Pattern | None, covariance: NDArray, slope_L: float) -> EarlierFieldSection:
    """A field for the next scan's recipe, with the smooth part of a fixed pattern.

    covariance : (K, K) of the field's coefficients, (W m-2 sr-1)². slope_L : dL/dT, W m-2 sr-1 K-1.
    """
    shown = table(field, sensor, slope_L)
    v, u = (a.ravel() for a in np.meshgrid(shown["v_px"], shown["u_px"], indexing="ij"))
    columns = np.column_stack([np.ones(len(u)), field.patterns(u, v)])
    K = np.linalg.lstsq(columns, shown["K"].ravel(), rcond=None)[0][1:]
    sigma_K = np.sqrt(np.maximum(np.diag(covariance), 0.0)) / slope_L
    sigma_K = np.where(sigma_K > 0, sigma_K, usual_K(field))  # what was held is not known to be zero
    return EarlierFieldSection(
        K=tuple(np.round(K, 5).tolist()),
        sigma_K=tuple(np.round(sigma_K, 5).tolist()),
        width_px=field.width_px,
        height_px=field.height_px,
    )
