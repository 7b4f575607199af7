// Adam over means and rotations in the local frame of each Gaussian; `frame_adam` in
// reference_adam.py documents the method.
#import common
#import adam_rates

// Parameters and gradients: sections of N rows, means (3), log scales (3), quaternions (4).
@group(0) @binding(0) var<uniform> adam: Adam;
@group(0) @binding(1) var<storage, read> gradients: array<f32>;
@group(0) @binding(2) var<storage, read_write> geometry: array<f32>;
@group(0) @binding(3) var<storage, read_write> mean_avg: array<f32>;  // (N, 3), as the others
@group(0) @binding(4) var<storage, read_write> mean_avg_sq: array<f32>;
@group(0) @binding(5) var<storage, read_write> rotation_avg: array<f32>;
@group(0) @binding(6) var<storage, read_write> rotation_avg_sq: array<f32>;
@group(0) @binding(7) var<uniform> stopped: u32;  // see admit.wgsl

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

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let i = number_of(thread);
    let n = adam.count;
    if (i >= n || stopped != 0u) { return; }
    let mean = 3u * i;
    let log_scale = 3u * (n + i);
    let quat = 6u * n + 4u * i;
    let d_mean = vec3(gradients[mean], gradients[mean + 1u], gradients[mean + 2u]);
    let d_quat = vec4(gradients[quat], gradients[quat + 1u], gradients[quat + 2u],
                      gradients[quat + 3u]);
    let q = vec4(geometry[quat], geometry[quat + 1u], geometry[quat + 2u], geometry[quat + 3u]);
    var log_scales = vec3(geometry[log_scale], geometry[log_scale + 1u], geometry[log_scale + 2u]);
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
    var m = Moments(vec3(mean_avg[mean], mean_avg[mean + 1u], mean_avg[mean + 2u]),
                    vec3(mean_avg_sq[mean], mean_avg_sq[mean + 1u], mean_avg_sq[mean + 2u]));
    m = next(m, scale * (d_mean * axes));
    for (var k = 0u; k < 3u; k++) {
        mean_avg[mean + k] = m.first[k];
        mean_avg_sq[mean + k] = m.second[k];
    }
    let along = adam.rate0 * scale * step(m);
    let moved = axes * along;
    geometry[mean] -= moved.x;
    geometry[mean + 1u] -= moved.y;
    geometry[mean + 2u] -= moved.z;

    // q i, q j and q k: the tangents of rotations about the local axes.
    let tangents = mat3x4<f32>(vec4(-x, w, z, -y), vec4(-y, -z, w, x), vec4(-z, y, -x, w));
    m = Moments(vec3(rotation_avg[mean], rotation_avg[mean + 1u], rotation_avg[mean + 2u]),
                vec3(rotation_avg_sq[mean], rotation_avg_sq[mean + 1u], rotation_avg_sq[mean + 2u]));
    m = next(m, select(vec3(0.0), norm * (d_quat * tangents), valid));
    for (var k = 0u; k < 3u; k++) {
        rotation_avg[mean + k] = m.first[k];
        rotation_avg_sq[mean + k] = m.second[k];
    }
    if (!valid) { return; }
    let turned = tangents * (adam.rate1 * norm * step(m));
    geometry[quat] = q.x - turned.x;
    geometry[quat + 1u] = q.y - turned.y;
    geometry[quat + 2u] = q.z - turned.z;
    geometry[quat + 3u] = q.w - turned.w;
}
