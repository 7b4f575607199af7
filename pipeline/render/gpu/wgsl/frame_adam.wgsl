// Adam over means and rotations in the local frame of each Gaussian.
#import frames

@group(0) @binding(0) var<uniform> adam: Adam;
// Sections of N rows: the parameters of means (3), log scales (3) and quaternions (4), and the
// gradients of means and quaternions.
@group(0) @binding(1) var<storage, read_write> geometry: array<f32>;
@group(0) @binding(2) var<storage, read> gradients: array<f32>;
@group(0) @binding(3) var<storage, read_write> moments: array<f32>;

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let i = number_of(thread);
    let n = adam.count;
    if (i >= n) { return; }
    let mean = 3u * i;
    let quat = 3u * n + 4u * i;
    let d_mean = vec3(gradients[mean], gradients[mean + 1u], gradients[mean + 2u]);
    let d_quat = vec4(gradients[quat], gradients[quat + 1u], gradients[quat + 2u],
                      gradients[quat + 3u]);
    update_frame(i, n, 0u, d_mean, d_quat);
}
