"""Certification of the spectral residual: what the loop invents, finds, confuses and says when the name is not in its library.

    python benchmarks/loop_spectral.py [--trials 20] [--clean 60] [--seed 1] [--part clean found missing together] [--only EFFECT]

Frames of two lines are made with the simulator's light and detector: seven panels of 9 × 9 pixels each wander over a detector of
64 × 128 pixels, with tracks that err by 0.3 pixel. A size is in sigma: the Cramér–Rao bound with levels, phase and all other
candidates estimated (a fringe's amplitude at its thickness). With --part missing the effect is taken out of the library.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from pipeline.records import Calibration, Frames, References, Targets, Tracks
from pipeline.residual_problem import ResidualProblem
from stages import reconstruction
from stages.closed_loop import LoopSettings, run
from stages.simulation import SimulationSettings
from stages.simulation.light import calibrate, detect
from tsmftis.camera import Camera
from tsmftis.interferometer import Interferometer
from tsmftis.simulator import effects as effect
from tsmftis.simulator import imaging, interferometer

Array = NDArray[np.float64]
Given = Mapping[str, Mapping[str, float]]

ROWS, COLS, ZPD, STEP = 64, 128, 20.0, 2.05e-7
PANELS = ("white", "red", "green", "blue", "holmium", "grey", "black")
HALF, APART, SPEED = 4.5, 15.0, 1.03  # of a panel, between panels [px]; [px/frame]
STRENGTH = {
    "opd_scale": "scale",
    "opd_quadratic": "quadratic",
    "fringe_tilt": "tilt",
    "detector_nonlinearity": "a",
    "channel_fringe": "amplitude",
    "response_scale": "scale",
}
FRINGE = {"thickness": 8.3e-6, "phase": 0.7}
COVARIATES = {  # with which what each effect leaves does vary
    "opd_scale": ("path by OPD",),
    "opd_quadratic": ("path by OPD",),
    "fringe_tilt": ("path by row",),
    "detector_nonlinearity": ("signal level",),
    "channel_fringe": ("wavenumber",),
    "response_scale": ("signal level", "wavenumber"),
}


TOGETHER: tuple[Given, ...] = (
    {"opd_scale": {"scale": 4e-3}, "detector_nonlinearity": {"a": 0.08}},
    {"detector_nonlinearity": {"a": 0.08}, "response_scale": {"scale": -0.03}},
    {"opd_scale": {"scale": 8e-4}, "opd_quadratic": {"quadratic": 5e-12}, "fringe_tilt": {"tilt": 2e-10}},
    {"opd_scale": {"scale": 4e-3}, "opd_quadratic": {"quadratic": 5e-11}, "fringe_tilt": {"tilt": 1.5e-9}},
)


def light() -> SimulationSettings:
    """The demo's light and detector, on a small detector."""
    preset = SimulationSettings.preset("demo").model_dump()
    preset["instrument"]["camera"] |= {"rows": ROWS, "cols": COLS, "principal_point_px": {"row": 31.5, "col": 63.5}}
    preset["instrument"]["interferometer"] |= {"opd_step_m": STEP, "zpd_col": ZPD}
    for line in preset["lines"]:
        line["panels"] = list(PANELS)
    return SimulationSettings.model_validate(preset)


def made(given: Given, seed: int, panels: tuple[str, ...] = PANELS, lines: int = 2) -> dict[str, object]:
    """Arguments of `reconstruction.residual_problem` for data with the effects `given`."""
    settings = light()
    truth = effect.complete(given)
    calibration = calibrate(settings, 1)
    signal, names = detect(settings, truth, calibration)
    camera = settings.instrument.camera
    a = effect.number(truth, "detector_nonlinearity", "a")
    rng = np.random.default_rng(seed)
    flown = [_line(signal, names, panels, calibration, settings, a, rng) for _ in range(lines)]
    return {
        "lines": [
            reconstruction.SpectralLine(frames, tracks, targets, f"L{i + 1}")
            for i, (frames, tracks, targets) in enumerate(flown)
        ],
        "calibration": Calibration(calibration.dark, calibration.flat, calibration.wavenumber, calibration.response),
        "references": References(
            tuple(calibration.references), calibration.wavenumber, np.stack(list(calibration.references.values()))
        ),
        "camera": Camera(ROWS, COLS, 1.5e-5, 0.07, 31.5, 63.5, 100.0, float(camera.saturation_dn)),
        "interferometer": Interferometer(ROWS, COLS, STEP, ZPD, 450e-9, 900e-9),
    }


def _line(
    signal: Array,
    names: list[str],
    panels: tuple[str, ...],
    calibration: object,
    settings: SimulationSettings,
    a: float,
    rng: np.random.Generator,
) -> tuple[Frames, Tracks, Targets]:
    """Frames of panels that pass over a ground of the background's mean, as shares of each pixel's area."""
    count = int((COLS + (len(panels) - 1) * APART + 4.0 * HALF) / SPEED)
    frame = np.arange(count)
    wander = np.cumsum(rng.standard_normal(count + 60))
    wander = np.convolve(wander, np.ones(61) / 61, "valid")[:count]
    background = [names.index(name) for name in settings.scene.background]
    ideal = np.repeat(signal[background].mean(axis=0)[None], count, axis=0)
    unit = np.linspace(-0.5, 0.5, Tracks.GRID) * HALF
    along, across = (g.ravel() for g in np.meshgrid(unit, unit, indexing="ij"))
    rows, cols = np.arange(ROWS), np.arange(COLS)
    tracks = np.empty((2, 1, len(panels), along.size, count))
    for k, panel in enumerate(panels):
        col = SPEED * frame - 2.0 * HALF - k * APART
        row = 31.5 + 6.0 * np.sin(0.9 * k + rng.uniform(0.0, 6.0)) + wander - wander.mean()
        share = [
            np.clip(HALF + 0.5 - np.abs(grid - centre[:, None]), 0.0, 1.0)
            for grid, centre in ((rows, row), (cols, col))
        ]
        over = share[0][:, :, None] * share[1][:, None, :]
        ideal += over * (signal[names.index(panel)] - ideal)
        miss = 0.3 * rng.standard_normal(2)
        tracks[0, 0, k] = row + across[:, None] + miss[0]
        tracks[1, 0, k] = col + along[:, None] + miss[1]
    detector, camera = settings.detector, settings.instrument.camera
    counts = imaging.digitise(
        interferometer.saturate(calibration.flat * ideal, a),  # type: ignore[attr-defined]
        calibration.dark,  # type: ignore[attr-defined]
        detector.electrons_per_dn,
        detector.read_noise_dn,
        camera.saturation_dn,
        rng,
    )
    zero = np.zeros(len(panels))
    ids = tuple(f"T{k + 1}" for k in range(len(panels)))
    targets = Targets(ids, zero, zero, zero, panels, zero + 6.0)
    return Frames(frame / 100.0, counts), Tracks(("tracking",), ids, tracks[0], tracks[1]), targets


def problem(given: Given, seed: int, without: str = "") -> ResidualProblem:
    """The residual problem of made data, its library without one effect."""
    whole = reconstruction.residual_problem(**made(given, seed))  # type: ignore[arg-type]
    return replace(whole, candidates=tuple(c for c in whole.candidates if c.effect != without))


def bounds(one: ResidualProblem) -> dict[str, float]:
    """Effect → Cramér–Rao sigma of its strength, with the nuisance and all other candidates estimated."""
    columns = {}
    for name, key in STRENGTH.items():
        parameter = next(c for c in one.candidates if c.effect == name).parameters[key]
        rest = FRINGE if name == "channel_fringe" else {}
        up, down = (one.residual({name: {**rest, key: sign * parameter.difference}}) for sign in (1.0, -1.0))
        columns[name] = (up - down) / (2.0 * parameter.difference)
    out = {}
    for name, column in columns.items():
        x = np.column_stack([one.nuisance, *(c for other, c in columns.items() if other != name)])
        x = x / np.linalg.norm(x, axis=0)
        out[name] = 1.0 / float(np.linalg.norm(column - x @ np.linalg.lstsq(x, column, rcond=None)[0]))
    return out


def at_size(name: str, size: float, seed: int) -> dict[str, dict[str, float]]:
    """The effect at so many sigma of the data set of this seed."""
    sigma = bounds(problem({}, seed))
    rest = FRINGE if name == "channel_fringe" else {}
    return {name: {**rest, STRENGTH[name]: size * sigma[name]}}


def most(count: int, trials: int) -> float:
    """One-sided 95 % upper bound of a share."""
    return float(beta.ppf(0.95, count + 1, max(trials - count, 1e-9))) if count < trials else 1.0


def _clean(trials: int, seed: int) -> None:
    begun, verdicts, added = time.perf_counter(), Counter[str](), Counter[str]()
    whole = []
    for i in range(trials):
        one = problem({}, seed + i)
        result = run(one, LoopSettings(), i)
        verdicts[result.verdict] += 1
        added.update(s.effect for s in result.steps)
        r = one.residual({})
        whole.append(r @ r / (r.size - one.nuisance.shape[1]))
    wrong = verdicts["effects_added"]
    print(
        f"clean, {trials} data sets: {dict(verdicts)} {dict(added)}; {(time.perf_counter() - begun) / trials:.1f} s each"
    )
    print(f"  false additions {wrong / trials:.1%}, at 95 % confidence under {most(wrong, trials):.1%}")
    print(f"  χ² per degree of freedom {np.mean(whole):.3f} ± {np.std(whole):.3f}", flush=True)


def _found(name: str, trials: int, seed: int) -> None:
    for size in (4.0, 8.0):
        right = alone = 0
        answers, scores, share = Counter[str](), [], []
        for i in range(trials):
            given = at_size(name, size, seed + 1000 + i)
            result = run(problem(given, seed + 1000 + i), LoopSettings(), i)
            told = [name in (s.effect, *s.indistinguishable_from) for s in result.steps]
            right += any(told)
            alone += any(told) and len(told) == 1
            answers[" + ".join(s.effect for s in result.steps) or result.verdict] += 1
            for step in result.steps:
                if step.effect == name:
                    value = step.parameters[STRENGTH[name]]
                    true = given[name][STRENGTH[name]]
                    scores.append((abs(value.value) - true) / value.sigma)
                    share.append(value.sigma * size / true)
        spread = f"error/sigma rms {np.sqrt(np.mean(np.square(scores))):.2f}" if scores else ""
        spread += f", sigma/bound {np.median(share):.2f}" if share else ""
        listed = ", ".join(f"{n} {c}" for n, c in answers.most_common())
        print(f"{name:<22} {size:g} sigma: named {right}/{trials}, alone {alone}; {spread}; {listed}", flush=True)


def _missing(name: str, trials: int, seed: int) -> None:
    size = 15.0
    forced = learned = 0
    answers = Counter[str]()
    for i in range(trials):
        result = run(problem(at_size(name, size, seed + 2000 + i), seed + 2000 + i, name), LoopSettings(), i)
        names = [s.effect for s in result.steps]
        forced += any(not n.startswith("learned:") for n in names)
        learned += any(n.removeprefix("learned:") in COVARIATES[name] for n in names)
        answers[" + ".join(names) or result.verdict] += 1
    listed = ", ".join(f"{n} {c}" for n, c in answers.most_common())
    print(f"{name:<22} {size:g} sigma: a wrong name {forced}/{trials}, right covariate {learned}; {listed}", flush=True)


def _together(seed: int) -> None:
    for given in TOGETHER:
        result = run(problem(given, seed + 76), LoopSettings(), 1)
        print(f"{' + '.join(given)}: {' + '.join(s.effect for s in result.steps) or result.verdict}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=20, help="data sets of an effect and size")
    parser.add_argument("--clean", type=int, default=60, help="data sets without an effect")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--part", nargs="*", default=["clean", "found", "missing"], choices=["clean", "found", "missing", "together"]
    )
    parser.add_argument("--only", nargs="*", default=list(STRENGTH), choices=list(STRENGTH), metavar="EFFECT")
    a = parser.parse_args()
    sigma = bounds(problem({}, a.seed))
    print("bounds: " + ", ".join(f"{n} {s:.2g}" for n, s in sigma.items()))
    if "clean" in a.part:
        _clean(a.clean, a.seed)
    if "together" in a.part:
        _together(a.seed)
    for part, measure in (("found", _found), ("missing", _missing)):
        if part in a.part:
            print(part if part == "found" else "not in the library")
            for name in a.only:
                measure(name, a.trials, a.seed)


if __name__ == "__main__":
    main()
