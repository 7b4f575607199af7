// Statistics for density control: the sum of the norms of the gradients of the projected centres, in
// normalised device coordinates, and the number of steps in which a Gaussian was visible.
#import common

struct Options {
    gaussians: u32,
    gradient_at: u32,  // first element of the section of gradients
    half_size: vec2<f32>,  // of the image, pixels
}

@group(0) @binding(0) var<uniform> options: Options;
@group(0) @binding(1) var<storage, read> gradients: array<f32>;
@group(0) @binding(2) var<storage, read> radii: array<f32>;
@group(0) @binding(3) var<storage, read_write> gradient_sum: array<f32>;
@group(0) @binding(4) var<storage, read_write> seen: array<f32>;
@group(0) @binding(5) var<uniform> stopped: u32;  // see admit.wgsl

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let i = number_of(thread);
    if (i >= options.gaussians || radii[i] <= 0.0 || stopped != 0u) { return; }
    let at = options.gradient_at + 2u * i;
    gradient_sum[i] += length(vec2(gradients[at], gradients[at + 1u]) * options.half_size);
    seen[i] += 1.0;
}
