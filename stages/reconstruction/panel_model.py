"""The forward model of panels' interferograms: what samples should be at any parameters, with phase and levels fitted anew.

    r = [d − s·(1 − a·flat·s/12000)]/sigma,    s = level + Re ∫ R(σ)·B_ref(σ)·exp(i(2πσ·OPD(row, col) + φ(σ))) dσ

Classes
-------
PanelSamples    what was recorded
Model           what should have been, and its derivatives
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from pipeline.records import Calibration
from pipeline.residual_problem import Parameters
from stages.reconstruction.forward import Forward
from stages.reconstruction.spectra import ReconstructionSettings
from tsmftis import detector
from tsmftis.interferometer import Interferometer, response_with_effects

Array = NDArray[np.float64]
Index = NDArray[np.int64]

LEVEL_ORDER = 2  # at least
SPARE = 0.06  # of the range of path differences that the table holds on either side
FIRST_TURNS, TURNS, LEVEL_TURNS = 8, 2, 3  # of φ at the null and elsewhere, of the level at each


@dataclass(frozen=True)
class PanelSamples:
    """Interferograms of panels, sample by sample (n,), ordered by interferogram and column.

    value: mean over pixels of signal after dark over flat [DN], sigma its noise, flat the mean flat; mean row and its variance,
    column, mean time; `interferogram` numbers them, `spectrum` is the row of Forward.radiance.
    """

    value: Array
    sigma: Array
    flat: Array
    row: Array
    row_variance: Array
    col: Array
    time: Array
    interferogram: Index
    spectrum: Index
    names: tuple[str, ...]


@dataclass(frozen=True)
class Model:
    """The forward model of samples: `levels` (n, p) their columns over sigma, `basis` orthonormal of the same span; at the null
    the phase's coefficients and the level over sigma (n,)."""

    samples: PanelSamples
    forward: Forward
    calibration: Calibration
    interferometer: Interferometer
    levels: Array
    basis: Array
    phase: Array
    level: Array

    @classmethod
    def of(
        cls,
        samples: PanelSamples,
        radiance: Array,
        calibration: Calibration,
        interferometer: Interferometer,
        settings: ReconstructionSettings,
    ) -> Model:
        opd = interferometer.opd(samples.row, samples.col)
        spare = SPARE * float(np.ptp(opd))
        order = settings.phase_order
        forward = Forward(calibration.wavenumber, radiance, opd.min() - spare, opd.max() + spare, order)
        u = 2.0 * samples.col / (interferometer.cols - 1) - 1.0
        own = samples.interferogram[:, None] == np.arange(len(samples.names))
        powers = range(max(settings.drift_order, LEVEL_ORDER) + 1)
        levels = np.column_stack([own * (u**k / samples.sigma)[:, None] for k in powers])
        basis, _ = np.linalg.qr(levels)
        phase, level = np.zeros(order + 1), basis @ (basis.T @ (samples.value / samples.sigma))
        start = cls(samples, forward, calibration, interferometer, levels, basis, phase, level)
        # The constant phase that fits best first: cos φ₀·I + sin φ₀·∂I/∂c₀.
        columns = start.cleared(start.fringes({}, phase, True)[:, :2])
        share = np.linalg.lstsq(columns, start.cleared(start.data), rcond=None)[0]
        start = replace(start, phase=np.append(np.arctan2(share[1], share[0]), np.zeros(order)))
        for _ in range(FIRST_TURNS):
            phase, level, _ = start.fitted({}, 1)
            start = replace(start, phase=phase, level=level)
        return start

    @property
    def data(self) -> Array:
        """d over sigma (n,)."""
        return self.samples.value / self.samples.sigma

    def cleared(self, columns: Array) -> Array:
        """Columns (n, …) without what the levels take up."""
        return np.asarray(columns - self.basis @ (self.basis.T @ columns), float)

    def recorded(self, linear: Array, parameters: Parameters) -> Array:
        """What the detector makes of a linear signal over sigma (n,)."""
        a = self.interferometer.with_effects(parameters).detector_nonlinearity
        s = self.samples
        return np.asarray(linear * (1.0 - a / detector.NONLINEARITY_SCALE * s.flat * s.sigma * linear), float)

    def gain(self) -> Array:
        """How a change of the linear signal shows in the recorded one, at the null (n,)."""
        a = self.interferometer.detector_nonlinearity
        s = self.samples
        return np.asarray(1.0 - 2.0 * a / detector.NONLINEARITY_SCALE * s.flat * self.signal(), float)

    def signal(self) -> Array:
        """The linear signal [DN] at the null (n,)."""
        return np.asarray((self.level + self.fringes({}, self.phase, False)[:, 0]) * self.samples.sigma, float)

    def fringes(self, parameters: Parameters, phase: Array, derivatives: bool) -> Array:
        """Fringes over sigma, and their derivatives by the phase's coefficients (n, 1 or order + 2)."""
        instrument = self.interferometer.with_effects(parameters)
        response = response_with_effects(self.calibration.wavenumber, self.calibration.response, parameters)
        opd = instrument.opd(self.samples.row, self.samples.col)
        forward = self.forward
        if opd.min() < forward.low or opd.max() > forward.high:
            forward = replace(forward, low=min(forward.low, opd.min()), high=max(forward.high, opd.max()))
        return self._sampled(forward.tables(response, phase, derivatives), instrument, opd, 0)

    def fringes_of(self, shares: Array, slope: bool = False) -> Array:
        """Fringes over sigma (n, m), at the null, of the response times each of `shares` (k, m); slope: by path [m-1]."""
        s, response = self.samples, self.calibration.response
        opd = self.interferometer.opd(s.row, s.col)
        tables = [self.forward.tables(response * one, self.phase, False)[0] for one in shares.T]
        return self._sampled(tables, self.interferometer, opd, int(slope))

    def _sampled(self, tables: Sequence[CubicSpline], instrument: Interferometer, opd: Array, derivative: int) -> Array:
        """Tables over the path difference at each sample's own spectrum, over sigma (n, tables)."""
        each, spectrum = np.arange(opd.size), self.samples.spectrum
        out = np.stack([t(opd, derivative)[each, spectrum] for t in tables], -1)
        middle = 2.0 * np.pi * float(self.forward.wavenumber.mean()) * instrument.fringe_tilt
        blurred = np.exp(-0.5 * middle**2 * self.samples.row_variance)
        return np.asarray(out * (blurred / self.samples.sigma)[:, None], float)

    @cached_property
    def step(self) -> Array:
        """(order + 1, n): what a residual says of the phase, at the null."""
        return np.asarray(np.linalg.pinv(self.cleared(self.phase_columns())), float)

    def fitted(self, parameters: Parameters, turns: int) -> tuple[Array, Array, Array]:
        """Phase, level and r (n,) with both fitted, by steps with the derivatives at the null: what they leave lies along the
        nuisance's columns."""
        phase, level = self.phase, self.level
        for turn in range(turns + 1):
            fringes = self.fringes(parameters, phase, False)[:, 0]
            for _ in range(LEVEL_TURNS):
                left = self.data - self.recorded(level + fringes, parameters)
                level = level + self.basis @ (self.basis.T @ left)
            left = self.data - self.recorded(level + fringes, parameters)
            if turn < turns:
                phase = phase + self.step @ left
        return phase, level, left

    def residual(self, parameters: Parameters) -> Array:
        """r (n,)."""
        return self.fitted(parameters, TURNS)[2]

    def phase_columns(self) -> Array:
        """∂r/∂c (n, order + 1) at the null."""
        return self.fringes({}, self.phase, True)[:, 1:]
