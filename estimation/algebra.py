"""The algebra of the compiled engine: small matrices as loops, in one order of summation.

Plain functions of arrays that numba compiles as they stand. A measurement has one to three components: H is (3, n) and
R (3, 3), of which the leading m rows are used.
"""

from __future__ import annotations

import numpy as np

from estimation.frames import Array


def cross_covariance(P: Array, H: Array, m: int) -> Array:
    """Return P H', (n, 3) of which m columns are used."""
    n = P.shape[0]
    PHt = np.zeros((n, 3))
    for j in range(m):
        for k in range(n):
            h = H[j, k]
            if h != 0.0:
                for i in range(n):
                    PHt[i, j] += P[i, k] * h
    return PHt


def gain(PHt: Array, inverse: Array, m: int) -> Array:
    """Return the Kalman gain P H' S^-1, (n, 3) of which m columns are used."""
    n = PHt.shape[0]
    K = np.zeros((n, 3))
    for i in range(n):
        for j in range(m):
            for k in range(m):
                K[i, j] += PHt[i, k] * inverse[k, j]
    return K


def corrected(K: Array, r: Array, m: int) -> Array:
    """Return the error state K r, (n,)."""
    n = K.shape[0]
    error = np.zeros(n)
    for i in range(n):
        for j in range(m):
            error[i] += K[i, j] * r[j]
    return error


def innovation_covariance(H: Array, PHt: Array, R: Array, scale: float, m: int) -> Array:
    """Return H P H' + scale R, (3, 3) of which m rows are used."""
    S = np.zeros((3, 3))
    for i in range(m):
        for j in range(m):
            S[i, j] = scale * R[i, j]
            for k in range(PHt.shape[0]):
                S[i, j] += H[i, k] * PHt[k, j]
    return S


def determinant(S: Array, m: int) -> float:
    """Return the determinant of the leading (m, m) part."""
    if m == 1:
        return float(S[0, 0])
    minor = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    if m == 2:
        return float(minor)
    return float(
        S[2, 2] * minor
        - S[2, 1] * (S[0, 0] * S[1, 2] - S[0, 2] * S[1, 0])
        + S[2, 0] * (S[0, 1] * S[1, 2] - S[0, 2] * S[1, 1])
    )


def inverse(S: Array, m: int) -> Array:
    """Return the inverse of the leading (m, m) part of a positive definite matrix, by Gauss-Jordan."""
    A = S.copy()
    B = np.eye(3)
    for c in range(m):
        scale = 1.0 / A[c, c]
        for j in range(m):
            A[c, j] *= scale
            B[c, j] *= scale
        for i in range(m):
            if i != c:
                f = A[i, c]
                for j in range(m):
                    A[i, j] -= f * A[c, j]
                    B[i, j] -= f * B[c, j]
    return B


def joseph(P: Array, K: Array, H: Array, R: Array, scale: float, m: int) -> None:
    """Replace P by (I - KH) P (I - KH)' + K scale R K', and symmetrise it."""
    n = P.shape[0]
    B = P.copy()
    for j in range(m):
        HP = np.zeros(n)
        for k in range(n):
            h = H[j, k]
            if h != 0.0:
                for c in range(n):
                    HP[c] += h * P[k, c]
        for i in range(n):
            for c in range(n):
                B[i, c] -= K[i, j] * HP[c]
    # Columns: B (I - KH)' = B - (B H') K'; then the noise. Few columns of H have an entry.
    C, turned = np.zeros((n, 3)), np.empty((3, n))
    for j in range(m):
        for k in range(n):
            h = H[j, k]
            if h != 0.0:
                for i in range(n):
                    C[i, j] -= B[i, k] * h
        for i in range(n):
            turned[j, i] = K[i, j]
            for k in range(m):
                C[i, j] += scale * K[i, k] * R[k, j]
    for i in range(n):
        for j in range(m):
            for c in range(n):
                B[i, c] += C[i, j] * turned[j, c]
    for i in range(n):
        for c in range(i + 1):
            mean = 0.5 * (B[i, c] + B[c, i])
            P[i, c] = mean
            P[c, i] = mean


def reset_attitude(P: Array, G: Array, att: int) -> None:
    """Carry the attitude's covariance over to the new nominal attitude: G P G', G (3, 3) on its three entries."""
    n = P.shape[0]
    old = np.empty(3)
    for c in range(n):
        for i in range(3):
            old[i] = P[att + i, c]
        for i in range(3):
            P[att + i, c] = G[i, 0] * old[0] + G[i, 1] * old[1] + G[i, 2] * old[2]
    for c in range(n):
        for i in range(3):
            old[i] = P[c, att + i]
        for i in range(3):
            P[c, att + i] = G[i, 0] * old[0] + G[i, 1] * old[1] + G[i, 2] * old[2]
    for i in range(n):
        for c in range(i):
            mean = 0.5 * (P[i, c] + P[c, i])
            P[i, c] = mean
            P[c, i] = mean


def congruence(A: Array, P: Array, out: Array) -> None:
    """Write A P A' (m, m) for A (m, n) with few entries."""
    m, n = A.shape
    AP = np.zeros((m, n))
    for i in range(m):
        for k in range(n):
            if A[i, k] != 0.0:
                for j in range(n):
                    AP[i, j] += A[i, k] * P[k, j]
    for i in range(m):
        for j in range(m):
            value = 0.0
            for k in range(n):
                if A[j, k] != 0.0:
                    value += AP[i, k] * A[j, k]
            out[i, j] = value
