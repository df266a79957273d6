"""What the closed loop is offered of a flight: the filter's innovations, whitened, as a function of the effects in its model.

    r = S^(−½)·y,      e⁻ = Φ·e,   y = H·e⁻ + noise,   e = (1 − K·H)·e⁻,      ∂y/∂θ = −H·∂e⁻/∂θ_true

y (six or three a fix) are the innovations of the forward filter, S their covariance, e true minus estimated state. A constant
parameter that the model has wrong by δ starts e at δ in its place, and the filter's own recursion carries it into all later
innovations: one pass gives the residual at θ and all its derivatives there. The root is symmetric (of the correlations, after
division by the sigmas), so that each whitened component stays with its own axis.

The null is the filter with the states that it has by default: what it can take up (biases; scale factors within their declared
sigmas) is no residual, and an effect shows as far as the declared sigmas do not cover it. Lever arm, latency and g-sensitivity
are no states of it, whatever the settings estimate: whether they are needed is what the loop decides.

Start, linearisation and outliers must not depend on the effect that is looked for. They come from a smoothed run that estimates
every candidate with a wide prior; fixes that even that run refuses are left out, all others are believed by every pass. The
start's position and velocity are left open, since an arm or a latency shifts them.

Receivers filter their velocities, which then lag the fixes that they come with. That is the receiver's own affair and no latency
of its clock: a lag of the velocities alone is a nuisance of every problem that has velocities. What it does changes with the
latency, so that it is fitted, and taken off, at every θ.

Functions
---------
residual_problem    of one flight
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from pipeline.errors import InputError
from pipeline.records import Gnss, Imu, ThermalCorrection
from pipeline.residual_problem import Basis, Candidate, Parameter, Parameters, ResidualProblem
from stages.navigation import covariates, kalman, states
from stages.navigation.measurements import Gathered, at_instants, withheld
from stages.navigation.pos import declared, settled_start, smooth
from stages.navigation.recursion import Inputs, carried, signals
from stages.navigation.settings import NavigationSettings
from stages.navigation.solve import Problem, Solution, forward
from stages.navigation.velocity_lag import taken_off
from tsmftis.camera import Mounting
from tsmftis.effects import EFFECTS
from tsmftis.geodesy import STANDARD_GRAVITY
from tsmftis.inertial import DEG_PER_H, ImuModel

Array = NDArray[np.float64]

CANDIDATES = ("antenna_lever_arm", "gnss_latency", "gyro_scale_factor", "accel_scale_factor", "gyro_g_sensitivity")
DECIDED_HERE = ("antenna_lever_arm", "gnss_latency", "gyro_g_sensitivity")  # never states of the null
MARGIN = EFFECTS["gnss_latency"].largest[
    "latency"
]  # s at both ends, from which a latency could carry a fix out of the data
OPEN_POSITION, OPEN_VELOCITY = 30.0, 1.0  # m, m/s: the start's sigmas
WIDER = 20.0  # times the declared sigmas of scale factors: the prior of the run that the start is taken from
WIDE_ARM, WIDE_LATENCY = 1.0, 0.5  # m, s: the same
SIGMAS = 5.0  # of the declared scale factor's: a size worth naming
TOLD, LAG_ROUNDS = 6.0, 4  # sigma of a lag of the velocities that is beyond doubt; rounds in which it is taken off
VELOCITIES = 3  # components of a fix, before those of its velocity
VELOCITY_LAG, LARGEST_LAG = "velocity_lag_s", 1.0  # s: more is no filter's
BEYOND_DOUBT = 1e-3  # p of biases that are left free
MINUTE, SHORTEST, GROUPS = (
    60.0,
    8.0,
    16,
)  # s, s: what is held out is a minute, or a sixteenth of a flight, but no less than 8 s
FEWEST_FIXES = 20
KEPT = 8  # linearisations in memory
EXACT = 1e-6  # relative, of a step
PHASE = 5e-3  # s: within it a vibration of 25 Hz is a linear matter


@dataclass(frozen=True)
class Linearisation:
    """At θ (13,): r (n,), S = −∂r/∂θ (n, 13), and the same for a lag of the velocities alone (n,) and for constant biases of
    gyros and accelerometers (n, 6)."""

    theta: Array
    residual: Array
    signatures: Array
    velocity_lag: Array
    biases: Array

    def without_lag(self, residual: Array) -> Array:
        """What a lag of the velocities leaves of a residual (n,) near here."""
        length = float(self.velocity_lag @ self.velocity_lag)
        share = float(self.velocity_lag @ residual) / length if length > 0.0 else 0.0
        return np.asarray(residual - share * self.velocity_lag)


@dataclass(frozen=True)
class Pass:
    """The filter run once, all candidates among its states: its chosen fixes, their whitening (k, m, m) and whitened innovations
    (m·k,)."""

    gathered: Gathered
    store: kalman.Store
    count: int
    active: NDArray[np.int64]
    fixes: NDArray[np.int64]
    root: Array
    residual: Array

    @classmethod
    def of(cls, problem: Problem, refused: NDArray[np.bool_], chosen: NDArray[np.int64]) -> Pass:
        """A residual of NaN where the filter fails."""
        gathered, _, count, store = forward(problem, CANDIDATES, refused)
        active = states.estimated({*problem.settings.estimate, *CANDIDATES})
        fixes = gathered.of_fix[chosen]
        m = int(gathered.measurements.size[fixes[0]])
        weights = np.where(store.used[fixes, None, None], store.S_inv[fixes, :m, :m], np.eye(m))
        if not (np.isfinite(weights).all() and np.isfinite(store.y[fixes]).all()):
            return cls(gathered, store, count, active, fixes, weights, np.full(m * fixes.size, np.nan))
        root = _roots(weights)
        return cls(
            gathered, store, count, active, fixes, root, np.einsum("kij,kj->ik", root, store.y[fixes, :m]).ravel()
        )

    @property
    def components(self) -> int:
        return self.root.shape[1]

    def shown(self, inputs: Inputs, signal: Array) -> Array:
        """(m·k, q): what errors that the filter does not know of add to the residual."""
        every = carried(self.store, self.count, self.active, inputs, signal)[self.fixes, : self.components]
        return np.asarray(np.einsum("kij,kjq->ikq", self.root, every).reshape(self.residual.size, -1))


@dataclass
class Innovations:
    """Whitened innovations of the chosen fixes (k,) as a function of θ; passes are kept.

    `steps` (13,): of the differences; a point that is one of them off a point where the filter was run, in one parameter, is
    answered by that run's derivatives.
    """

    null: Problem
    refused: NDArray[np.bool_]
    chosen: NDArray[np.int64]
    order: tuple[tuple[str, str], ...]
    steps: Array
    kept: OrderedDict[bytes, Linearisation] = field(default_factory=OrderedDict)

    def __call__(self, parameters: Parameters) -> Array:
        at = np.array([parameters.get(effect, {}).get(name, 0.0) for effect, name in self.order])
        for key, one in reversed(self.kept.items()):
            off = (at - one.theta) / self.steps
            moved = off[off != 0.0]
            if moved.size == 0 or (moved.size == 1 and abs(abs(moved[0]) - 1.0) < EXACT):
                self.kept.move_to_end(key)
                return one.without_lag(one.residual - one.signatures @ (off * self.steps))
        made = self.at(at)
        self.kept[at.tobytes()] = made
        if len(self.kept) > KEPT:
            self.kept.popitem(last=False)
        return made.without_lag(made.residual)

    def at(self, at: Array) -> Linearisation:
        """The filter, run at θ; a fix that a latency carries into a gap of the inertial data says nothing there: zero."""
        theta = self.null.theta.copy()
        for (effect, name), value in zip(self.order, at, strict=True):
            theta[states.parameter(effect).start + list(EFFECTS[effect].units).index(name)] += value
        problem = replace(
            self.null, theta=theta, declared=theta, latency=float(theta[states.parameter("gnss_latency")][0])
        )
        done = Pass.of(problem, self.refused, self.chosen)
        y, q, m = done.residual, len(self.order), done.store.rows.size
        if not np.isfinite(y).all():
            none = np.full(y.size, np.nan)
            return Linearisation(at, none, np.full((none.size, q), np.nan), none, np.full((none.size, 6), np.nan))
        late = int(np.searchsorted(done.active, states.GROUPS["gnss_latency"].start))
        # After the candidates: six biases, velocities that lag.
        inputs = Inputs.none(done.active.size, q + 7, m, np.array([self._latency, q + 6]))
        for column, (effect, name) in enumerate(self.order):
            place = states.GROUPS[effect].start + list(EFFECTS[effect].units).index(name)
            inputs.start[np.searchsorted(done.active, place), column] = 1.0
        inputs.sensor[q : q + 6] = np.arange(6)

        def signatures(jolts: Array) -> Array:
            """jolts (m, 3) [m/s²]: what H leaves out of the velocities' derivative by the latency."""
            inputs.direct[:, 3:, 0] = -jolts
            inputs.direct[:, 3:, 1] = done.store.H[:, 3:, late] - jolts
            return done.shown(inputs, np.ones((done.count - 1, 1)))

        s = signatures(np.zeros((m, 3)))
        off, sigma = _beside_all(np.delete(s, q + np.arange(6), axis=1), y, self._latency)
        if abs(off) + 2.0 * sigma < PHASE:
            s = signatures(_jolts(problem, done.gathered, done.count, done.store))
        return Linearisation(at, y, s[:, :q], s[:, -1], s[:, q:-1])

    def bases(self) -> dict[str, Basis]:
        """Curves that the filter carries on, at the null."""
        done = Pass.of(self.null, self.refused, self.chosen)
        columns = done.shown(
            covariates.inputs_of(done.active, done.store), signals(self.null.imu, done.store, done.count)
        )
        fixes = done.gathered.of_fix[self.chosen]
        late = int(np.searchsorted(done.active, states.GROUPS["gnss_latency"].start))
        at_fixes = (
            done.store.H[fixes, :3, late],
            done.gathered.measurements.rate[fixes],
            done.gathered.measurements.force[fixes],
        )
        norms = [np.tile(np.linalg.norm(v, axis=1), done.components) for v in at_fixes]
        return covariates.bases_of(columns, *norms)

    @property
    def _latency(self) -> int:
        return self.order.index(("gnss_latency", "latency"))


def _beside_all(signatures: Array, residual: Array, column: int) -> tuple[float, float]:
    """What the residual says of one parameter with all others estimated, and its sigma; (0, ∞) where it says nothing."""
    size = np.linalg.norm(signatures, axis=0)
    if not np.isfinite(residual).all() or not size[column] > 0.0:
        return 0.0, float("inf")
    seen = np.flatnonzero(size > 0.0)
    scaled = signatures[:, seen] / size[seen]
    inverse = np.linalg.pinv(scaled.T @ scaled, rcond=1e-10, hermitian=True)
    at = int(np.searchsorted(seen, column))
    return float(inverse[at] @ (scaled.T @ residual)) / size[column], float(np.sqrt(inverse[at, at])) / size[column]


def _jolts(problem: Problem, gathered: Gathered, count: int, store: kalman.Store) -> Array:
    """What the antenna's acceleration has beyond the unit's, C·(ω̇×l + ω×(ω×l)) (m, 3): vibration, mostly.

    The filter's own derivative by the latency leaves it out, which is right over more than a fraction of the vibration's period:
    there its phase is lost. Near the right latency it is what tells most.
    """
    epochs = np.flatnonzero(store.epoch_measurement[:count] >= 0)
    at = store.epoch_measurement[epochs]
    time = gathered.measurements.time[at]
    rate = at_instants(problem.imu.time, problem.imu.gyro, time)
    change = at_instants(problem.imu.time, problem.imu.gyro, time, derivative=1)
    lever = problem.theta[states.parameter("antenna_lever_arm")]
    arm = np.cross(change, lever) + np.cross(rate, np.cross(rate, lever))
    out = np.zeros((store.rows.size, 3))
    out[at] = np.einsum("kij,kj->ki", store.epoch_dcm[epochs], arm)
    out[gathered.measurements.kind != kalman.FIX] = 0.0
    return out


def _roots(inverse: Array) -> Array:
    """Symmetric whitening (k, m, m) of covariances, given by their inverses: (correlations)^(−½)·(sigmas)^(−1)."""
    covariance = np.linalg.inv(inverse)
    sigma = np.sqrt(np.einsum("kii->ki", covariance))
    values, vectors = np.linalg.eigh(covariance / (sigma[:, :, None] * sigma[:, None, :]))
    return np.asarray(
        np.einsum("kij,kj,klj,kl->kil", vectors, 1.0 / np.sqrt(np.maximum(values, 1e-12)), vectors, 1.0 / sigma)
    )


def residual_problem(
    imu: Imu,
    gnss: Gnss,
    model: ImuModel,
    mounting: Mounting,
    settings: NavigationSettings,
    *,
    initial: tuple[float, Array, Array] | None = None,
    correction: ThermalCorrection | None = None,
    effects: Mapping[str, Mapping[str, float]] | None = None,
) -> ResidualProblem:
    """Of one flight; the arguments are those of `run`. Candidates are relative to the declared model with `effects` in it.

    Velocities that lag beyond doubt are moved to their positions' instants first: fixes would be refused for them.
    Raises InputError as `run` does, and where too few fixes are left.
    """
    effects, moved, lag, sigma = effects or {}, gnss, 0.0, float("inf")
    for again in range(LAG_ROUNDS):
        solution = _widely_estimated(imu, moved, model, mounting, settings, initial, correction, effects)
        theta = declared(mounting, effects)
        innovations = _innovations(solution, model, settings, theta)
        none = np.zeros(len(innovations.order))
        first = innovations.kept[none.tobytes()] = innovations.at(none)
        near = innovations.at(_apart(solution, innovations.order, theta))
        count = first.residual.size // innovations.chosen.size
        if count == VELOCITIES:
            break
        signatures = np.column_stack([near.signatures, near.velocity_lag])
        more, sigma = _beside_all(signatures, near.residual, signatures.shape[1] - 1)
        if abs(more) < TOLD * sigma or again == LAG_ROUNDS - 1 or abs(lag + more) > LARGEST_LAG:
            break
        lag += more
        moved = taken_off(gnss, solution, lag)
    chosen = innovations.chosen
    notes: tuple[str, ...] = ()
    if lag != 0.0:
        told = f"the velocities are {1e3 * abs(lag):.3g} ± {1e3 * sigma:.2g} ms {'late' if lag > 0.0 else 'early'}"
        notes = (f"{told} against the positions of their fixes, and are taken at those instants here",)
    own = [first.velocity_lag[:, None]] if count > VELOCITIES else []
    unnamed: tuple[str, ...] = ()
    if _biases_stand_out(near):
        own.append(first.biases)
        told = "beside every effect, the flight asks for biases beyond those declared: they are left free"
        # Of an uncompensated unit temperature may have made them; of a compensated one something that has no name.
        notes, unnamed = (notes, (told,)) if correction is not None else ((*notes, told), ())
    time = gnss.time[chosen]
    group, names = _groups(time)
    component = np.repeat(np.arange(count), chosen.size)
    return ResidualProblem(
        stage="navigation",
        residual=innovations,
        candidates=_candidates(model, settings),
        group=np.tile(group, count),
        series=component,
        time=np.tile(time, count),
        nuisance=np.hstack([np.zeros((component.size, 0)), *own]),
        channel=component,
        covariates=covariates.covariates_of(solution, imu, chosen, count, innovations.bases()),
        drifts=False,
        unit="sigma",
        group_names=names,
        notes=notes,
        unnamed=unnamed,
        beside={} if lag == 0.0 else {VELOCITY_LAG: float(lag)},
    )


def _biases_stand_out(near: Linearisation) -> bool:
    """Whether the flight asks for biases that neither their declared sigmas nor any candidate give: these are too small, or a
    compensation has taken for a bias what the sensor does with gravity in the chamber.
    """
    rest = np.column_stack([near.signatures, near.velocity_lag])
    left = []
    for columns in (rest, np.column_stack([rest, near.biases])):
        size = np.linalg.norm(columns, axis=0)
        seen = columns[:, size > 0.0] / size[size > 0.0]
        beta = np.linalg.lstsq(seen, near.residual, rcond=1e-8)[0]
        left.append(float(np.sum((near.residual - seen @ beta) ** 2)))
    gain = (left[0] - left[1]) * (near.residual.size - rest.shape[1] - 6) / max(left[1], 1e-300)
    return bool(chdtrc(6, max(gain, 0.0)) < BEYOND_DOUBT)


def _apart(solution: Solution, order: Sequence[tuple[str, str]], theta: Array) -> Array:
    """What `solution` estimates of the parameters, in their order, beyond θ: a latency far from it bends everything else."""
    estimated = solution.theta()[-1]
    estimated[states.parameter("gnss_latency")] += solution.problem.latency
    places = [states.parameter(e).start + list(EFFECTS[e].units).index(name) for e, name in order]
    return np.asarray((estimated - theta)[places])


def _innovations(solution: Solution, model: ImuModel, settings: NavigationSettings, theta: Array) -> Innovations:
    """Those of the filter with its default states at the declared parameters θ, begun and cleared of outliers by `solution`."""
    estimate = tuple(g for g in settings.estimate if g not in DECIDED_HERE)
    start = settled_start(solution)
    null = replace(
        solution.problem,
        model=model,
        settings=settings.model_copy(update={"estimate": estimate}),
        start=replace(
            start,
            sigma_position=np.hypot(start.sigma_position, OPEN_POSITION),
            sigma_velocity=np.hypot(start.sigma_velocity, OPEN_VELOCITY),
        ),
        declared=theta,
        theta=theta,
        latency=float(theta[states.parameter("gnss_latency")][0]),
    )
    refused = _refused(solution)
    chosen = _chosen(solution, refused)
    if chosen.size < FEWEST_FIXES:
        raise InputError(
            "gnss",
            "variable 'time'",
            f"leaves {chosen.size} usable fixes that are {MARGIN:g} s inside the inertial data",
            f"innovations can be judged from {FEWEST_FIXES} fixes on",
        )
    candidates = _candidates(model, settings)
    order = tuple((c.effect, name) for c in candidates for name in c.parameters)
    steps = np.array([c.parameters[name].difference for c in candidates for name in c.parameters])
    return Innovations(null, refused, chosen, order, steps)


def _groups(time: Array) -> tuple[NDArray[np.int64], dict[int, str]]:
    """Equal stretches (k,) of the flight, and their names."""
    span = float(time[-1] - time[0])
    count = max(round(span / np.clip(span / GROUPS, SHORTEST, MINUTE)), 1)
    edges = time[0] + span / count * np.arange(count + 1)
    group = np.clip(np.searchsorted(edges, time, side="right") - 1, 0, count - 1)
    return group, {i: f"{edges[i]:.0f} to {edges[i + 1]:.0f} s" for i in range(count)}


def _widely_estimated(
    imu: Imu,
    gnss: Gnss,
    model: ImuModel,
    mounting: Mounting,
    settings: NavigationSettings,
    initial: tuple[float, Array, Array] | None,
    correction: ThermalCorrection | None,
    effects: Mapping[str, Mapping[str, float]],
) -> Solution:
    """Smoothed, with every candidate a state of a wide prior."""
    g_sensitivity = 3.0 * max(settings.g_sensitivity_sigma_deg_per_h_per_g, model.gyro.bias_sigma / DEG_PER_H)
    wide = settings.model_copy(
        update={
            "estimate": tuple(dict.fromkeys((*settings.estimate, *CANDIDATES))),
            "lever_arm_sigma_m": max(settings.lever_arm_sigma_m, WIDE_ARM),
            "gnss_latency_sigma_s": max(settings.gnss_latency_sigma_s, WIDE_LATENCY),
            "g_sensitivity_sigma_deg_per_h_per_g": g_sensitivity,
        }
    )
    gyro, accel = (replace(s, scale_factor_sigma=WIDER * s.scale_factor_sigma) for s in (model.gyro, model.accel))
    return smooth(imu, gnss, replace(model, gyro=gyro, accel=accel), mounting, wide, initial, correction, effects)[0]


def _refused(solution: Solution) -> NDArray[np.bool_]:
    """Fixes (n,) that are withheld, or of which the solution refused position or velocity."""
    gnss, place = solution.problem.gnss, solution.gathered.of_fix
    doubtful = (solution.store.verdict[place] == kalman.REJECTED).any(axis=1) | solution.store.reentry[place]
    return np.asarray(doubtful | withheld(gnss.time, solution.problem.settings))


def _chosen(solution: Solution, refused: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The fixes whose innovations are judged: used, MARGIN inside the inertial data, each stamp once."""
    time, place = solution.problem.gnss.time, solution.gathered.of_fix
    begun, ended = solution.problem.imu.time[[0, -1]]
    inside = (time > begun + MARGIN) & (time < ended - MARGIN)
    chosen = np.flatnonzero(inside & ~refused & solution.gathered.measurements.use[place])
    return chosen[np.diff(time[chosen], prepend=-np.inf) > 0.0]


def _candidates(model: ImuModel, settings: NavigationSettings) -> tuple[Candidate, ...]:
    """With what the settings and the declared sigmas hold possible as sizes worth naming."""
    worst_g = max(settings.g_sensitivity_sigma_deg_per_h_per_g * DEG_PER_H, model.gyro.bias_sigma) / STANDARD_GRAVITY
    plausible = {
        "antenna_lever_arm": settings.lever_arm_sigma_m,
        "gnss_latency": settings.gnss_latency_sigma_s,
        "gyro_scale_factor": SIGMAS * model.gyro.scale_factor_sigma,
        "accel_scale_factor": SIGMAS * model.accel.scale_factor_sigma,
        "gyro_g_sensitivity": worst_g,
    }
    out = []
    for name in CANDIDATES:
        effect = EFFECTS[name]
        parameters = {
            key: Parameter(effect.units[key], effect.largest[key], plausible=min(plausible[name], effect.largest[key]))
            for key in effect.units
        }
        out.append(Candidate(name, parameters))
    return tuple(out)
