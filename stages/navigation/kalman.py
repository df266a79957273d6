"""Error-state Kalman filter and modified Bryson–Frazier smoother, compiled.

The filter is closed-loop: after each measurement the estimate takes the error up. The covariance is propagated over epochs,
which end at every measurement and at the latest after `epoch_s`, with the transition matrix of the mean dynamics to second
order. Only its nine navigation rows differ from a diagonal, so Φ is kept and applied as those rows (9, n) and the
parameters' decay. The smoother is the modified Bryson–Frazier form [1]_: it needs no inverse of the predicted covariance,
which is singular in states without process noise, and the same recursion serves closed-loop estimates since x_s = x − P·λ.
Its adjoint variables are the backward filter: x_b − x_f = −Λ⁻¹λ with covariance Λ⁻¹ = P_f + P_b.

States are those of `stages.navigation.states`, n of them carried. Measurements are of three kinds:

    FIX         position and (size 6) velocity of the antenna, at its true time
    STANDSTILL  velocity is zero, and the gyros' mean over the window is Earth rate and bias
    HEIGHT      height alone, as a barometer would give it (free-inertial mode)

References
----------
.. [1] G. J. Bierman, Fixed Interval Smoothing with Discrete Measurements, Int. J. Control 18 (1973) 65–75.
.. [2] P. D. Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd ed., ch. 14–15.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np

from stages.navigation.mechanisation import (
    OMEGA,
    gravity,
    increments,
    quaternion_to_dcm,
    radii,
    rotate_ned,
    step,
)
from stages.navigation.states import NAVIGATION, PARAMETERS, STATES

FIX, STANDSTILL, HEIGHT = 0, 1, 2
BELIEVED, WEIGHED_DOWN, REJECTED = 0, 1, 2
GROSS = 25.0  # times the gate: beyond it position or velocity of a fix is rejected, before it only weighed down
FEWEST_REFUSED = 5  # rejected positions in a row before the filter doubts itself
AGREE = 0.5  # of their size: successive rejected innovations that differ by more do not agree
# Places among the parameters θ; see `states.GROUPS`.
_BG, _BA, _SG, _SA, _GG, _LEVER, _LATENCY = 0, 3, 6, 9, 12, 15, 18


class Unit(NamedTuple):
    """The inertial unit: stamps (n,) [s], the first only the start; gyro, accel (n, 3), means over the interval that ends at the
    stamp, body axes; gap, still (n,): whether that interval is a gap in the data, or the body stood; `unseen` (n, 2): variances
    per second of rotation [rad²/s] and velocity [m²/s³] for what lacks in an interval; spectral densities [unit²/s] (28,) of the
    states' noise, and at standstill; inverse correlation times (6,) [1/s]."""

    time: Any
    gyro: Any
    accel: Any
    gap: Any
    still: Any
    unseen: Any
    noise: Any
    still_noise: Any
    inverse_tau: Any


class Measurements(NamedTuple):
    """In order of time (m,): kind; size; whether it is used or only watched; position lat, lon [rad], height [m] (m, 3);
    velocity NED (m, 3); variances (m, 6); at a fix the body's rate and specific force as measured, at a standstill the mean
    measured rate (m, 3) in `rate`."""

    time: Any
    kind: Any
    size: Any
    use: Any
    position: Any
    velocity: Any
    variance: Any
    rate: Any
    force: Any


class Store(NamedTuple):
    """What the filter leaves behind, filled in place: the estimate at each stamp and the epochs closed by then; at each epoch's
    end its time, covariance (lower triangle), rows of the transition from the epoch before and the decay, measurement (or −1),
    correction taken up, θ and C; for each measurement the rows that were used, their H, S⁻¹, K and innovation; of all its rows
    innovation, sigma, normalised innovation squared and log-likelihood; what became of its position and velocity (`BELIEVED`, …),
    whether anything of it was used, and whether the filter had to doubt itself for it."""

    position: Any
    velocity: Any
    q: Any
    epoch: Any
    epoch_time: Any
    epoch_P: Any
    epoch_phi: Any
    epoch_decay: Any
    epoch_measurement: Any
    epoch_dx: Any
    epoch_theta: Any
    epoch_dcm: Any
    rows: Any
    H: Any
    S_inv: Any
    K: Any
    y: Any
    innovation: Any
    innovation_sigma: Any
    nis: Any
    loglike: Any
    verdict: Any
    used: Any
    reentry: Any

    @classmethod
    def empty(cls, stamps: int, epochs: int, measurements: int, n: int) -> Store:
        return cls(
            np.empty((stamps, 3)),
            np.empty((stamps, 3)),
            np.empty((stamps, 4)),
            np.empty(stamps, np.int64),
            np.empty(epochs),
            np.empty((epochs, n * (n + 1) // 2)),
            np.empty((epochs, NAVIGATION, n)),
            np.empty((epochs, 6)),
            np.full(epochs, -1, np.int64),
            np.zeros((epochs, n)),
            np.empty((epochs, PARAMETERS)),
            np.empty((epochs, 3, 3)),
            np.zeros(measurements, np.int64),
            np.zeros((measurements, 6, n)),
            np.zeros((measurements, 6, 6)),
            np.zeros((measurements, n, 6)),
            np.zeros((measurements, 6)),
            np.zeros((measurements, 6)),
            np.full((measurements, 6), np.nan),
            np.full(measurements, np.nan),
            np.zeros(measurements),
            np.full((measurements, 2), BELIEVED, np.int64),
            np.zeros(measurements, np.bool_),
            np.zeros(measurements, np.bool_),
        )


@numba.njit(cache=True, nogil=True)
def _cross_into(matrix: Any, row: int, col: int, x: float, y: float, z: float, sign: float) -> None:
    """matrix[row:row+3, col:col+3] += sign·[v×]."""
    matrix[row, col + 1] -= sign * z
    matrix[row, col + 2] += sign * y
    matrix[row + 1, col] += sign * z
    matrix[row + 1, col + 2] -= sign * x
    matrix[row + 2, col] -= sign * y
    matrix[row + 2, col + 1] += sign * x


@numba.njit(cache=True, nogil=True)
def pack(full: Any, out: Any) -> None:
    """The lower triangle of a symmetric (n, n), by rows."""
    at = 0
    for i in range(full.shape[0]):
        for j in range(i + 1):
            out[at] = full[i, j]
            at += 1


@numba.njit(cache=True, nogil=True)
def unpack(packed: Any, out: Any) -> None:
    """The symmetric (n, n) of a packed lower triangle."""
    at = 0
    for i in range(out.shape[0]):
        for j in range(i + 1):
            out[i, j] = packed[at]
            out[j, i] = packed[at]
            at += 1


@numba.njit(cache=True, nogil=True)
def dynamics(
    position: Any,
    velocity: Any,
    force: Any,
    mean_dcm: Any,
    mean_dcm_rate: Any,
    mean_dcm_force: Any,
    still: bool,
    out: Any,
) -> None:
    """Navigation rows of the error dynamics F (9, 28) at the epoch's mean: C·f [m/s²] in NED, C, C·diag(ω), C·diag(f)."""
    out[:] = 0.0
    lat, h = position[0], position[2]
    rn, re = radii(lat)
    rn, re = rn + h, re + h
    vn, ve, vd = velocity[0], velocity[1], velocity[2]
    tan = math.tan(lat)
    ien, ied = OMEGA * math.cos(lat), -OMEGA * math.sin(lat)
    enn, ene, end = ve / re, -vn / rn, -ve * tan / re
    # Position: δr in curvilinear metres.
    out[0, 0], out[0, 2], out[0, 3] = -vd / rn, vn / rn, 1.0
    out[1, 0], out[1, 1], out[1, 2], out[1, 4] = ve * tan / rn, -(vd + vn * tan) / re, ve / re, 1.0
    out[2, 5] = 1.0
    # Velocity: −[f_n×]φ, Coriolis of δv and of δv inside ω_en, gravity's height and latitude terms.
    _cross_into(out, 3, 6, force[0], force[1], force[2], -1.0)
    _cross_into(out, 3, 3, 2.0 * ien + enn, ene, 2.0 * ied + end, -1.0)
    # −δω_en×v = [v×]·δω_en, δω_en = (δv_E/r_E, −δv_N/r_N, −δv_E·tan L/r_E)
    out[3, 3] += vd / rn
    out[3, 4] -= ve * tan / re
    out[4, 4] += (vd + vn * tan) / re
    out[5, 3] -= vn / rn
    out[5, 4] -= ve / re
    # −2δω_ie(δL)×v, δL = δr_N/(R_N+h); δω_ie = Ω(−sin L, 0, −cos L)δL
    dn, dd = 2.0 * ied / rn, -2.0 * ien / rn
    out[3, 0] += ve * dd
    out[4, 0] += vd * dn - vn * dd
    out[5, 0] += -ve * dn
    out[5, 2] += 2.0 * gravity(lat, h) / math.sqrt(rn * re)
    for i in range(3):
        for j in range(3):
            out[3 + i, NAVIGATION + _BA + j] -= mean_dcm[i, j]
            out[3 + i, NAVIGATION + _SA + j] -= mean_dcm_force[i, j]
    if still:
        return  # the attitude is held, not integrated: nothing of the gyros enters it
    # Attitude: φ̇ = −ω_in×φ + C·δω_ib − δω_in
    _cross_into(out, 6, 6, ien + enn, ene, ied + end, -1.0)
    out[6, 4] -= 1.0 / re
    out[7, 3] += 1.0 / rn
    out[8, 4] += tan / re
    out[6, 0] -= ied / rn
    out[8, 0] += (ien + ve / (re * math.cos(lat) ** 2)) / rn
    out[6, 2] -= ve / (re * re)
    out[7, 2] += vn / (rn * rn)
    out[8, 2] += ve * tan / (re * re)
    for i in range(3):
        for j in range(3):
            out[6 + i, NAVIGATION + _BG + j] -= mean_dcm[i, j]
            out[6 + i, NAVIGATION + _SG + j] -= mean_dcm_rate[i, j]
            out[6 + i, NAVIGATION + _GG + j] -= mean_dcm_force[i, j]


@numba.njit(cache=True, nogil=True)
def _transition(F: Any, decay: Any, inverse_tau: Any, dt: float, active: Any, phi: Any) -> None:
    """Navigation rows of Φ = I + F·dt + ½F²·dt² in the carried states (9, n), and the biases' decay exp(−dt/τ) (6,)."""
    square = np.ascontiguousarray(F[:, :NAVIGATION]) @ F
    for i in range(6):
        decay[i] = math.exp(-dt * inverse_tau[i])
        for r in range(NAVIGATION):
            square[r, NAVIGATION + i] -= F[r, NAVIGATION + i] * inverse_tau[i]
    for r in range(NAVIGATION):
        for c in range(active.size):
            s = active[c]
            phi[r, c] = F[r, s] * dt + 0.5 * square[r, s] * dt * dt
        phi[r, r] += 1.0


@numba.njit(cache=True, nogil=True)
def _propagate(P: Any, phi: Any, decay: Any, active: Any, noise: Any, dt: float) -> None:
    """P ← Φ P Φᵀ + Q in place; Q in the trapezoid form ½(Φ Q_c Φᵀ + Q_c)·dt, which also couples white noise into position."""
    n = active.size
    for i in range(n):
        P[i, i] += 0.5 * noise[active[i]] * dt
    top = phi @ P
    corner = top @ np.ascontiguousarray(phi.T)
    for i in range(NAVIGATION):
        for j in range(i + 1):
            mean = 0.5 * (corner[i, j] + corner[j, i])
            P[i, j] = mean
            P[j, i] = mean
    for j in range(NAVIGATION, n):
        s = active[j] - NAVIGATION
        dj = decay[s] if s < 6 else 1.0
        for i in range(NAVIGATION):
            P[i, j] = top[i, j] * dj
            P[j, i] = P[i, j]
        for i in range(NAVIGATION, j + 1):
            r = active[i] - NAVIGATION
            P[i, j] *= dj * (decay[r] if r < 6 else 1.0)
            P[j, i] = P[i, j]
    for i in range(n):
        P[i, i] += 0.5 * noise[active[i]] * dt


@numba.njit(cache=True, nogil=True)
def _correct(rate: Any, force: Any, theta: Any, w: Any, f: Any) -> None:
    """What the body did, from what the unit says: f = (f_m − b_a)/(1 + s_a), ω = (ω_m − b_g − g_s∘f)/(1 + s_g)."""
    for i in range(3):
        f[i] = (force[i] - theta[_BA + i]) / (1.0 + theta[_SA + i])
        w[i] = (rate[i] - theta[_BG + i] - theta[_GG + i] * f[i]) / (1.0 + theta[_SG + i])


@numba.njit(cache=True, nogil=True)
def _at_fix(fixes: Any, k: int, position: Any, velocity: Any, dcm: Any, theta: Any, H: Any, y: Any) -> None:
    """Innovation (6,) and H (6, 28) of a fix: the antenna's position and velocity at the stamp's time,

    r_a = r + C·l − v_a·δt,    v_a = v + C·(ω_eb×l) − a_a·δt,    δt the latency still in the stamp.
    """
    w, f, lever = np.empty(3), np.empty(3), theta[_LEVER : _LEVER + 3]
    _correct(fixes.rate[k], fixes.force[k], theta, w, f)
    rn, re = radii(position[0])
    arm = dcm @ lever
    # ω_eb in body axes: Earth rotation taken off.
    ien, ied = OMEGA * math.cos(position[0]), -OMEGA * math.sin(position[0])
    for i in range(3):
        w[i] -= dcm[0, i] * ien + dcm[2, i] * ied
    swing = np.empty(3)
    swing[0] = w[1] * lever[2] - w[2] * lever[1]
    swing[1] = w[2] * lever[0] - w[0] * lever[2]
    swing[2] = w[0] * lever[1] - w[1] * lever[0]
    swing = dcm @ swing
    acceleration = dcm @ f
    acceleration[2] += gravity(position[0], position[2])
    late = theta[_LATENCY]
    y[0] = (fixes.position[k, 0] - position[0]) * (rn + position[2])
    y[1] = (fixes.position[k, 1] - position[1]) * (re + position[2]) * math.cos(position[0])
    y[2] = -(fixes.position[k, 2] - position[2])
    for i in range(3):
        y[i] -= arm[i] - (velocity[i] + swing[i]) * late
        y[3 + i] = fixes.velocity[k, i] - velocity[i] - swing[i] + acceleration[i] * late
        H[i, i] = 1.0
        H[3 + i, 3 + i] = 1.0
        H[i, NAVIGATION + _LATENCY] = -velocity[i] - swing[i]
        H[3 + i, NAVIGATION + _LATENCY] = -acceleration[i]
        for j in range(3):
            H[i, NAVIGATION + _LEVER + j] = dcm[i, j]
    _cross_into(H, 0, 6, arm[0], arm[1], arm[2], -1.0)
    _cross_into(H, 3, 6, swing[0], swing[1], swing[2], -1.0)
    # v_a has C(−δb×l) = C[l×]δb, and C[ω×]δl.
    cross = np.zeros((3, 6))
    _cross_into(cross, 0, 0, lever[0], lever[1], lever[2], 1.0)
    _cross_into(cross, 0, 3, w[0], w[1], w[2], 1.0)
    both = dcm @ cross
    for i in range(3):
        for j in range(3):
            H[3 + i, NAVIGATION + _BG + j] = both[i, j]
            H[3 + i, NAVIGATION + _SG + j] = both[i, j] * w[j]
            H[3 + i, NAVIGATION + _GG + j] = both[i, j] * f[j]
            H[3 + i, NAVIGATION + _LEVER + j] = both[i, 3 + j]
    turned = dcm @ f
    _cross_into(H, 3, 6, turned[0], turned[1], turned[2], late)
    for i in range(3):
        for j in range(NAVIGATION + _LATENCY):
            H[i, j] -= late * H[3 + i, j]


@numba.njit(cache=True, nogil=True)
def _at_rest(mean_rate: Any, mean_force: Any, lat: float, velocity: Any, dcm: Any, theta: Any, H: Any, y: Any) -> None:
    """Innovation (6,) and H (6, 28) at standstill: v = 0, mean ω_m = (1 + s_g)·Cᵀω_ie + g_s∘f + b_g."""
    ien, ied = OMEGA * math.cos(lat), -OMEGA * math.sin(lat)
    earth = np.zeros((3, 3))
    _cross_into(earth, 0, 0, ien, 0.0, ied, 1.0)
    turned = np.ascontiguousarray(dcm.T) @ earth  # Cᵀ(ω_ie×φ)
    for i in range(3):
        w = dcm[0, i] * ien + dcm[2, i] * ied
        f = (mean_force[i] - theta[_BA + i]) / (1.0 + theta[_SA + i])
        y[i] = -velocity[i]
        y[3 + i] = mean_rate[i] - (1.0 + theta[_SG + i]) * w - theta[_GG + i] * f - theta[_BG + i]
        H[i, 3 + i] = 1.0
        H[3 + i, NAVIGATION + _BG + i] = 1.0
        H[3 + i, NAVIGATION + _SG + i] = w
        H[3 + i, NAVIGATION + _GG + i] = f
        for j in range(3):
            H[3 + i, 6 + j] = turned[i, j]


@numba.njit(cache=True, nogil=True)
def _judge(S: Any, y: Any, m: int, gate: float, variance: Any, verdict: Any) -> None:
    """Position and velocity of a fix (velocity and rotation of a standstill), each by its own ν = yᵀS⁻¹y over three degrees.

    Beyond the gate its variance grows so that ν is at most about the gate; beyond GROSS gates it is rejected. A hard limit
    alone would lock the filter out: a path that is a little worse than its sigma says rejects every fix that could put it right.
    """
    for b in range(m // 3):
        part = slice(3 * b, 3 * b + 3)
        nis = y[part] @ np.linalg.solve(np.ascontiguousarray(S[part, part]), y[part])
        verdict[b] = BELIEVED
        if nis > GROSS * gate:
            verdict[b] = REJECTED
        elif nis > gate:
            verdict[b] = WEIGHED_DOWN
            for i in range(3 * b, 3 * b + 3):
                variance[i] += (nis / gate - 1.0) * S[i, i]


@numba.njit(cache=True, nogil=True)
def _doubt(P: Any, y: Any, m: int, since: float, velocity: Any) -> None:
    """Process noise after `since` seconds without a believed fix: the path moved by what the innovation says, unseen.

    Position and velocity get their innovations' squares; tilt what explains the velocity over that time, |δv|/(g·Δt), heading
    |δv|/|v|; where the fix has no velocity, δv = δr/Δt.
    """
    drift = 0.0
    for i in range(3):
        P[i, i] += y[i] ** 2
        dv = y[3 + i] if m == 6 else y[i] / max(since, 1.0)
        P[3 + i, 3 + i] += dv**2
        drift += dv**2
    drift = math.sqrt(drift)
    speed = math.sqrt(velocity[0] ** 2 + velocity[1] ** 2)
    tilt = min(drift / (9.8 * max(since, 1.0)), 0.1)
    P[6, 6] += tilt**2
    P[7, 7] += tilt**2
    P[8, 8] += min(drift / max(speed, 1.0), 1.0) ** 2


@numba.njit(cache=True, nogil=True)
def _update(P: Any, K: Any, PHt: Any) -> None:
    """P ← P − K·(P Hᵀ)ᵀ, symmetric by construction."""
    n, m = K.shape
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for r in range(m):
                total += K[i, r] * PHt[j, r] + K[j, r] * PHt[i, r]
            P[i, j] -= 0.5 * total
            P[j, i] = P[i, j]


@numba.njit(cache=True, nogil=True)
def forward(
    unit: Any,
    measurements: Any,
    active: Any,
    position: Any,
    velocity: Any,
    q: Any,
    theta: Any,
    P0: Any,
    epoch_s: float,
    gates: Any,
    reentry_s: float,
    store: Any,
) -> Any:
    """Filter the whole flight; returns the number of epochs.

    active (n,): the states carried. position, velocity, q (w, x, y, z), theta (19,), P0 (n, n): the start, at unit.time[0].
    Measurements are applied at their exact times: an interval with one inside is cut there. gates (7,): by size, the largest
    normalised innovation squared that is believed (`_judge`); where positions are rejected for `reentry_s` on end and agree
    with each other, the filter doubts itself instead (`_doubt`).
    """
    time, gyro, accel = unit.time, unit.gyro, unit.accel
    count, n = time.size, active.size
    P = P0.copy()
    dcm = np.empty((3, 3))
    quaternion_to_dcm(q, dcm)
    dtheta, dv = np.empty(3), np.empty(3)
    w, f, w0, f0 = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    sum_force, sum_dcm, sum_rate, sum_cf = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    F, H_full, y = np.empty((NAVIGATION, STATES)), np.empty((6, STATES)), np.empty(6)
    noise = np.empty(STATES)
    dx_full = np.zeros(STATES)
    elapsed, unseen_turn, unseen_velocity = 0.0, 0.0, 0.0
    epoch, at = 0, 0
    while at < measurements.time.size and measurements.time[at] < time[0]:
        at += 1
    store.epoch_time[0], store.epoch_measurement[0] = time[0], -1
    pack(P, store.epoch_P[0])
    store.epoch_dcm[0], store.epoch_theta[0] = dcm, theta
    store.position[0], store.velocity[0], store.q[0], store.epoch[0] = position, velocity, q, 0
    refused, refused_since, refused_y = 0, 0.0, np.zeros(3)
    _correct(gyro[1], accel[1], theta, w0, f0)
    dt0 = time[1] - time[0]
    for k in range(1, count):
        start, end = time[k - 1], time[k]
        still = unit.still[k]
        while start < end:
            stop = end
            measured = False
            if at < measurements.time.size and measurements.time[at] <= end:
                stop, measured = max(measurements.time[at], start), True
            dt = stop - start
            if dt > 0.0:
                _correct(gyro[k], accel[k], theta, w, f)
                if still:
                    # A body at rest turns with the Earth: the attitude is held, and the gyros measure their own bias.
                    for i in range(3):
                        w[i] = OMEGA * (dcm[0, i] * math.cos(position[0]) - dcm[2, i] * math.sin(position[0]))
                increments(w, f, w0, f0, dt, dt0, dtheta, dv)
                for i in range(3):
                    for j in range(3):
                        c = dcm[i, j]
                        sum_dcm[i, j] += c * dt
                        sum_rate[i, j] += c * w[j] * dt
                        sum_cf[i, j] += c * f[j] * dt
                        sum_force[i] += c * dv[j]
                step(position, velocity, q, dcm, dtheta, dv, dt)
                elapsed += dt
                unseen_turn += unit.unseen[k, 0] * dt
                unseen_velocity += unit.unseen[k, 1] * dt
            start = stop
            # A gap and a standstill are epochs of their own, or their noise would be spread over the samples beside them.
            changes = stop == end and (
                unit.gap[k] or (k + 1 < count and (unit.gap[k + 1] or unit.still[k + 1] != still))
            )
            if measured or changes or elapsed >= epoch_s - 1e-9:
                phi, decay = store.epoch_phi[epoch], store.epoch_decay[epoch]
                if elapsed > 0.0:
                    dynamics(
                        position,
                        velocity,
                        sum_force / elapsed,
                        sum_dcm / elapsed,
                        sum_rate / elapsed,
                        sum_cf / elapsed,
                        still,
                        F,
                    )
                    _transition(F, decay, unit.inverse_tau, elapsed, active, phi)
                    base = unit.still_noise if still else unit.noise
                    noise[:] = base
                    for i in range(3):
                        noise[3 + i] += unseen_velocity / elapsed
                        noise[6 + i] += unseen_turn / elapsed
                    _propagate(P, phi, decay, active, noise, elapsed)
                    for i in range(6):
                        theta[i] *= decay[i]
                else:
                    phi[:] = 0.0
                    decay[:] = 1.0
                    for i in range(NAVIGATION):
                        phi[i, i] = 1.0
                sum_force[:] = 0.0
                sum_dcm[:] = 0.0
                sum_rate[:] = 0.0
                sum_cf[:] = 0.0
                elapsed, unseen_turn, unseen_velocity = 0.0, 0.0, 0.0
                epoch += 1
                store.epoch_time[epoch], store.epoch_measurement[epoch] = stop, -1
                store.epoch_dx[epoch] = 0.0
                if measured:
                    m, kind = measurements.size[at], measurements.kind[at]
                    H_full[:] = 0.0
                    variance = measurements.variance[at].copy()
                    if kind == FIX:
                        _at_fix(measurements, at, position, velocity, dcm, theta, H_full, y)
                    elif kind == STANDSTILL:
                        _at_rest(
                            measurements.rate[at],
                            measurements.force[at],
                            position[0],
                            velocity,
                            dcm,
                            theta,
                            H_full,
                            y,
                        )
                    else:
                        y[0] = position[2] - measurements.position[at, 2] - (dcm[2] * theta[_LEVER : _LEVER + 3]).sum()
                        H_full[0, 2] = 1.0
                    H = np.empty((m, n))
                    for i in range(m):
                        for j in range(n):
                            H[i, j] = H_full[i, active[j]]
                    PHt = P @ np.ascontiguousarray(H.T)
                    S = H @ PHt
                    for i in range(m):
                        S[i, i] += variance[i]
                        store.innovation[at, i] = y[i]
                        store.innovation_sigma[at, i] = math.sqrt(S[i, i])
                    nis = y[:m] @ np.linalg.solve(S, y[:m])
                    rows = m
                    if kind == FIX:
                        if measurements.use[at]:
                            # What a hypothesis about the start is judged by: no fix counts for more than the gate.
                            store.loglike[at] = -0.5 * (min(nis, gates[m]) + math.log(np.linalg.det(S)))
                            verdict = store.verdict[at]
                            _judge(S, y, m, gates[3], variance, verdict)
                            if verdict[0] != REJECTED:
                                refused = 0
                            else:
                                # A run of rejected positions counts only while they agree with each other.
                                apart, size = 0.0, 0.0
                                for i in range(3):
                                    apart += (y[i] - refused_y[i]) ** 2
                                    size += y[i] ** 2
                                    refused_y[i] = y[i]
                                if refused == 0 or apart > AGREE**2 * size:
                                    refused, refused_since = 0, stop
                                refused += 1
                                if refused >= FEWEST_REFUSED and stop - refused_since >= reentry_s:
                                    _doubt(P, y, m, stop - refused_since, velocity)
                                    verdict[:] = BELIEVED
                                    variance[:] = measurements.variance[at]
                                    store.reentry[at] = True
                                    refused = 0
                    elif kind == STANDSTILL:
                        _judge(S, y, m, gates[3], variance, store.verdict[at])
                    if kind != HEIGHT and measurements.use[at]:
                        rows = 0
                        for i in range(m):
                            if store.verdict[at, i // 3] != REJECTED:
                                H[rows], y[rows], variance[rows] = H[i], y[i], variance[i]
                                rows += 1
                    accept = measurements.use[at] and rows > 0
                    store.nis[at] = nis
                    store.used[at] = accept
                    if accept:
                        H = np.ascontiguousarray(H[:rows])
                        PHt = P @ np.ascontiguousarray(H.T)
                        S = H @ PHt
                        for i in range(rows):
                            S[i, i] += variance[i]
                        S_inv = np.linalg.inv(S)
                        K = PHt @ S_inv
                        dx = K @ y[:rows]
                        _update(P, K, PHt)
                        for j in range(n):
                            dx_full[active[j]] = dx[j]
                        rn, re = radii(position[0])
                        position[1] += dx_full[1] / ((re + position[2]) * math.cos(position[0]))
                        position[0] += dx_full[0] / (rn + position[2])
                        position[2] -= dx_full[2]
                        for i in range(3):
                            velocity[i] += dx_full[3 + i]
                        rotate_ned(q, dx_full[6:9])
                        quaternion_to_dcm(q, dcm)
                        for i in range(PARAMETERS):
                            theta[i] += dx_full[NAVIGATION + i]
                        store.epoch_dx[epoch] = dx
                        store.epoch_measurement[epoch] = at
                        store.rows[at] = rows
                        store.y[at, :rows] = y[:rows]
                        store.H[at, :rows] = H
                        store.S_inv[at, :rows, :rows] = S_inv
                        store.K[at, :, :rows] = K
                    at += 1
                pack(P, store.epoch_P[epoch])
                store.epoch_dcm[epoch], store.epoch_theta[epoch] = dcm, theta
        _correct(gyro[k], accel[k], theta, w0, f0)
        dt0 = time[k] - time[k - 1]
        # Where an epoch ends on the stamp, the estimate is the one after it.
        store.position[k], store.velocity[k], store.q[k], store.epoch[k] = position, velocity, q, epoch
    return epoch + 1


class Smoothed(NamedTuple):
    """What the smoother leaves, filled in place: correction (count, n), to be added to the estimate after each epoch; covariance
    of position, velocity and attitude (count, 9, 9); and at the epochs `chosen` (increasing) the parameters' variances (h, n − 9)
    and the adjoint λ (h, n), Λ (h, n, n) before the epoch's own measurement is counted."""

    correction: Any
    covariance: Any
    chosen: Any
    variance: Any
    adjoint: Any
    adjoint_matrix: Any

    @classmethod
    def empty(cls, count: int, n: int, chosen: Any) -> Smoothed:
        return cls(
            np.zeros((count, n)),
            np.empty((count, NAVIGATION, NAVIGATION)),
            chosen,
            np.empty((chosen.size, n - NAVIGATION)),
            np.zeros((chosen.size, n)),
            np.zeros((chosen.size, n, n)),
        )


@numba.njit(cache=True, nogil=True)
def backward(count: int, active: Any, store: Any, out: Any) -> None:
    """Modified Bryson–Frazier recursion over the first `count` epochs into `out`.

    x_s = x − P λ,  P_s = P − P Λ P, with λ ← Cᵀλ − Hᵀ S⁻¹ y, Λ ← CᵀΛC + Hᵀ S⁻¹ H across a measurement (C = I − K H) and
    λ ← Φᵀλ, Λ ← ΦᵀΛΦ across an epoch.
    """
    n = active.size
    lam = np.zeros(n)
    Lam = np.zeros((n, n))
    P = np.empty((n, n))
    wanted = out.chosen.size - 1
    for e in range(count - 1, -1, -1):
        unpack(store.epoch_P[e], P)
        out.correction[e] = -(P @ lam)
        PL = P @ Lam if wanted >= 0 and out.chosen[wanted] == e else P[:NAVIGATION] @ Lam
        rows = np.ascontiguousarray(P[:NAVIGATION])
        out.covariance[e] = rows[:, :NAVIGATION] - np.ascontiguousarray(PL[:NAVIGATION]) @ np.ascontiguousarray(rows.T)
        if wanted >= 0 and out.chosen[wanted] == e:
            for i in range(NAVIGATION, n):
                out.variance[wanted, i - NAVIGATION] = P[i, i] - (PL[i] * P[i]).sum()
            out.adjoint[wanted] = lam
            out.adjoint_matrix[wanted] = Lam
            wanted -= 1
        at = store.epoch_measurement[e]
        if at >= 0:
            m = store.rows[at]
            H = np.ascontiguousarray(store.H[at, :m])
            S_inv = np.ascontiguousarray(store.S_inv[at, :m, :m])
            K = np.ascontiguousarray(store.K[at, :, :m])
            y = store.y[at, :m]
            # Not expanded: where P is far larger than R, ΛKH cancels against Λ to nothing but rounding.
            Ht = np.ascontiguousarray(H.T)
            C = np.eye(n) - K @ H
            Ct = np.ascontiguousarray(C.T)
            lam = Ct @ lam - Ht @ (S_inv @ y)
            Lam = Ct @ (Lam @ C) + Ht @ (S_inv @ H)
        if e > 0:
            phi, decay = store.epoch_phi[e - 1], store.epoch_decay[e - 1]
            phi_t = np.ascontiguousarray(phi.T)
            # ΛΦ = Λ[:, :9]·Φ_nav + [0 | Λ[:, 9:]·decay], then Φᵀ from the left likewise.
            LP = np.ascontiguousarray(Lam[:, :NAVIGATION]) @ phi
            lam_next = phi_t @ lam[:NAVIGATION]
            for j in range(NAVIGATION, n):
                s = active[j] - NAVIGATION
                d = decay[s] if s < 6 else 1.0
                lam_next[j] += d * lam[j]
                for i in range(n):
                    LP[i, j] += Lam[i, j] * d
            lam = lam_next
            Lam = phi_t @ np.ascontiguousarray(LP[:NAVIGATION])
            for i in range(NAVIGATION, n):
                s = active[i] - NAVIGATION
                d = decay[s] if s < 6 else 1.0
                for j in range(n):
                    Lam[i, j] += d * LP[i, j]
            for i in range(n):
                for j in range(i):
                    mean = 0.5 * (Lam[i, j] + Lam[j, i])
                    Lam[i, j] = mean
                    Lam[j, i] = mean
