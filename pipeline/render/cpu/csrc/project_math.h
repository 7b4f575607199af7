// Projection of several Gaussians at a time, in float64, and its derivative. Sources: Kerbl et al.
// 2023 (covariance), Zwicker et al. 2002 (EWA), Yu et al. 2024 (compensation). `project` in
// reference.py is a readable equivalent.
#pragma once

#include "simd_math.h"
#include "types.h"

namespace splat {

// One register: about a hundred values are live, and wider vectors would be spilled more often.
constexpr int kProjectLanes = kRegisterBytes / int(sizeof(double));
using Lanes = Vector<double, kProjectLanes>;
using LaneMask = Mask<double, kProjectLanes>;
SPLAT_INLINE Lanes all_lanes(double x) { return broadcast<Lanes>(x); }

struct Vec3 {
    Lanes x, y, z;
};
SPLAT_INLINE Lanes dot(const Vec3& a, const Vec3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
SPLAT_INLINE Vec3 operator*(Lanes s, const Vec3& v) { return {s * v.x, s * v.y, s * v.z}; }
SPLAT_INLINE Vec3 operator+(const Vec3& a, const Vec3& b) {
    return {a.x + b.x, a.y + b.y, a.z + b.z};
}
SPLAT_INLINE Vec3 operator-(const Vec3& a, const Vec3& b) {
    return {a.x - b.x, a.y - b.y, a.z - b.z};
}
SPLAT_INLINE Vec3 row(const double* matrix, int i) {
    return {all_lanes(matrix[3 * i]), all_lanes(matrix[3 * i + 1]), all_lanes(matrix[3 * i + 2])};
}

struct Inputs {
    Vec3 mean, log_scale;
    Lanes quat[4], opacity_logit;
};

struct Projected {
    // Intermediate values for backward
    Lanes norm2, inv_norm, q[4];  // squared norm of the quaternion, its inverse norm, normalised
    Vec3 r[3], m[3];              // rows of R and of M = R S
    Lanes scale[3];
    Vec3 cam;           // centre in the camera's frame
    Lanes inv_z, u, v;  // 1/z; x/z and y/z, clamped
    Vec3 t[2];          // rows of T = J W
    Vec3 h[2];          // rows of H = T M; Sigma' = H H^T
    Lanes plain_det,
        ratio;  // undilated det of Sigma', and its ratio to the dilated one (antialias)
    Lanes sigmoid;
    // Results
    Lanes x, y;        // pixels
    Lanes xx, xy, yy;  // dilated covariance, px^2
    Lanes det, opacity;
};

SPLAT_INLINE Vec3 in_camera(const Vec3& mean, const View& view) {
    const double* t = view.translation;
    return {dot(row(view.rotation, 0), mean) + t[0], dot(row(view.rotation, 1), mean) + t[1],
            dot(row(view.rotation, 2), mean) + t[2]};
}

SPLAT_INLINE Projected project(const Inputs& in, const View& view) {
    Projected p;
    p.norm2 = in.quat[0] * in.quat[0] + in.quat[1] * in.quat[1] + in.quat[2] * in.quat[2] +
              in.quat[3] * in.quat[3];
    p.inv_norm = inverse_sqrt(p.norm2);
    for (int i = 0; i < 4; i++) p.q[i] = in.quat[i] * p.inv_norm;
    const Lanes w = p.q[0], x = p.q[1], y = p.q[2], z = p.q[3];
    p.r[0] = {1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)};
    p.r[1] = {2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)};
    p.r[2] = {2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)};
    p.scale[0] = exp(in.log_scale.x);
    p.scale[1] = exp(in.log_scale.y);
    p.scale[2] = exp(in.log_scale.z);
    for (int i = 0; i < 3; i++)
        p.m[i] = {p.r[i].x * p.scale[0], p.r[i].y * p.scale[1], p.r[i].z * p.scale[2]};

    p.cam = in_camera(in.mean, view);
    p.inv_z = reciprocal(p.cam.z);
    const Lanes u = p.cam.x * p.inv_z, v = p.cam.y * p.inv_z;
    p.x = view.fx * u + view.cx;
    p.y = view.fy * v + view.cy;

    p.u = clamp(u, view.min_u, view.max_u);
    p.v = clamp(v, view.min_v, view.max_v);
    const Vec3 forward = row(view.rotation, 2);
    p.t[0] = (view.fx * p.inv_z) * (row(view.rotation, 0) - p.u * forward);
    p.t[1] = (view.fy * p.inv_z) * (row(view.rotation, 1) - p.v * forward);
    for (int i = 0; i < 2; i++) p.h[i] = p.t[i].x * p.m[0] + p.t[i].y * p.m[1] + p.t[i].z * p.m[2];
    const Lanes xx = dot(p.h[0], p.h[0]), yy = dot(p.h[1], p.h[1]);
    p.xy = dot(p.h[0], p.h[1]);
    p.xx = xx + kDilation;
    p.yy = yy + kDilation;
    // Lagrange's identity |a|^2 |b|^2 - (a.b)^2 = |a x b|^2 avoids cancellation for thin Gaussians.
    const Vec3 a = p.h[0], b = p.h[1];
    const Vec3 cross = {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
    p.plain_det = dot(cross, cross);
    p.det = p.plain_det + kDilation * (xx + yy + kDilation);

    p.sigmoid = reciprocal(1.0 + exp(-in.opacity_logit));
    p.opacity = p.sigmoid;
    if (view.antialias) {
        p.ratio = p.plain_det / p.det;
        p.opacity *= sqrt(select(p.ratio > kCompensationMin, p.ratio, all_lanes(kCompensationMin)));
    }
    return p;
}

// dL/d(projected Gaussian)
struct ImageGradients {
    Lanes x, y;        // centre, pixels
    Lanes xx, xy, yy;  // dilated covariance; xy counts both off-diagonal entries
    Lanes depth;
    Lanes ln_opacity;  // of the compensated opacity
};

struct InputGradients {
    Vec3 mean, log_scale;
    Lanes quat[4], opacity_logit;
    // Intermediate gradients for the camera: of the centre in its frame, and of the rows of T.
    Vec3 cam, t[2];
};

SPLAT_INLINE InputGradients project_backward(const Projected& p, const ImageGradients& g,
                                             const View& view) {
    InputGradients out;
    Lanes d_xx = g.xx, d_xy = g.xy, d_yy = g.yy;
    out.opacity_logit = g.ln_opacity * (1.0 - p.sigmoid);
    if (view.antialias) {
        // ln opacity = ln sigmoid + (ln plain_det - ln det) / 2 above the lower bound
        const Lanes half = select(p.ratio > kCompensationMin, 0.5 * g.ln_opacity, all_lanes(0.0));
        const Lanes plain = half / select(p.plain_det > 0.0, p.plain_det, all_lanes(1.0));
        const Lanes dilated = half / p.det;
        d_xx += plain * (p.yy - kDilation) - dilated * p.yy;
        d_yy += plain * (p.xx - kDilation) - dilated * p.xx;
        d_xy -= 2.0 * p.xy * (plain - dilated);
    }
    // Sigma' = H H^T, H = T M
    const Vec3 d_h[2] = {2.0 * d_xx * p.h[0] + d_xy * p.h[1], 2.0 * d_yy * p.h[1] + d_xy * p.h[0]};
    Vec3(&d_t)[2] = out.t, d_m[3];
    for (int i = 0; i < 2; i++)
        d_t[i] = {dot(p.m[0], d_h[i]), dot(p.m[1], d_h[i]), dot(p.m[2], d_h[i])};
    d_m[0] = p.t[0].x * d_h[0] + p.t[1].x * d_h[1];
    d_m[1] = p.t[0].y * d_h[0] + p.t[1].y * d_h[1];
    d_m[2] = p.t[0].z * d_h[0] + p.t[1].z * d_h[1];

    // M = R S
    out.log_scale = {
        p.m[0].x * d_m[0].x + p.m[1].x * d_m[1].x + p.m[2].x * d_m[2].x,
        p.m[0].y * d_m[0].y + p.m[1].y * d_m[1].y + p.m[2].y * d_m[2].y,
        p.m[0].z * d_m[0].z + p.m[1].z * d_m[1].z + p.m[2].z * d_m[2].z,
    };
    Vec3 d_r[3];
    for (int i = 0; i < 3; i++)
        d_r[i] = {d_m[i].x * p.scale[0], d_m[i].y * p.scale[1], d_m[i].z * p.scale[2]};
    const Lanes w = p.q[0], x = p.q[1], y = p.q[2], z = p.q[3];
    const Lanes d_q[4] = {
        2.0 * (x * (d_r[2].y - d_r[1].z) + y * (d_r[0].z - d_r[2].x) + z * (d_r[1].x - d_r[0].y)),
        2.0 * (w * (d_r[2].y - d_r[1].z) + y * (d_r[0].y + d_r[1].x) + z * (d_r[0].z + d_r[2].x) -
               2.0 * x * (d_r[1].y + d_r[2].z)),
        2.0 * (w * (d_r[0].z - d_r[2].x) + x * (d_r[0].y + d_r[1].x) + z * (d_r[1].z + d_r[2].y) -
               2.0 * y * (d_r[0].x + d_r[2].z)),
        2.0 * (w * (d_r[1].x - d_r[0].y) + x * (d_r[0].z + d_r[2].x) + y * (d_r[1].z + d_r[2].y) -
               2.0 * z * (d_r[0].x + d_r[1].y)),
    };
    const Lanes along = w * d_q[0] + x * d_q[1] + y * d_q[2] + z * d_q[3];
    for (int i = 0; i < 4; i++) out.quat[i] = (d_q[i] - along * p.q[i]) * p.inv_norm;

    // T's rows: f / z (W_i - u W_2), with u clamped; the centre: f x / z + c
    const Vec3 forward = row(view.rotation, 2);
    const Lanes free_u = p.cam.x * p.inv_z, free_v = p.cam.y * p.inv_z;
    const Lanes zero = all_lanes(0.0);
    const Lanes d_u =
        select(free_u == p.u, -view.fx * p.inv_z * dot(d_t[0], forward), zero) + view.fx * g.x;
    const Lanes d_v =
        select(free_v == p.v, -view.fy * p.inv_z * dot(d_t[1], forward), zero) + view.fy * g.y;
    const Vec3& d_cam = out.cam = {
        d_u * p.inv_z, d_v * p.inv_z,
        g.depth -
            (dot(d_t[0], p.t[0]) + dot(d_t[1], p.t[1]) + d_u * free_u + d_v * free_v) * p.inv_z};
    out.mean =
        d_cam.x * row(view.rotation, 0) + d_cam.y * row(view.rotation, 1) + d_cam.z * forward;
    return out;
}

// dL/d(each of the camera's parameters), without the dependence of colours on the viewing direction
// (`perturbed` in reference.py defines the parameters). g and d: input and output of
// project_backward.
SPLAT_INLINE void camera_backward(const Projected& p, const ImageGradients& g,
                                  const InputGradients& d, const View& view,
                                  Lanes (&out)[kCameraParameters]) {
    const Vec3 w[3] = {row(view.rotation, 0), row(view.rotation, 1), row(view.rotation, 2)};
    // T = (f / z) (W_i - u W_2); a rotation changes the columns of W like the centre.
    const Lanes scale_x = view.fx * p.inv_z, scale_y = view.fy * p.inv_z;
    const Vec3 d_w[3] = {scale_x * d.t[0], scale_y * d.t[1],
                         (-scale_x * p.u) * d.t[0] + (-scale_y * p.v) * d.t[1]};
    out[0] = p.cam.y * d.cam.z - p.cam.z * d.cam.y + dot(w[1], d_w[2]) - dot(w[2], d_w[1]);
    out[1] = p.cam.z * d.cam.x - p.cam.x * d.cam.z + dot(w[2], d_w[0]) - dot(w[0], d_w[2]);
    out[2] = p.cam.x * d.cam.y - p.cam.y * d.cam.x + dot(w[0], d_w[1]) - dot(w[1], d_w[0]);
    out[3] = d.cam.x;
    out[4] = d.cam.y;
    out[5] = d.cam.z;
    // A clamped u is at a fixed position in the image, and changes as (c_x + ...) / f_x.
    const Lanes free_u = p.cam.x * p.inv_z, free_v = p.cam.y * p.inv_z, zero = all_lanes(0.0);
    const Lanes along_u = dot(d.t[0], w[2]) * p.inv_z, along_v = dot(d.t[1], w[2]) * p.inv_z;
    const Lanes held_u = select(free_u == p.u, zero, along_u);
    const Lanes held_v = select(free_v == p.v, zero, along_v);
    out[6] = g.x * free_u + (dot(d.t[0], w[0]) * p.inv_z - p.u * along_u) + p.u * held_u;
    out[7] = g.y * free_v + (dot(d.t[1], w[1]) * p.inv_z - p.v * along_v) + p.v * held_v;
    out[8] = g.x + held_u;
    out[9] = g.y + held_v;
}

}  // namespace splat
