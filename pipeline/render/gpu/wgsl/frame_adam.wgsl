// Adam over means and rotations in the local frame of each Gaussian.
#import frames

@group(0) @binding(0) var<uniform> adam: Adam;
@group(0) @binding(1) var<storage, read> gradients: array<f32>;
@group(0) @binding(2) var<storage, read_write> geometry: array<f32>;
@group(0) @binding(3) var<storage, read_write> mean_avg: array<f32>;  // (N, 3), as the others
@group(0) @binding(4) var<storage, read_write> mean_avg_sq: array<f32>;
@group(0) @binding(5) var<storage, read_write> rotation_avg: array<f32>;
@group(0) @binding(6) var<storage, read_write> rotation_avg_sq: array<f32>;

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let i = number_of(thread);
    if (i < adam.count) { update_frame(i, adam.count); }
}
