"""What the closed loop is offered of a laboratory interferogram: our spectrum beside the vendor's, after one fitted scale.

    r(σ) = √k·(B(σ; θ) − c·B_vendor(σ))/‖B(σ; 0)‖,        RMS of r = relative error after one scale

Effects (docs/campaign-format.md): detector_nonlinearity, recorded u = v·(1 − a·v) with v relative to its own largest deviation;
opd_scale, true OPD = (1 + scale)·stated; response_scale, which is the fitted scale's own and cannot be seen. Of the two
inverses of a non-linearity (stages/bench/bench.py) the one that can meet the vendor's spectrum better is taken.

Functions
---------
residual_problem    of a bench record with a vendor's spectrum
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from pipeline.errors import InputError
from pipeline.records import Bench
from pipeline.residual_problem import Candidate, Parameter, Parameters, ResidualProblem
from stages.bench.bench import BenchSettings, choose, corrected, find_zpd, linear
from stages.bench.covariates import covariates_of
from tsmftis import fourier
from tsmftis.effects import EFFECTS

Array = NDArray[np.float64]

ACCURACY = 3e-5  # of our spectrum against the vendor's where nothing is missing: measured 0.4 to 1.8e-5
BANDS = 8
STRIDE = 4  # of a twice zero-filled spectrum's wavenumbers one is taken: about the width of a window's line
PLAUSIBLE = {"detector_nonlinearity": 0.01, "opd_scale": 1e-4, "response_scale": 0.01}
FAINTEST = 2e-3  # of the brightest: below it a phase is noise, and the spectrum jumps with any parameter
STEP = {"detector_nonlinearity": 1e-3, "opd_scale": 1e-7, "response_scale": 1e-3}
LARGEST_A = 0.24  # beyond a quarter the recorded signal is no longer a function of the true one


def _spectrum(
    bench: Bench,
    settings: BenchSettings,
    scans: Array,
    zpd: Array,
    wavenumber: Array,
    parameters: Parameters,
    exact: bool,
) -> Array:
    a = parameters.get("detector_nonlinearity", {}).get("a", 0.0)
    stretch = 1.0 + parameters.get("opd_scale", {}).get("scale", 0.0)
    options, _ = choose(bench, settings, zpd)
    made = corrected(linear(scans, a, exact) if a else scans, bench.opd * stretch, zpd * stretch, wavenumber, options)
    return settings.normalisation_per_m * made.mean(axis=0)


def residual_problem(bench: Bench, settings: BenchSettings | None = None) -> ResidualProblem:
    """r (k,) over the reference's wavenumbers in eight bands; InputError without a reference."""
    settings = settings or BenchSettings()
    every, vendor = _reference(bench)
    stride = max((bench.zero_filling or 1) // 2, 1) * STRIDE
    wavenumber, reference = every[::stride], vendor[::stride]
    used = reference > FAINTEST * reference.max()
    everywhere = _maker(bench, settings, wavenumber)

    def made(parameters: Parameters, exact: bool) -> Array:
        return everywhere(parameters, exact)[used]

    null, wavenumber, reference = made({}, False), wavenumber[used], reference[used]
    unit = np.sqrt(reference.size) / float(np.linalg.norm(null))
    share = float(null @ reference / (reference @ reference))
    reference = share * reference
    exact = _is_exact(made, reference)

    def residual(parameters: Parameters) -> Array:
        scale = 1.0 + parameters.get("response_scale", {}).get("scale", 0.0)
        return unit * (made(parameters, exact) - scale * reference)

    candidates = []
    for name, step in STEP.items():
        effect = EFFECTS[name]
        candidates.append(
            Candidate(
                name,
                {
                    key: Parameter(
                        effect.units[key],
                        LARGEST_A if name == "detector_nonlinearity" else effect.largest[key],
                        plausible=PLAUSIBLE[name],
                        step=step,
                    )
                    for key in effect.units
                },
            )
        )
    band = np.minimum(np.arange(wavenumber.size) * BANDS // wavenumber.size, BANDS - 1)
    edges = [*(wavenumber[band == i][0] for i in range(BANDS)), wavenumber[-1]]
    return ResidualProblem(
        stage="spectral",
        residual=residual,
        candidates=tuple(candidates),
        group=band,
        series=np.zeros(wavenumber.size, int),
        time=wavenumber,
        nuisance=unit * reference[:, None],
        covariates=covariates_of(bench, settings, every[::stride], used, reference, unit),
        floor=ACCURACY,
        unit="of the spectrum",
        group_names={i: f"{edges[i]:.0f}–{edges[i + 1]:.0f} m-1" for i in range(BANDS)},
    )


def _reference(bench: Bench) -> tuple[Array, Array]:
    """Wavenumbers and spectrum of the vendor; InputError where there are none."""
    if bench.wavenumber is None or bench.reference is None:
        raise InputError(
            "bench",
            "variable 'reference'",
            "is missing",
            "a bench interferogram needs another spectrum to be held against",
        )
    return bench.wavenumber, bench.reference


Maker = Callable[[Parameters, bool], Array]


def _maker(bench: Bench, settings: BenchSettings, wavenumber: Array) -> Maker:
    """(parameters, form of the non-linearity) → spectrum (k,)."""
    scans = fourier.remove_constant(bench.interferogram, bench.opd, 0)
    zpd = find_zpd(scans, bench.opd)
    return lambda parameters, exact: _spectrum(bench, settings, scans, zpd, wavenumber, parameters, exact)


def _missed(spectrum: Array, reference: Array) -> float:
    """‖s·B − B_vendor‖/‖B_vendor‖ after one fitted scale."""
    scale = float(spectrum @ reference / (spectrum @ spectrum))
    return float(np.linalg.norm(scale * spectrum - reference) / np.linalg.norm(reference))


def _is_exact(made: Maker, reference: Array) -> bool:
    """Which form of the non-linearity can meet the reference better: decided once, so that the residual stays smooth in a."""
    if _missed(made({}, False), reference) <= ACCURACY:
        return True
    best = {}
    for exact in (True, False):
        found = minimize_scalar(
            lambda a, form=exact: _missed(made({"detector_nonlinearity": {"a": float(a)}}, form), reference),
            bounds=(-LARGEST_A, LARGEST_A),
            method="bounded",
            options={"maxiter": 25, "xatol": 1e-5},
        )
        best[exact] = float(found.fun)
    return best[True] <= best[False]
