"""What an unknown error of a laboratory instrument may be a curve of, and how such a curve shows in its spectrum.

    path by OPD       true path difference = stated + b(x)         b zero at ZPD; the straight line is opd_scale
    contrast by OPD   recorded interferogram = true · (1 + b(x))   b zero at ZPD: self-apodisation
    signal level      recorded = true + D·b(v/D)                   the detector's curve
    wavenumber        our spectrum = vendor's · (1 + b(σ))         the response

v is the interferogram free of its mean, D its largest deviation. A straight line of the signal and a constant response are the
one scale that is fitted anyway, and no curves.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pipeline.curves import Curves, even
from pipeline.records import Bench
from pipeline.residual_problem import Basis
from stages.bench.bench import BenchSettings, choose, corrected, find_zpd
from tsmftis import fourier

Array = NDArray[np.float64]

PATH_STEP = 1e-9  # m
SIGNAL_STEP = 1e-4  # relative


def covariates_of(
    bench: Bench, settings: BenchSettings, wavenumber: Array, used: NDArray[np.bool_], reference: Array, unit: float
) -> dict[str, Basis]:
    """Curves by the name of their covariate, as they show in r = unit·(B − B_vendor) on wavenumber[used]."""
    scans = fourier.remove_constant(bench.interferogram, bench.opd, 0)
    zpd = find_zpd(scans, bench.opd)
    options, _ = choose(bench, settings, zpd)
    x, half, largest = bench.opd - zpd.mean(), options.half_length, np.abs(scans).max(axis=1, keepdims=True)
    signal, seen = scans / largest, wavenumber[used]

    def made(interferogram: Array, opd: Array) -> Array:
        spectra = corrected(interferogram, opd, zpd, wavenumber, options)
        return np.asarray(unit * settings.normalisation_per_m * spectra.mean(axis=0)[used])

    path = _even(max(x[0], -half), min(x[-1], half))
    level, colour = _even(float(signal.min()), float(signal.max())), _even(float(seen[0]), float(seen[-1]))
    of_path, of_level = _through(path, x), _bent(level, signal)
    nowhere = np.full(seen.size, np.nan)  # a wavenumber has no path difference, and no signal, of its own
    return {
        "path by OPD": Basis.scaled(
            _taken_out(lambda b: made(scans, bench.opd + b), PATH_STEP, of_path),
            nowhere,
            path.table,
            _through(path, path.table),
            ("m", "path", "m"),
        ),
        "contrast by OPD": Basis.scaled(
            _taken_out(lambda b: made(scans * (1.0 - b), bench.opd), SIGNAL_STEP, of_path),
            nowhere,
            path.table,
            _through(path, path.table),
            ("m", "contrast", "1"),
        ),
        "signal level": Basis.scaled(
            _taken_out(lambda b: made(scans - largest * b, bench.opd), SIGNAL_STEP, of_level),
            nowhere,
            level.table,
            _bent(level, level.table),
            ("1", "signal", "1"),
        ),
        "wavenumber": Basis.scaled(
            unit * reference[:, None] * colour(seen),
            seen,
            colour.table,
            colour(colour.table),
            ("m-1", "response", "1"),
        ),
    }


def _taken_out(made: Callable[[Array], Array], step: float, curves: Array) -> Array:
    """−∂r/∂size (k, m) of curves (…, m); `made` is the spectrum over its unit once a curve (…) is taken out."""
    each = np.moveaxis(curves, -1, 0)
    return np.column_stack([(made(-step * b) - made(step * b)) / (2.0 * step) for b in each])


def _even(low: float, high: float) -> Curves:
    curves = even(low, high)
    assert curves is not None  # there is a burst, and light at many wavenumbers
    return curves


def _through(curves: Curves, x: Array) -> Array:
    """Curves (n, m) that are zero at zero."""
    return curves(x) - curves(np.zeros(1))


def _bent(curves: Curves, signal: Array) -> Array:
    """Splines of the signal (…) without their straight line (…, m), zero at zero."""
    return _through(curves, signal.ravel())[:, 1:].reshape(*signal.shape, -1)
