// The gradient of one Gaussian: sums its slots, in order, and differentiates the projection and the
// colour. The kernel declares `view`, `geometry`, `sh`, `tile_counts`, `slot_of` and `slots`.
#import common
#import projection
#import moments
#import sh
#import geometry

const kLn2 = 0.6931471805599453;
const kCameraParameters = 10u;
// Gradients above this count as overflow.
const kGradientLimit = 1e37;

fn bounded(x: f32) -> bool { return finite(x) && abs(x) <= kGradientLimit; }
fn bounded3(v: vec3<f32>) -> bool { return bounded(v.x) && bounded(v.y) && bounded(v.z); }

struct Gradient {
    found: bool,  // whether any slot is not zero
    mean: vec3<f32>,
    log_scale: vec3<f32>,
    quat: vec4<f32>,
    opacity_logit: f32,
    means2d: vec2<f32>,
    rgb: vec3<f32>,
    direction: vec3<f32>,  // from the camera to the mean, a unit vector: dL/d(sh) = basis rgb
    camera: array<f32, kCameraParameters>,  // the Gaussian's part of the camera's gradient
}

// The colour before it is clamped, and its derivatives with respect to the direction: a column for
// each channel.
struct Shading {
    rgb: vec3<f32>,
    derivatives: mat3x3<f32>,
}
fn shading_of(i: u32, direction: vec3<f32>) -> Shading {
    let basis = sh_basis(direction);
    let derivatives = sh_derivatives(direction);
    let row = 3u * view.sh_coefficients * i;
    let used = sh_count(view.sh_degree);
    var found = Shading(vec3(0.5), mat3x3<f32>());
    for (var k = 0u; k < kBands; k++) {
        if (k >= used) { continue; }
        let value = vec3(sh[row + 3u * k], sh[row + 3u * k + 1u], sh[row + 3u * k + 2u]);
        found.rgb += basis[k] * value;
        found.derivatives += mat3x3<f32>(value.x * derivatives[k], value.y * derivatives[k],
                                         value.z * derivatives[k]);
    }
    return found;
}

// With `camera`, the camera's gradient, too.
fn gradient_of(i: u32, in: Inputs, camera: bool) -> Gradient {
    var g: Gradient;
    var m: array<f32, kMoments>;
    var most = 0.0;
    for (var s = 0u; s < tile_counts[i]; s++) {
        let slot = (slot_of[i] + s) * kMoments;
        for (var k = 0u; k < kMoments; k++) { m[k] += slots[slot + k]; }
    }
    for (var k = 0u; k < kMoments; k++) { most = max(most, abs(m[k])); }
    if (most == 0.0) { return g; }
    g.found = true;
    let p = project(in, view);
    let factor = factor_of(p);
    let uu = factor.x;
    let uw = factor.y;
    let ww = factor.z;

    // From the moments of y = (u, w) to the image plane. ln alpha = ln opacity - ln 2 (u^2 + w^2)
    // and y = L^T d with L = [uu 0; uw ww], so d(ln alpha) / d(centre) = 2 ln 2 L y.
    g.means2d = 2.0 * kLn2 * vec2(uu * m[kVU], uw * m[kVU] + ww * m[kVW]);
    // inverse(cov) = 2 ln2 L L^T, d = L^-T y: 1/2 inverse(cov) (sum v d d^T) inverse(cov)
    //   = 2 ln2^2 L (sum v y y^T) L^T
    let c = 2.0 * kLn2 * kLn2;
    var d_xx = c * uu * uu * m[kVUU];
    var d_xy = 2.0 * c * uu * (uw * m[kVUU] + ww * m[kVUW]);
    var d_yy = c * (uw * uw * m[kVUU] + 2.0 * uw * ww * m[kVUW] + ww * ww * m[kVWW]);
    g.opacity_logit = m[kV] * (1.0 - p.sigmoid);
    if ((view.flags & kAntialias) != 0u) {
        // ln opacity = ln sigmoid + (ln plain_det - ln det) / 2 above the lower bound
        let half = select(0.0, 0.5 * m[kV], p.ratio > kCompensationMin);
        let plain = half / select(1.0, p.plain_det, p.plain_det > 0.0);
        let dilated = half / p.det;
        d_xx += plain * (p.yy - kDilation) - dilated * p.yy;
        d_yy += plain * (p.xx - kDilation) - dilated * p.xx;
        d_xy -= 2.0 * p.xy * (plain - dilated);
    }
    // Sigma' = H H^T; the rows of H are (R^T t) scale
    let d_h0 = 2.0 * d_xx * p.h0 + d_xy * p.h1;
    let d_h1 = 2.0 * d_yy * p.h1 + d_xy * p.h0;
    g.log_scale = p.h0 * d_h0 + p.h1 * d_h1;
    let s0 = p.scale * d_h0;
    let s1 = p.scale * d_h1;
    let d_t0 = s0 * p.r;
    let d_t1 = s1 * p.r;
    // The columns of p.r are the rows of R: dL/dR = t0 s0^T + t1 s1^T
    let d_r0 = p.t0.x * s0 + p.t1.x * s1;
    let d_r1 = p.t0.y * s0 + p.t1.y * s1;
    let d_r2 = p.t0.z * s0 + p.t1.z * s1;
    let w = p.q.x;
    let x = p.q.y;
    let y = p.q.z;
    let z = p.q.w;
    let d_q = 2.0 * vec4(
        x * (d_r2.y - d_r1.z) + y * (d_r0.z - d_r2.x) + z * (d_r1.x - d_r0.y),
        w * (d_r2.y - d_r1.z) + y * (d_r0.y + d_r1.x) + z * (d_r0.z + d_r2.x)
            - 2.0 * x * (d_r1.y + d_r2.z),
        w * (d_r0.z - d_r2.x) + x * (d_r0.y + d_r1.x) + z * (d_r1.z + d_r2.y)
            - 2.0 * y * (d_r0.x + d_r2.z),
        w * (d_r1.x - d_r0.y) + x * (d_r0.z + d_r2.x) + y * (d_r1.z + d_r2.y)
            - 2.0 * z * (d_r0.x + d_r1.y),
    );
    g.quat = (d_q - dot(p.q, d_q) * p.q) * p.inverse_norm;

    // T's rows: f / z (W_i - u W_2), with u clamped; the centre: f x / z + c
    let inverse_z = 1.0 / p.cam.z;
    let along = vec2(dot(d_t0, view.forward), dot(d_t1, view.forward));
    let d_slope = select(vec2(0.0), -view.focal * inverse_z * along, p.free == p.slope)
        + view.focal * g.means2d;
    let d_cam = vec3(
        d_slope * inverse_z,
        m[kDepth] - (dot(d_t0, p.t0) + dot(d_t1, p.t1) + dot(d_slope, p.free)) * inverse_z,
    );
    g.mean = d_cam.x * view.right + d_cam.y * view.down + d_cam.z * view.forward;

    let toward = in.mean - view.centre;
    let distance = length(toward);
    g.direction = select(vec3(0.0), toward / distance, distance > 0.0);
    let shading = shading_of(i, g.direction);
    // A clamped colour receives only gradients that increase it, or none.
    let d = vec3(m[kRed], m[kGreen], m[kBlue]);
    let rising = select(min(d, vec3(0.0)), vec3(0.0), (view.flags & kClampColorGradient) != 0u);
    g.rgb = select(rising, d, shading.rgb > vec3(0.0));
    let d_direction = shading.derivatives * g.rgb;
    // d(v / |v|) = (I - d d^T) dv / |v|
    let d_toward = (d_direction - dot(d_direction, g.direction) * g.direction)
        * select(0.0, 1.0 / distance, distance > 0.0);
    g.mean += d_toward;

    let sound = bounded3(g.mean) && bounded3(g.log_scale) && bounded3(g.quat.xyz)
        && bounded(g.quat.w) && bounded(g.opacity_logit) && bounded3(g.rgb)
        && bounded3(vec3(g.means2d, 0.0));
    if (!sound) {
        g = Gradient();
        g.found = true;
        return g;
    }
    if (!camera) { return g; }

    // `perturbed` in reference.py defines the parameters. T = (f / z) (W_i - u W_2); a rotation
    // changes the columns of W like the centre; a translation changes the viewing direction as well.
    let scaled = view.focal * inverse_z;
    let d_w0 = scaled.x * d_t0;
    let d_w1 = scaled.y * d_t1;
    let d_w2 = -scaled.x * p.slope.x * d_t0 - scaled.y * p.slope.y * d_t1;
    let rotation = cross(p.cam, d_cam) + vec3(
        dot(view.down, d_w2) - dot(view.forward, d_w1),
        dot(view.forward, d_w0) - dot(view.right, d_w2),
        dot(view.right, d_w1) - dot(view.down, d_w0),
    );
    let translation = d_cam
        + vec3(dot(view.right, d_toward), dot(view.down, d_toward), dot(view.forward, d_toward));
    // A clamped u is at a fixed position in the image, and changes as (c_x + ...) / f_x.
    let held = select(along * inverse_z, vec2(0.0), p.free == p.slope);
    let across = vec2(dot(d_t0, view.right), dot(d_t1, view.down)) * inverse_z;
    let focal = g.means2d * p.free + across - p.slope * along * inverse_z + p.slope * held;
    let principal = g.means2d + held;
    var values = array<f32, kCameraParameters>(
        rotation.x, rotation.y, rotation.z, translation.x, translation.y, translation.z,
        focal.x, focal.y, principal.x, principal.y,
    );
    for (var k = 0u; k < kCameraParameters; k++) {
        g.camera[k] = select(0.0, values[k], finite(values[k]));
    }
    return g;
}
