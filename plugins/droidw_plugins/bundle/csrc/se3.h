// Rigid motions [tx ty tz qx qy qz qw] in double precision; droidw.geometry.se3 says the same.
#pragma once

#include "cell.h"

namespace dw {

template <class S>
DW_HD void load_pose(const S* from, double* T) {
    double n = 0;
    for (int k = 0; k < 7; ++k) T[k] = double(from[k]);
    for (int k = 3; k < 7; ++k) n += T[k] * T[k];
    n = sqrt(n);
    for (int k = 3; k < 7; ++k) T[k] /= n;
}

DW_HD void rotation(const double* T, double* R) {
    const double x = T[3], y = T[4], z = T[5], w = T[6];
    R[0] = 1 - 2 * (y * y + z * z);
    R[1] = 2 * (x * y - w * z);
    R[2] = 2 * (x * z + w * y);
    R[3] = 2 * (x * y + w * z);
    R[4] = 1 - 2 * (x * x + z * z);
    R[5] = 2 * (y * z - w * x);
    R[6] = 2 * (x * z - w * y);
    R[7] = 2 * (y * z + w * x);
    R[8] = 1 - 2 * (x * x + y * y);
}

// G_ij = T_j T_i^-1 of two poses as they are stored.
template <class S>
DW_HD Motion<double> relative_motion(const S* pose_i, const S* pose_j) {
    double Ti[7], Tj[7], Ri[9], Rj[9];
    load_pose(pose_i, Ti);
    load_pose(pose_j, Tj);
    rotation(Ti, Ri);
    rotation(Tj, Rj);
    Motion<double> G;
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c)
            G.R[3 * r + c] = Rj[3 * r] * Ri[3 * c] + Rj[3 * r + 1] * Ri[3 * c + 1] +
                             Rj[3 * r + 2] * Ri[3 * c + 2];
    for (int r = 0; r < 3; ++r)
        G.t[r] = Tj[r] - (G.R[3 * r] * Ti[0] + G.R[3 * r + 1] * Ti[1] + G.R[3 * r + 2] * Ti[2]);
    return G;
}

template <class S>
DW_HD Motion<S> rounded(const Motion<double>& G) {
    Motion<S> out;
    for (int k = 0; k < 9; ++k) out.R[k] = S(G.R[k]);
    for (int k = 0; k < 3; ++k) out.t[k] = S(G.t[k]);
    return out;
}

// Ad(G) = [[R, [t]x R], [0, R]], 6x6 row by row.
DW_HD void adjoint(const Motion<double>& G, double* Ad) {
    for (int c = 0; c < 3; ++c) {
        const double r0 = G.R[c], r1 = G.R[3 + c], r2 = G.R[6 + c];
        for (int r = 0; r < 3; ++r) {
            Ad[6 * r + c] = Ad[6 * (r + 3) + c + 3] = G.R[3 * r + c];
            Ad[6 * (r + 3) + c] = 0;
        }
        Ad[c + 3] = G.t[1] * r2 - G.t[2] * r1;
        Ad[6 + c + 3] = G.t[2] * r0 - G.t[0] * r2;
        Ad[12 + c + 3] = G.t[0] * r1 - G.t[1] * r0;
    }
}

DW_HD void quaternion_product(const double* a, const double* b, double* out) {
    out[0] = a[3] * b[0] + b[3] * a[0] + a[1] * b[2] - a[2] * b[1];
    out[1] = a[3] * b[1] + b[3] * a[1] + a[2] * b[0] - a[0] * b[2];
    out[2] = a[3] * b[2] + b[3] * a[2] + a[0] * b[1] - a[1] * b[0];
    out[3] = a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2];
}

// exp(xi) as a pose, xi = (tau, phi).
DW_HD void exponential(const double* xi, double* T) {
    const double *tau = xi, *phi = xi + 3;
    const double theta2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2];
    double s, w, c;  // sin(theta/2) / theta, cos(theta/2), (theta - sin theta) / theta^3
    if (theta2 < 0.25) {
        // power series, exact to rounding below half a radian
        const double q = 0.25 * theta2;
        double sine = 1, cosine = 1, cubic = 1.0 / 6, term_s = 1, term_c = 1, term = 1.0 / 6;
        for (int k = 1; k < 9; ++k) {
            term_s *= -q / ((2 * k) * (2 * k + 1));
            term_c *= -q / ((2 * k - 1) * (2 * k));
            term *= -theta2 / ((2 * k + 2) * (2 * k + 3));
            sine += term_s;
            cosine += term_c;
            cubic += term;
        }
        s = 0.5 * sine;
        w = cosine;
        c = cubic;
    } else {
        const double theta = sqrt(theta2);
        s = sin(0.5 * theta) / theta;
        w = cos(0.5 * theta);
        c = (theta - sin(theta)) / (theta2 * theta);
    }
    const double b = 2 * s * s;
    const double x[3] = {
        phi[1] * tau[2] - phi[2] * tau[1], phi[2] * tau[0] - phi[0] * tau[2],
        phi[0] * tau[1] - phi[1] * tau[0]};
    const double xx[3] = {
        phi[1] * x[2] - phi[2] * x[1], phi[2] * x[0] - phi[0] * x[2],
        phi[0] * x[1] - phi[1] * x[0]};
    for (int k = 0; k < 3; ++k) {
        T[k] = tau[k] + b * x[k] + c * xx[k];
        T[3 + k] = s * phi[k];
    }
    T[6] = w;
}

// exp(xi) T with a quaternion of length one; T as it is stored.
template <class S>
DW_HD void retract(const S* pose, const double* xi, S* out) {
    double T[7], X[7], R[9], q[4];
    load_pose(pose, T);
    exponential(xi, X);
    rotation(X, R);
    quaternion_product(X + 3, T + 3, q);
    const double n = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int k = 0; k < 3; ++k)
        out[k] = S(R[3 * k] * T[0] + R[3 * k + 1] * T[1] + R[3 * k + 2] * T[2] + X[k]);
    for (int k = 0; k < 4; ++k) out[3 + k] = S(q[k] / n);
}

}  // namespace dw
