"""The closed loop on a real chamber log of a consumer unit: does the history of temperature explain what no curve of it can?

    python benchmarks/loop_chamber.py FILE        tofupilot_imu_raw_data.csv, see chamber_log.py

All six channels at once, as the thermal stage offers them; three branches: none is sealed, and only RMS decides.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from chamber_log import read

from pipeline.records import Chamber, Temperatures
from pipeline.residual_problem import Parameters, ResidualProblem
from stages.closed_loop import LoopSettings, refit, run
from stages.thermal import ThermalSettings, residual_problem
from stages.thermal.targets import CHANNELS


def chamber(path: Path) -> Chamber:
    """The log as a chamber run: one thermometer for the whole unit, no attitude; each stamp once."""
    time, channels, temperature = read(path)
    order = np.argsort(time, kind="stable")
    used = order[np.diff(time[order], prepend=-1.0) > 0.0]
    t, warm = time[used], temperature[used]
    readings = Temperatures(t, np.tile(warm[:, None, None], (1, 3, 1)), np.tile(warm[:, None], (1, 3)))
    return Chamber(path.stem, t, channels[used, :3], channels[used, 3:], readings, None, None)


def by_channel(problem: ResidualProblem, parameters: Parameters) -> list[float]:
    """RMS of each channel in the branches held out, in noises of a block; curves and effects are those of the other branches."""
    effects = {effect: dict(values) for effect, values in parameters.items()}
    labels, squares = np.unique(problem.channel), np.zeros(6)
    for branch in np.unique(problem.group):
        r = problem.residual(refit(problem, effects, [int(branch)]) if effects else {})
        for i, one in enumerate(labels):
            mine = problem.channel == one
            columns, held = problem.nuisance[mine], problem.group[mine] == branch
            columns = columns[:, columns.any(axis=0)]
            beta = np.linalg.lstsq(columns[~held], r[mine][~held], rcond=None)[0]
            squares[i] += float(np.sum((r[mine][held] - columns[held] @ beta) ** 2))
    return np.sqrt(squares[: labels.size] * labels.size / problem.group.size).tolist()


def main() -> None:
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    problem = residual_problem([chamber(Path(sys.argv[1]))], [], ThermalSettings())
    result = run(problem, LoopSettings(), 1)
    print(f"{result.verdict}; held out: {', '.join(problem.group_names.values())}")
    for step in result.steps:
        values = ", ".join(f"{k} {v.value:.4g} ± {v.sigma:.2g} {v.unit}" for k, v in step.parameters.items())
        print(f"  {step.effect}: {values}\n    {step.evidence}")
    for limit in result.not_identifiable:
        print(f"  {' / '.join(limit.effects)}: {limit.why}; would separate: {limit.would_separate}")
    for note in result.notes:
        print(f"  {note}")
    before, after = by_channel(problem, {}), by_channel(problem, result.values)
    for name, a, b in zip(CHANNELS, before, after, strict=True):
        print(f"  {name}: held-out RMS {a:.3g} → {b:.3g} noises of a block")


if __name__ == "__main__":
    main()
