"""The closed loop on a real chamber log of a consumer unit: does the history of temperature explain what no curve of it can?

    python benchmarks/loop_chamber.py FILE        tofupilot_imu_raw_data.csv, see chamber_log.py

Each channel alone, 10 s means; nuisance a cubic of T; groups the three branches; candidates a play (backlash operator) and a
first-order lag of T, both on a grid; covariates dT/dt and time. Three branches: none is sealed, and only RMS decides.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from chamber_log import BLOCK, SMOOTHING, branches, read
from closed_loop import play

from pipeline.residual_problem import Candidate, Parameter, Parameters, ResidualProblem
from stages.closed_loop import LoopSettings, run
from stages.thermal.features import smoothed
from stages.thermal.targets import CHANNELS, block_means


def lagged(time: np.ndarray, temperature: np.ndarray, lag: float) -> np.ndarray:
    """First-order lag [s] of the temperature, started at its first value."""
    out = temperature.copy()
    share = np.exp(-np.diff(time) / lag)
    for i in range(1, out.size):
        out[i] = share[i - 1] * out[i - 1] + (1.0 - share[i - 1]) * temperature[i]
    return out


def channel_problem(
    time: np.ndarray, y: np.ndarray, t: np.ndarray, rate: np.ndarray, branch: np.ndarray
) -> ResidualProblem:
    """Of one channel (n,): value × (play − T)/half width, and value × (lagged T − T)/10 K."""
    spread = float(y.std())

    def residual(parameters: Parameters) -> np.ndarray:
        r = y - y.mean()
        if (p := parameters.get("thermal_hysteresis")) is not None:
            h = max(p.get("half_width", 0.0), 1e-3)
            r = r - p.get("value", 0.0) * (play(t, h) - t) / h
        if (p := parameters.get("thermal_lag")) is not None:
            r = r - p.get("value", 0.0) * (lagged(time, t, max(p.get("lag", 0.0), 1e-3)) - t) / 10.0
        return r

    value = Parameter("of the channel", 5.0 * spread, plausible=spread)
    width = Parameter("K", 60.0, smallest=0.3, plausible=20.0, step=0.3)
    lag = Parameter("s", 3000.0, smallest=1.0, plausible=300.0, step=3.0)
    return ResidualProblem(
        stage="thermal",
        residual=residual,
        candidates=(
            Candidate(
                "thermal_hysteresis",
                {"half_width": width, "value": value},
                tuple({"half_width": h} for h in (2.0, 5.0, 10.0, 20.0, 35.0)),
            ),
            Candidate(
                "thermal_lag", {"lag": lag, "value": value}, tuple({"lag": v} for v in (30.0, 100.0, 300.0, 900.0))
            ),
        ),
        group=branch,
        series=np.zeros(branch.size, int),
        time=time,
        nuisance=np.polynomial.legendre.legvander(2.0 * (t - t.mean()) / np.ptp(t), 3),
        covariates={"dT/dt": rate, "time": time},
        unit="rad/s or m/s²",
    )


def main() -> None:
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    time, channels, temperature = read(Path(sys.argv[1]))
    value, rate = smoothed(time, temperature[:, None], time, SMOOTHING)
    means = block_means(time, np.column_stack([channels, value, rate, branches(time, temperature), time]), BLOCK)
    branch = np.round(means[:, 8]).astype(int)
    for i, name in enumerate(CHANNELS):
        problem = channel_problem(means[:, 9], means[:, i], means[:, 6], means[:, 7], branch)
        result = run(problem, LoopSettings(), 1)
        print(f"{name}: {result.verdict}; held-out RMS {result.rms_before:.4g} → {result.rms_after:.4g}")
        for step in result.steps:
            values = ", ".join(f"{k} {v.value:.4g} ± {v.sigma:.2g} {v.unit}" for k, v in step.parameters.items())
            print(f"    {step.effect}: {values}\n        {step.evidence}")
        for limit in result.not_identifiable:
            print(f"    {' / '.join(limit.effects)}: {limit.why}; would separate: {limit.would_separate}")
        for note in result.notes:
            print(f"    {note}")


if __name__ == "__main__":
    main()
