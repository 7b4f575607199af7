// The projection of a Gaussian. Sources: Kerbl et al. 2023 (covariance), Zwicker et al. 2002 (EWA),
// Yu et al. 2024 (compensation). `project` in reference.py is a readable equivalent.
#import view

// Variances in px^2 above this count as overflow: the determinant overflows float32.
const kVarianceMax = 1e18;
const kHalfLog2E = 0.7213475204444817;

// One Gaussian's parameters.
struct Inputs {
    mean: vec3<f32>,
    log_scale: vec3<f32>,
    quat: vec4<f32>,  // w x y z, not normalised
    opacity_logit: f32,
}

struct Projected {
    // Intermediate values for backward
    q: vec4<f32>,  // normalised
    inverse_norm: f32,
    r: mat3x3<f32>,  // R^T: its columns are the rows of R
    scale: vec3<f32>,
    cam: vec3<f32>,  // centre in the camera's frame
    free: vec2<f32>,  // x / z and y / z
    slope: vec2<f32>,  // the same, clamped
    t0: vec3<f32>,  // rows of T = J W
    t1: vec3<f32>,
    h0: vec3<f32>,  // rows of H = T R S; Sigma' = H H^T
    h1: vec3<f32>,
    plain_det: f32,  // undilated
    ratio: f32,  // of it to the dilated one (antialias)
    sigmoid: f32,
    // Results
    centre: vec2<f32>,  // pixels
    xx: f32,  // dilated covariance, px^2
    xy: f32,
    yy: f32,
    det: f32,
    opacity: f32,
}

fn valid(in: Inputs) -> bool {
    return finite3(in.mean) && finite3(in.log_scale) && finite3(in.quat.xyz)
        && finite(in.quat.w) && finite(in.opacity_logit) && quat_norm(in.quat) >= sqrt(kQuatNorm2Min);
}

// Without overflow of the squares.
fn quat_norm(quat: vec4<f32>) -> f32 {
    let size = abs(quat);
    let most = max(max(size.x, size.y), max(size.z, size.w));
    return select(most * length(quat / most), 0.0, most == 0.0);
}

fn in_camera(mean: vec3<f32>, view: View) -> vec3<f32> {
    let d = mean - view.centre;
    return vec3(dot(view.right, d), dot(view.down, d), dot(view.forward, d));
}

// Whether the ellipsoid of kMinDepthSigmas standard deviations is in front of the camera.
fn is_ellipse(p: Projected, view: View) -> bool {
    return p.cam.z > kMinDepthSigmas * length((p.r * view.forward) * p.scale);
}

fn project(in: Inputs, view: View) -> Projected {
    var p: Projected;
    p.inverse_norm = 1.0 / quat_norm(in.quat);
    p.q = in.quat * p.inverse_norm;
    let w = p.q.x;
    let x = p.q.y;
    let y = p.q.z;
    let z = p.q.w;
    p.r = mat3x3<f32>(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    );
    p.scale = exp(in.log_scale);

    p.cam = in_camera(in.mean, view);
    p.free = p.cam.xy / p.cam.z;
    p.centre = view.focal * p.free + view.principal;
    p.slope = clamp(p.free, view.lowest, view.highest);
    p.t0 = (view.focal.x / p.cam.z) * (view.right - p.slope.x * view.forward);
    p.t1 = (view.focal.y / p.cam.z) * (view.down - p.slope.y * view.forward);
    p.h0 = (p.r * p.t0) * p.scale;
    p.h1 = (p.r * p.t1) * p.scale;
    let xx = dot(p.h0, p.h0);
    let yy = dot(p.h1, p.h1);
    p.xy = dot(p.h0, p.h1);
    p.xx = xx + kDilation;
    p.yy = yy + kDilation;
    // Lagrange's identity |a|^2 |b|^2 - (a.b)^2 = |a x b|^2 avoids cancellation for thin Gaussians.
    let normal = cross(p.h0, p.h1);
    p.plain_det = dot(normal, normal);
    p.det = p.plain_det + kDilation * (xx + yy + kDilation);

    p.sigmoid = 1.0 / (1.0 + exp(-in.opacity_logit));
    p.opacity = p.sigmoid;
    p.ratio = 1.0;
    if ((view.flags & kAntialias) != 0u) {
        p.ratio = p.plain_det / p.det;
        p.opacity *= sqrt(max(p.ratio, kCompensationMin));
    }
    return p;
}

// The Cholesky factor (uu, uw, ww) of log2(e)/2 times the inverse covariance, see record.wgsl.
fn factor_of(p: Projected) -> vec3<f32> {
    let uu = sqrt(kHalfLog2E * p.yy / p.det);
    return vec3(uu, -uu * p.xy / p.yy, sqrt(kHalfLog2E / p.yy));
}
