"""What an unknown error of interferometer, calibration or detector may be a curve of, and how such a curve shows in the samples.

    path by OPD, row     b(x)·∂s/∂OPD           a stretched, bent or tilted scan; b zero at ZPD, in the middle row
    contrast by OPD      b(x)·fringes           self-apodisation, smear; b zero at ZPD, where the response counts
    wavenumber           ∫ b(σ)·R·B·exp(…) dσ   the calibrated response; with its mean, which is a curve of wavenumber too
    signal level, time   b(x)                   the detector's curve; a background that drifts

s is the linear signal; all but the last row pass through the declared non-linearity. A constant error of the path is phase, which
is fitted anyway.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.curves import EVENLY, TABLE, curves_of, even
from pipeline.residual_problem import Basis
from stages.reconstruction.panel_model import Model

Array = NDArray[np.float64]


def covariates_of(model: Model) -> dict[str, Basis]:
    """Curves by the name of their covariate; those that do not vary are left out."""
    s, instrument = model.samples, model.interferometer
    gain = model.gain()
    opd, signal = instrument.opd(s.row, s.col), model.signal()
    whole = np.ones((model.forward.wavenumber.size, 1))
    slope = gain * model.fringes_of(whole, slope=True)[:, 0]
    contrast = gain * model.fringes_of(whole)[:, 0]
    offset = 1.0 / s.sigma
    nowhere = np.full(opd.size, np.nan)  # the values stand with the path
    out = {
        "path by OPD": _along(opd, slope, 0.0, ("m", "path", "m")),
        "path by row": _along(s.row, slope, 0.5 * (instrument.rows - 1), ("row", "path", "m")),
        "contrast by OPD": _along(opd, contrast, 0.0, ("m", "contrast", "1"), nowhere),
        "wavenumber": _response(model, gain),
        "signal level": _along(signal, offset, None, ("DN", "signal", "DN")),
        "time": _along(s.time, offset, None, ("s", "signal", "DN")),
    }
    return {name: basis for name, basis in out.items() if basis is not None}


def _along(
    x: Array, shown: Array, origin: float | None, named: tuple[str, str, str], values: Array | None = None
) -> Basis | None:
    """Curves of x (n,), zero at `origin`, each times `shown` (n,); named: unit of x, what is a curve of it, and its unit."""
    curves = even(float(x.min()), float(x.max()))
    if curves is None:
        return None
    at = curves.table
    zero = 0.0 if origin is None else curves(np.array([origin]))
    return Basis.scaled(
        (curves(x) - zero) * shown[:, None], x if values is None else values, at, curves(at) - zero, named
    )


def _response(model: Model, gain: Array) -> Basis | None:
    """Curves of wavenumber, the straight line about the middle of the light, then the mean, then the bends."""
    wavenumber = model.forward.wavenumber
    power = (model.forward.radiance * model.calibration.response).mean(axis=0)
    share = np.cumsum(power) / power.sum()
    lit = np.interp((np.arange(EVENLY) + 0.5) / EVENLY, share, wavenumber)
    curves = curves_of(lit)
    if curves is None:
        return None

    def of(x: Array) -> Array:
        return np.insert(curves(x), 1, 1.0, axis=1)

    at = np.linspace(lit[0], lit[-1], TABLE)
    columns = gain[:, None] * model.fringes_of(of(wavenumber))
    return Basis.scaled(columns, np.full(gain.size, np.nan), at, of(at), ("m-1", "response", "1"))
