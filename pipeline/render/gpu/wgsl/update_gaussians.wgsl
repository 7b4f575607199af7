// A training step of each Gaussian: its gradient, Adam for its parameters, and the statistics for
// density control, which are the sum of the norms of the gradients of the projected centres, in
// normalised device coordinates, and the number of steps in which a Gaussian was visible. Gradients
// stay in registers, but for those that other kernels read.
#import gradient
#import sh_adam
#import frames

struct Options {
    flags: u32,
    colors_at: u32,        // first elements of sections of `gradients`
    means_at: u32,
    quats_at: u32,
    half_size: vec2<f32>,  // of the image, pixels
    sh_rates: vec2<f32>,   // learning rates with the bias correction
    scale_rate: f32,
    opacity_rate: f32,
}
const kFrames = 1u;  // updates means and rotations, instead of writing their gradients
const kCamera = 2u;  // writes the camera's gradients, the first section
const kColors = 4u;  // writes the gradients of colours

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> adam: Adam;  // rates of the local frames
@group(0) @binding(2) var<uniform> options: Options;
@group(0) @binding(3) var<uniform> stopped: u32;  // see admit.wgsl
@group(0) @binding(4) var<storage, read_write> geometry: array<f32>;
@group(0) @binding(5) var<storage, read_write> sh: array<f32>;
@group(0) @binding(6) var<storage, read> radii: array<f32>;
@group(0) @binding(7) var<storage, read> tile_counts: array<u32>;
@group(0) @binding(8) var<storage, read> slot_of: array<u32>;  // the first of each Gaussian
@group(0) @binding(9) var<storage, read> slots: array<f32>;
@group(0) @binding(10) var<storage, read_write> exp_avg: array<u32>;  // of sh
@group(0) @binding(11) var<storage, read_write> exp_avg_sq: array<f32>;
@group(0) @binding(12) var<storage, read_write> last_step: array<i32>;
// The first and the second moments of log scales, then those of opacities, of means and of rotations.
@group(0) @binding(13) var<storage, read_write> moments: array<f32>;
@group(0) @binding(14) var<storage, read_write> statistics: array<f32>;  // (2, N)
@group(0) @binding(15) var<storage, read_write> gradients: array<f32>;

// Adam for one element of geometry, with the places of its moments.
fn update(at: u32, first: u32, second: u32, g: f32, rate: f32) {
    let m = moments[first] * adam.beta1 + g * adam.rest1;
    let v = moments[second] * adam.beta2 + g * g * adam.rest2;
    moments[first] = m;
    moments[second] = v;
    geometry[at] -= rate * m / (sqrt(v) * adam.to_root + adam.epsilon);
}

fn write_row(at: u32, v: vec3<f32>) {
    gradients[at] = v.x;
    gradients[at + 1u] = v.y;
    gradients[at + 2u] = v.z;
}

fn write_gradients(i: u32, g: Gradient) {
    if ((options.flags & kCamera) != 0u) {
        for (var k = 0u; k < kCameraParameters; k++) {
            gradients[kCameraParameters * i + k] = g.camera[k];
        }
    }
    if ((options.flags & kColors) != 0u) { write_row(options.colors_at + 3u * i, g.rgb); }
    if ((options.flags & kFrames) == 0u) {
        write_row(options.means_at + 3u * i, g.mean);
        let quat = options.quats_at + 4u * i;
        for (var k = 0u; k < 4u; k++) { gradients[quat + k] = g.quat[k]; }
    }
}

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let i = number_of(thread);
    let n = view.gaussians;
    if (i >= n || stopped != 0u) { return; }
    let g = gradient_of(i, inputs_of(i, n), (options.flags & kCamera) != 0u);
    if (g.found) { update_sh(i, g, options.sh_rates); }
    write_gradients(i, g);
    if (radii[i] > 0.0) {
        statistics[i] += length(g.means2d * options.half_size);
        statistics[n + i] += 1.0;
    }
    // Before the scales: the local frame is that of this step.
    if ((options.flags & kFrames) != 0u) { update_frame(i, n, 8u * n, g.mean, g.quat); }
    for (var k = 0u; k < 3u; k++) {
        let j = 3u * i + k;
        update(3u * n + j, j, 3u * n + j, g.log_scale[k], options.scale_rate);
    }
    update(10u * n + i, 6u * n + i, 7u * n + i, g.opacity_logit, options.opacity_rate);
}
