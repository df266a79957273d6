"""Error-state Kalman filter and modified Bryson–Frazier smoother, compiled.

State errors (true minus estimate), NSTATE = 21, see the slices below: position NED [m], velocity NED [m/s], attitude φ in
NED [rad] with C_true = exp(φ×)·C, gyro bias [rad/s], accelerometer bias [m/s²] (both first-order Gauss–Markov), gyro and
accelerometer scale factors [1] (constants).

The filter is closed-loop: after each fix the estimate takes the error up. The covariance is propagated over epochs, which
end at every fix and at the latest after `epoch_s`, with the transition matrix of the mean dynamics to second order. The
smoother is the modified Bryson–Frazier form [1]_: it needs no inverse of the predicted covariance, which is singular in
states without process noise, and the same recursion serves closed-loop estimates since x_s = x − P·λ.

References
----------
.. [1] G. J. Bierman, Fixed Interval Smoothing with Discrete Measurements, Int. J. Control 18 (1973) 65–75.
.. [2] P. D. Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd ed., ch. 14.
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

NSTATE = 21
POSITION, VELOCITY, ATTITUDE = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO_BIAS, ACCEL_BIAS = slice(9, 12), slice(12, 15)
GYRO_SCALE, ACCEL_SCALE = slice(15, 18), slice(18, 21)


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
def dynamics(
    position: Any,
    velocity: Any,
    force: Any,
    mean_dcm: Any,
    mean_dcm_rate: Any,
    mean_dcm_force: Any,
    inverse_tau: Any,
    out: Any,
) -> None:
    """The error dynamics F (21, 21) at the epoch's mean: C f [m/s²] in NED, C, C·diag(ω), C·diag(f)."""
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
            out[6 + i, 9 + j] -= mean_dcm[i, j]
            out[3 + i, 12 + j] -= mean_dcm[i, j]
            out[6 + i, 15 + j] -= mean_dcm_rate[i, j]
            out[3 + i, 18 + j] -= mean_dcm_force[i, j]
    for i in range(6):
        out[9 + i, 9 + i] = -inverse_tau[i]


@numba.njit(cache=True, nogil=True)
def _propagate(P: Any, transition: Any, noise: Any, dt: float) -> Any:
    """Φ P Φᵀ + Q; Q in the trapezoid form ½(Φ Q_c Φᵀ + Q_c)·dt, which also couples white noise into position."""
    work = P.copy()
    for i in range(NSTATE):
        work[i, i] += 0.5 * noise[i] * dt
    P_next = transition @ work @ np.ascontiguousarray(transition.T)
    for i in range(NSTATE):
        P_next[i, i] += 0.5 * noise[i] * dt
    for i in range(NSTATE):
        for j in range(i):
            mean = 0.5 * (P_next[i, j] + P_next[j, i])
            P_next[i, j] = mean
            P_next[j, i] = mean
    return P_next


class Fixes(NamedTuple):
    """GNSS fixes (m,): time [s]; lat, lon [rad], height [m] (m, 3); velocity NED (m, 3); variances (m, 6); the body's rate at
    the fix (m, 3) [rad/s]; size 6 with velocity, 3 without."""

    time: Any
    position: Any
    velocity: Any
    variance: Any
    rate: Any
    size: Any


class Store(NamedTuple):
    """What the filter leaves behind, filled in place: the estimate at each stamp and the epochs closed by then; at each epoch's
    end its time, covariance, transition from the epoch before, fix (or −1), correction taken up, biases and C; for each fix
    H, S⁻¹, K, innovation, normalised innovation squared, and whether it was used."""

    position: Any
    velocity: Any
    q: Any
    epoch: Any
    epoch_time: Any
    epoch_P: Any
    epoch_phi: Any
    epoch_fix: Any
    epoch_dx: Any
    epoch_bias: Any
    epoch_dcm: Any
    H: Any
    S_inv: Any
    K: Any
    innovation: Any
    nis: Any
    used: Any

    @classmethod
    def empty(cls, stamps: int, epochs: int, fixes: int) -> Store:
        n = NSTATE
        return cls(
            np.empty((stamps, 3)),
            np.empty((stamps, 3)),
            np.empty((stamps, 4)),
            np.empty(stamps, np.int64),
            np.empty(epochs),
            np.empty((epochs, n, n)),
            np.empty((epochs, n, n)),
            np.full(epochs, -1, np.int64),
            np.zeros((epochs, n)),
            np.empty((epochs, 12)),
            np.empty((epochs, 3, 3)),
            np.zeros((fixes, 6, n)),
            np.zeros((fixes, 6, 6)),
            np.zeros((fixes, n, 6)),
            np.zeros((fixes, 6)),
            np.full(fixes, np.nan),
            np.zeros(fixes, np.bool_),
        )


@numba.njit(cache=True, nogil=True)
def forward(
    time: Any,
    gyro: Any,
    accel: Any,
    gap: Any,
    fixes: Any,
    lever: Any,
    position: Any,
    velocity: Any,
    q: Any,
    bias: Any,
    P0: Any,
    noise: Any,
    gap_noise: Any,
    inverse_tau: Any,
    epoch_s: float,
    gates: Any,
    reentry_s: float,
    store: Any,
) -> Any:
    """Filter the whole flight; returns the number of epochs.

    time (n,): stamps, time[0] is the start; gyro, accel (n, 3): means over (time[i−1], time[i]], body axes. Fixes are
    applied at their exact times: an interval with a fix inside is cut there. bias (12,): gyro and accelerometer bias,
    gyro and accelerometer scale factor.
    """
    n = time.size
    nfix = fixes.time.size
    P = P0.copy()
    dcm = np.empty((3, 3))
    quaternion_to_dcm(q, dcm)
    theta, dv = np.empty(3), np.empty(3)
    w, f, w0, f0 = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    sum_force, sum_dcm, sum_rate, sum_cf = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    F, identity = np.empty((NSTATE, NSTATE)), np.eye(NSTATE)
    q_epoch = np.empty(NSTATE)
    elapsed, gap_elapsed = 0.0, 0.0
    epoch, fix = 0, 0
    while fix < nfix and fixes.time[fix] < time[0]:
        fix += 1
    store.epoch_time[0], store.epoch_fix[0] = time[0], -1
    store.epoch_P[0], store.epoch_dcm[0] = P, dcm
    store.epoch_bias[0] = bias
    store.position[0], store.velocity[0], store.q[0], store.epoch[0] = position, velocity, q, 0
    last_accepted = time[0]
    for i in range(3):
        w0[i] = (gyro[1, i] - bias[i]) / (1.0 + bias[6 + i])
        f0[i] = (accel[1, i] - bias[3 + i]) / (1.0 + bias[9 + i])
    dt0 = time[1] - time[0]
    for k in range(1, n):
        start, end = time[k - 1], time[k]
        while start < end:
            stop = end
            at_fix = False
            if fix < nfix and fixes.time[fix] <= end:
                stop, at_fix = max(fixes.time[fix], start), True
            dt = stop - start
            if dt > 0.0:
                for i in range(3):
                    w[i] = (gyro[k, i] - bias[i]) / (1.0 + bias[6 + i])
                    f[i] = (accel[k, i] - bias[3 + i]) / (1.0 + bias[9 + i])
                increments(w, f, w0, f0, dt, dt0, theta, dv)
                for i in range(3):
                    for j in range(3):
                        c = dcm[i, j]
                        sum_dcm[i, j] += c * dt
                        sum_rate[i, j] += c * w[j] * dt
                        sum_cf[i, j] += c * f[j] * dt
                        sum_force[i] += c * dv[j]
                step(position, velocity, q, dcm, theta, dv, dt)
                elapsed += dt
                if gap[k]:
                    gap_elapsed += dt
            start = stop
            # A gap is an epoch of its own, or its noise would be spread over the good samples beside it.
            at_gap = stop == end and (gap[k] or (k + 1 < n and gap[k + 1]))
            if at_fix or at_gap or elapsed >= epoch_s - 1e-9:
                # Close the epoch: propagate, then (at a fix) update.
                phi = store.epoch_phi[epoch]
                if elapsed > 0.0:
                    dynamics(
                        position,
                        velocity,
                        sum_force / elapsed,
                        sum_dcm / elapsed,
                        sum_rate / elapsed,
                        sum_cf / elapsed,
                        inverse_tau,
                        F,
                    )
                    F *= elapsed
                    phi[:] = identity + F + 0.5 * (F @ F)
                    for i in range(NSTATE):
                        q_epoch[i] = noise[i] + gap_noise[i] * gap_elapsed / elapsed
                    P = _propagate(P, phi, q_epoch, elapsed)
                else:
                    phi[:] = identity
                sum_force[:] = 0.0
                sum_dcm[:] = 0.0
                sum_rate[:] = 0.0
                sum_cf[:] = 0.0
                elapsed, gap_elapsed = 0.0, 0.0
                epoch += 1
                store.epoch_time[epoch], store.epoch_fix[epoch] = stop, -1
                store.epoch_dx[epoch] = 0.0
                if at_fix:
                    m = fixes.size[fix]
                    H = store.H[fix]
                    H[:] = 0.0
                    rn, re = radii(position[0])
                    arm = dcm @ lever
                    y = store.innovation[fix]
                    y[0] = (fixes.position[fix, 0] - position[0]) * (rn + position[2]) - arm[0]
                    y[1] = (fixes.position[fix, 1] - position[1]) * (re + position[2]) * math.cos(position[0]) - arm[1]
                    y[2] = -(fixes.position[fix, 2] - position[2]) - arm[2]
                    for i in range(3):
                        H[i, i] = 1.0
                    _cross_into(H, 0, 6, arm[0], arm[1], arm[2], -1.0)
                    if m == 6:
                        rate = np.empty(3)
                        for i in range(3):
                            rate[i] = (fixes.rate[fix, i] - bias[i]) / (1.0 + bias[6 + i])
                        # ω_eb in body axes: Earth rotation taken off.
                        ien, ied = OMEGA * math.cos(position[0]), -OMEGA * math.sin(position[0])
                        for i in range(3):
                            rate[i] -= dcm[0, i] * ien + dcm[2, i] * ied
                        swing = np.empty(3)
                        swing[0] = rate[1] * lever[2] - rate[2] * lever[1]
                        swing[1] = rate[2] * lever[0] - rate[0] * lever[2]
                        swing[2] = rate[0] * lever[1] - rate[1] * lever[0]
                        swing = dcm @ swing
                        for i in range(3):
                            y[3 + i] = fixes.velocity[fix, i] - velocity[i] - swing[i]
                            H[3 + i, 3 + i] = 1.0
                        _cross_into(H, 3, 6, swing[0], swing[1], swing[2], -1.0)
                        # v_antenna has C(−δb×l) = C[l×]δb
                        arm_cross = np.zeros((3, 3))
                        _cross_into(arm_cross, 0, 0, lever[0], lever[1], lever[2], 1.0)
                        H[3:6, 9:12] = dcm @ arm_cross
                    Hm = np.ascontiguousarray(H[:m])
                    PHt = P @ np.ascontiguousarray(Hm.T)
                    S = Hm @ PHt
                    for i in range(m):
                        S[i, i] += fixes.variance[fix, i]
                    S_inv = np.linalg.inv(S)
                    store.nis[fix] = y[:m] @ (S_inv @ y[:m])
                    inflate = 1.0
                    accept = store.nis[fix] <= gates[m]
                    if not accept and stop - last_accepted >= reentry_s:
                        # The filter may be the one that is wrong: let the fix in, weighed down to what the gate allows.
                        inflate = store.nis[fix] / gates[m]
                        for i in range(m):
                            S[i, i] += (inflate - 1.0) * fixes.variance[fix, i]
                        S_inv = np.linalg.inv(S)
                        store.nis[fix] = y[:m] @ (S_inv @ y[:m])
                        accept = True
                    store.used[fix] = accept
                    if accept:
                        last_accepted = stop
                        K = PHt @ S_inv
                        dx = K @ y[:m]
                        C = identity - K @ Hm
                        P = C @ P @ np.ascontiguousarray(C.T)
                        for r in range(m):
                            variance = inflate * fixes.variance[fix, r]
                            for i in range(NSTATE):
                                scaled = K[i, r] * variance
                                for j in range(NSTATE):
                                    P[i, j] += scaled * K[j, r]
                        position[0] += dx[0] / (rn + position[2])
                        position[1] += dx[1] / ((re + position[2]) * math.cos(position[0]))
                        position[2] -= dx[2]
                        for i in range(3):
                            velocity[i] += dx[3 + i]
                        rotate_ned(q, dx[6:9])
                        quaternion_to_dcm(q, dcm)
                        for i in range(12):
                            bias[i] += dx[9 + i]
                        store.epoch_dx[epoch] = dx
                        store.epoch_fix[epoch] = fix
                        store.S_inv[fix, :m, :m] = S_inv
                        store.K[fix, :, :m] = K
                    fix += 1
                store.epoch_P[epoch], store.epoch_dcm[epoch] = P, dcm
                store.epoch_bias[epoch] = bias
        for i in range(3):
            w0[i] = (gyro[k, i] - bias[i]) / (1.0 + bias[6 + i])
            f0[i] = (accel[k, i] - bias[3 + i]) / (1.0 + bias[9 + i])
        dt0 = time[k] - time[k - 1]
        # Where an epoch ends on the stamp, the estimate is the one after it.
        store.position[k], store.velocity[k], store.q[k], store.epoch[k] = position, velocity, q, epoch
    return epoch + 1


@numba.njit(cache=True, nogil=True)
def backward(count: int, fix_size: Any, store: Any, correction: Any, smoothed_P: Any) -> None:
    """Modified Bryson–Frazier recursion over the first `count` epochs.

    Fills correction (count, 21), to be added to the estimate after each epoch, and the smoothed covariance of position,
    velocity and attitude (count, 9, 9):  x_s = x − P λ,  P_s = P − P Λ P, with λ ← Cᵀλ − Hᵀ S⁻¹ y, Λ ← CᵀΛC + Hᵀ S⁻¹ H
    across a fix (C = I − K H) and λ ← Φᵀλ, Λ ← ΦᵀΛΦ across an epoch.
    """
    lam = np.zeros(NSTATE)
    Lam = np.zeros((NSTATE, NSTATE))
    identity = np.eye(NSTATE)
    for e in range(count - 1, -1, -1):
        P = store.epoch_P[e]
        correction[e] = -(P @ lam)
        rows = np.ascontiguousarray(P[:9])
        smoothed_P[e] = np.ascontiguousarray(P[:9, :9]) - rows @ Lam @ np.ascontiguousarray(rows.T)
        fix = store.epoch_fix[e]
        if fix >= 0:
            m = fix_size[fix]
            H = np.ascontiguousarray(store.H[fix, :m])
            S_inv = np.ascontiguousarray(store.S_inv[fix, :m, :m])
            K = np.ascontiguousarray(store.K[fix, :, :m])
            Ct = np.ascontiguousarray((identity - K @ H).T)
            Ht_S = np.ascontiguousarray(H.T) @ S_inv
            lam = Ct @ lam - Ht_S @ store.innovation[fix, :m]
            Lam = Ct @ Lam @ np.ascontiguousarray(Ct.T) + Ht_S @ H
        if e > 0:
            phi_t = np.ascontiguousarray(store.epoch_phi[e - 1].T)
            lam = phi_t @ lam
            Lam = phi_t @ Lam @ np.ascontiguousarray(phi_t.T)
            for i in range(NSTATE):
                for j in range(i):
                    mean = 0.5 * (Lam[i, j] + Lam[j, i])
                    Lam[i, j] = mean
                    Lam[j, i] = mean
