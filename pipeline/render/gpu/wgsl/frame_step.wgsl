// The step of a mean and a rotation in the local frame of their Gaussian; `frame_adam` in
// reference_adam.py documents the method. The kernel declares the uniform `adam`.
#import common
#import adam_rates

// Log scales are clamped to plus or minus this (1e-12 and 1e12).
const kLnUnitMax = 28.0;
// Gradients are clamped to this, so that their squares are finite.
const kGradientMax = 1e18;
// Squared norm of a quaternion above which the square of a component may overflow.
const kNorm2Max = 1e37;

// A new moment of one of three components, and Adam's step without the learning rate.
struct Moments {
    first: vec3<f32>,
    second: vec3<f32>,
}
fn next(before: Moments, gradient: vec3<f32>) -> Moments {
    let g = clamp(gradient, vec3(-kGradientMax), vec3(kGradientMax));
    return Moments(before.first * adam.beta1 + g * adam.rest1,
                   before.second * adam.beta2 + g * g * adam.rest2);
}
fn step(m: Moments) -> vec3<f32> {
    return m.first / (sqrt(m.second) * adam.to_root + adam.epsilon);
}

struct FrameStep {
    moved: vec3<f32>,  // to be subtracted from the mean
    quat: vec4<f32>,   // the new quaternion
    means: Moments,
    rotations: Moments,
}

fn frame_step(found: vec3<f32>, q: vec4<f32>, d_mean: vec3<f32>, d_quat: vec4<f32>,
              means: Moments, rotations: Moments) -> FrameStep {
    var log_scales = found;
    for (var k = 0u; k < 3u; k++) {
        if (!finite(log_scales[k])) { log_scales[k] = -kLnUnitMax; }
    }
    let scale = exp(clamp(log_scales, vec3(-kLnUnitMax), vec3(kLnUnitMax)));

    // A quaternion of almost zero norm counts as the identity and is not updated.
    let norm2 = dot(q, q);
    let valid = finite(norm2) && norm2 >= kQuatNorm2Min && norm2 < kNorm2Max;
    let norm = sqrt(select(1.0, norm2, valid));
    let unit = select(vec4(1.0, 0.0, 0.0, 0.0), q / norm, valid);
    let w = unit.x;
    let x = unit.y;
    let y = unit.z;
    let z = unit.w;
    let axes = mat3x3<f32>(  // columns of R: the local axes
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
        2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
        2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y),
    );
    let m = next(means, scale * (d_mean * axes));
    let along = adam.rate0 * scale * step(m);

    // q i, q j and q k: the tangents of rotations about the local axes.
    let tangents = mat3x4<f32>(vec4(-x, w, z, -y), vec4(-y, -z, w, x), vec4(-z, y, -x, w));
    let r = next(rotations, select(vec3(0.0), norm * (d_quat * tangents), valid));
    let turned = tangents * (adam.rate1 * norm * step(r));
    return FrameStep(axes * along, select(q, q - turned, valid), m, r);
}
