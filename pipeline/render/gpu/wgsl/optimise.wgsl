// One pass over the parameters of the Gaussians but SH: Adam, and the statistics for density control,
// which are the sum of the norms of the gradients of the projected centres, in normalised device
// coordinates, and the number of steps in which a Gaussian was visible.
#import frames

struct Options {
    flags: u32,
    means2d_at: u32,       // first element of the gradients of projected centres
    half_size: vec2<f32>,  // of the image, pixels
    scale_rate: f32,       // learning rates with the bias correction
    opacity_rate: f32,
}
const kFrames = 1u;  // updates means and rotations, too

@group(0) @binding(0) var<uniform> adam: Adam;
@group(0) @binding(1) var<storage, read> gradients: array<f32>;
@group(0) @binding(2) var<storage, read_write> geometry: array<f32>;
@group(0) @binding(3) var<storage, read_write> mean_avg: array<f32>;  // (N, 3), as the others
@group(0) @binding(4) var<storage, read_write> mean_avg_sq: array<f32>;
@group(0) @binding(5) var<storage, read_write> rotation_avg: array<f32>;
@group(0) @binding(6) var<storage, read_write> rotation_avg_sq: array<f32>;
@group(0) @binding(7) var<storage, read_write> scale_avg: array<f32>;
@group(0) @binding(8) var<storage, read_write> scale_avg_sq: array<f32>;
@group(0) @binding(9) var<storage, read_write> opacity_avg: array<f32>;
@group(0) @binding(10) var<storage, read_write> opacity_avg_sq: array<f32>;
@group(0) @binding(11) var<storage, read> radii: array<f32>;
@group(0) @binding(12) var<storage, read_write> statistics: array<f32>;  // (2, N)
@group(0) @binding(13) var<uniform> options: Options;
@group(0) @binding(14) var<uniform> stopped: u32;  // see admit.wgsl

// A parameter, and its moments.
struct Element {
    value: f32,
    first: f32,
    second: f32,
}
fn updated(e: Element, g: f32, rate: f32) -> Element {
    let m = e.first * adam.beta1 + g * adam.rest1;
    let v = e.second * adam.beta2 + g * g * adam.rest2;
    return Element(e.value - rate * m / (sqrt(v) * adam.to_root + adam.epsilon), m, v);
}

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let i = number_of(thread);
    let n = adam.count;
    if (i >= n || stopped != 0u) { return; }
    if (radii[i] > 0.0) {
        let at = options.means2d_at + 2u * i;
        statistics[i] += length(vec2(gradients[at], gradients[at + 1u]) * options.half_size);
        statistics[n + i] += 1.0;
    }
    // Before the scales: the local frame is that of this step.
    if ((options.flags & kFrames) != 0u) { update_frame(i, n); }
    for (var k = 0u; k < 3u; k++) {
        let j = 3u * i + k;
        let at = 3u * n + j;
        let e = updated(Element(geometry[at], scale_avg[j], scale_avg_sq[j]), gradients[at],
                        options.scale_rate);
        geometry[at] = e.value;
        scale_avg[j] = e.first;
        scale_avg_sq[j] = e.second;
    }
    let at = 10u * n + i;
    let e = updated(Element(geometry[at], opacity_avg[i], opacity_avg_sq[i]), gradients[at],
                    options.opacity_rate);
    geometry[at] = e.value;
    opacity_avg[i] = e.first;
    opacity_avg_sq[i] = e.second;
}
