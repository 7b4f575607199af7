// Gradients of the parameters: sums each Gaussian's slots, in order, and differentiates the
// projection and the colour. With kShAdam the SH coefficients are updated in place (ShAdam in
// types.py) while their gradients are in registers.
#import common
#import adam_rates
#import projection
#import record
#import moments
#import sh

const kShAdam = 1u;
const kCamera = 2u;

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> adam: Adam;
@group(0) @binding(2) var<storage, read> geometry: array<f32>;
@group(0) @binding(3) var<storage, read_write> sh: array<f32>;
@group(0) @binding(4) var<storage, read> records: array<Record>;
@group(0) @binding(5) var<storage, read> tile_counts: array<u32>;
@group(0) @binding(6) var<storage, read> slot_of: array<u32>;  // the first of each Gaussian
@group(0) @binding(7) var<storage, read> slots: array<f32>;
// Sections of N rows: those of geometry, then 2D means and colours.
@group(0) @binding(8) var<storage, read_write> gradients: array<f32>;
@group(0) @binding(9) var<storage, read_write> d_sh: array<f32>;
@group(0) @binding(10) var<storage, read_write> exp_avg: array<f32>;  // of sh
@group(0) @binding(11) var<storage, read_write> exp_avg_sq: array<f32>;
@group(0) @binding(12) var<storage, read_write> last_step: array<i32>;
@group(0) @binding(13) var<storage, read_write> d_camera: array<f32>;  // (N, kCameraParameters)
@group(0) @binding(14) var<uniform> stopped: u32;  // see admit.wgsl
#import geometry

const kLn2 = 0.6931471805599453;
const kGeometry = 11u;  // numbers of a Gaussian in geometry
const kCameraParameters = 10u;
// Gradients above this count as overflow.
const kGradientMax = 1e37;

fn bounded(x: f32) -> bool { return finite(x) && abs(x) <= kGradientMax; }
fn bounded3(v: vec3<f32>) -> bool { return bounded(v.x) && bounded(v.y) && bounded(v.z); }

fn write_row(at: u32, v: vec3<f32>) {
    gradients[at] = v.x;
    gradients[at + 1u] = v.y;
    gradients[at + 2u] = v.z;
}

struct Gradient {
    mean: vec3<f32>,
    log_scale: vec3<f32>,
    quat: vec4<f32>,
    opacity_logit: f32,
    means2d: vec2<f32>,
    rgb: vec3<f32>,
}

fn write(i: u32, g: Gradient) {
    let n = view.gaussians;
    write_row(3u * i, g.mean);
    write_row(3u * (n + i), g.log_scale);
    let quat = 6u * n + 4u * i;
    gradients[quat] = g.quat.x;
    gradients[quat + 1u] = g.quat.y;
    gradients[quat + 2u] = g.quat.z;
    gradients[quat + 3u] = g.quat.w;
    gradients[10u * n + i] = g.opacity_logit;
    let means2d = kGeometry * n + 2u * i;
    gradients[means2d] = g.means2d.x;
    gradients[means2d + 1u] = g.means2d.y;
    write_row((kGeometry + 2u) * n + 3u * i, g.rgb);
}

// Without a gradient. SH gradients are zero, and moments stay as they are.
fn write_nothing(i: u32) {
    write(i, Gradient());
    if ((adam.flags & kShAdam) == 0u) {
        let row = 3u * view.sh_coefficients * i;
        for (var k = 0u; k < 3u * view.sh_coefficients; k++) { d_sh[row + k] = 0.0; }
    }
    if ((adam.flags & kCamera) != 0u) {
        for (var k = 0u; k < kCameraParameters; k++) { d_camera[kCameraParameters * i + k] = 0.0; }
    }
}

// The effect of the steps without a gradient before this one.
struct Missed {
    keep1: f32,  // factors of the moments
    keep2: f32,
    drift: f32,  // change of the parameter, in units of the last step's
}
fn missed_steps(last: i32) -> Missed {
    let missed = f32(max(i32(adam.step) - 1 - last, 0));
    if (missed == 0.0) { return Missed(1.0, 1.0, 0.0); }
    return Missed(pow(adam.beta1, missed), pow(adam.beta2, missed),
                  adam.ratio * (1.0 - pow(adam.ratio, missed)) / (1.0 - adam.ratio));
}

fn step_sh(at: u32, gradient: f32, rate: f32, missed: Missed) {
    var m = exp_avg[at];
    var v = exp_avg_sq[at];
    var p = sh[at];
    if (missed.drift != 0.0) {
        p -= rate * missed.drift * m / (sqrt(v) * adam.to_root + adam.epsilon);
    }
    m = m * missed.keep1 * adam.beta1 + gradient * adam.rest1;
    v = v * missed.keep2 * adam.beta2 + gradient * gradient * adam.rest2;
    sh[at] = p - rate * m / (sqrt(v) * adam.to_root + adam.epsilon);
    exp_avg[at] = m;
    exp_avg_sq[at] = v;
}

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let i = number_of(thread);
    if (i >= view.gaussians || stopped != 0u) { return; }
    var m: array<f32, kMoments>;
    var most = 0.0;
    for (var s = 0u; s < tile_counts[i]; s++) {
        let slot = (slot_of[i] + s) * kMoments;
        for (var k = 0u; k < kMoments; k++) { m[k] += slots[slot + k]; }
    }
    for (var k = 0u; k < kMoments; k++) { most = max(most, abs(m[k])); }
    if (most == 0.0) {
        write_nothing(i);
        return;
    }
    let r = records[i];
    let in = inputs_of(i, view.gaussians);
    let p = project(in, view);

    // From the moments of y = (u, w) to the image plane. ln alpha = ln opacity - ln 2 (u^2 + w^2)
    // and y = L^T d with L = [uu 0; uw ww], so d(ln alpha) / d(centre) = 2 ln 2 L y.
    var g: Gradient;
    g.means2d = 2.0 * kLn2 * vec2(r.uu * m[kVU], r.uw * m[kVU] + r.ww * m[kVW]);
    // inverse(cov) = 2 ln2 L L^T, d = L^-T y: 1/2 inverse(cov) (sum v d d^T) inverse(cov)
    //   = 2 ln2^2 L (sum v y y^T) L^T
    let c = 2.0 * kLn2 * kLn2;
    var d_xx = c * r.uu * r.uu * m[kVUU];
    var d_xy = 2.0 * c * r.uu * (r.uw * m[kVUU] + r.ww * m[kVUW]);
    var d_yy = c * (r.uw * r.uw * m[kVUU] + 2.0 * r.uw * r.ww * m[kVUW] + r.ww * r.ww * m[kVWW]);
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

    // A clamped colour receives only gradients that increase it, or none.
    let d = vec3(m[kRed], m[kGreen], m[kBlue]);
    let rising = select(min(d, vec3(0.0)), vec3(0.0), (view.flags & kClampColorGradient) != 0u);
    g.rgb = select(rising, d, r.rgb > vec3(0.0));

    let toward = in.mean - view.centre;
    let distance = length(toward);
    let direction = select(vec3(0.0), toward / distance, distance > 0.0);
    let basis = sh_basis(direction);
    let derivatives = sh_derivatives(direction);
    let row = 3u * view.sh_coefficients * i;
    let used = sh_count(view.sh_degree);
    var d_direction = vec3(0.0);
    for (var k = 0u; k < kBands; k++) {
        if (k >= used) { continue; }
        let at = row + 3u * k;
        d_direction += dot(vec3(sh[at], sh[at + 1u], sh[at + 2u]), g.rgb) * derivatives[k];
    }
    // d(v / |v|) = (I - d d^T) dv / |v|
    let d_toward = (d_direction - dot(d_direction, direction) * direction)
        * select(0.0, 1.0 / distance, distance > 0.0);
    g.mean += d_toward;

    let sound = bounded3(g.mean) && bounded3(g.log_scale) && bounded3(g.quat.xyz)
        && bounded(g.quat.w) && bounded(g.opacity_logit) && bounded3(g.rgb)
        && bounded3(vec3(g.means2d, 0.0));
    if (!sound) { g = Gradient(); }
    write(i, g);
    if ((adam.flags & kShAdam) != 0u) {
        let missed = missed_steps(last_step[i]);
        for (var k = 0u; k < kBands; k++) {
            if (k >= used) { continue; }
            let rate = select(adam.rate1, adam.rate0, k == 0u);
            for (var channel = 0u; channel < 3u; channel++) {
                step_sh(row + 3u * k + channel, basis[k] * g.rgb[channel], rate, missed);
            }
        }
        last_step[i] = i32(adam.step);
    } else {
        for (var k = 0u; k < kBands; k++) {
            if (k >= view.sh_coefficients) { continue; }
            let value = select(vec3(0.0), basis[k] * g.rgb, k < used);
            d_sh[row + 3u * k] = value.x;
            d_sh[row + 3u * k + 1u] = value.y;
            d_sh[row + 3u * k + 2u] = value.z;
        }
    }
    if ((adam.flags & kCamera) == 0u) { return; }

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
        d_camera[kCameraParameters * i + k] = select(0.0, values[k], sound && finite(values[k]));
    }
}
