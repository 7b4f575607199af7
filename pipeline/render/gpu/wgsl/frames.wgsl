// The update of means and rotations in the arrays of a kernel, which declares the bindings.
#import frame_step

// Parameters and gradients: sections of N rows, means (3), log scales (3), quaternions (4).
fn update_frame(i: u32, n: u32) {
    let mean = 3u * i;
    let log_scale = 3u * (n + i);
    let quat = 6u * n + 4u * i;
    let d_mean = vec3(gradients[mean], gradients[mean + 1u], gradients[mean + 2u]);
    let d_quat = vec4(gradients[quat], gradients[quat + 1u], gradients[quat + 2u],
                      gradients[quat + 3u]);
    let q = vec4(geometry[quat], geometry[quat + 1u], geometry[quat + 2u], geometry[quat + 3u]);
    let log_scales = vec3(geometry[log_scale], geometry[log_scale + 1u], geometry[log_scale + 2u]);
    let means = Moments(vec3(mean_avg[mean], mean_avg[mean + 1u], mean_avg[mean + 2u]),
                        vec3(mean_avg_sq[mean], mean_avg_sq[mean + 1u], mean_avg_sq[mean + 2u]));
    let rotations = Moments(
        vec3(rotation_avg[mean], rotation_avg[mean + 1u], rotation_avg[mean + 2u]),
        vec3(rotation_avg_sq[mean], rotation_avg_sq[mean + 1u], rotation_avg_sq[mean + 2u]));
    let s = frame_step(log_scales, q, d_mean, d_quat, means, rotations);
    for (var k = 0u; k < 3u; k++) {
        geometry[mean + k] -= s.moved[k];
        mean_avg[mean + k] = s.means.first[k];
        mean_avg_sq[mean + k] = s.means.second[k];
        rotation_avg[mean + k] = s.rotations.first[k];
        rotation_avg_sq[mean + k] = s.rotations.second[k];
    }
    for (var k = 0u; k < 4u; k++) { geometry[quat + k] = s.quat[k]; }
}
