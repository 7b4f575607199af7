// The update of means and rotations in the arrays of a kernel, which declares `geometry` and
// `moments`.
#import frame_step

fn row_of(at: u32) -> vec3<f32> {
    return vec3(moments[at], moments[at + 1u], moments[at + 2u]);
}
fn write_moments(at: u32, v: vec3<f32>) {
    moments[at] = v.x;
    moments[at + 1u] = v.y;
    moments[at + 2u] = v.z;
}

// Parameters: sections of N rows, means (3), log scales (3), quaternions (4). Moments: from element
// `at` on, first and second of means and of rotations, (N, 3) each.
fn update_frame(i: u32, n: u32, at: u32, d_mean: vec3<f32>, d_quat: vec4<f32>) {
    let mean = 3u * i;
    let log_scale = 3u * (n + i);
    let quat = 6u * n + 4u * i;
    let q = vec4(geometry[quat], geometry[quat + 1u], geometry[quat + 2u], geometry[quat + 3u]);
    let log_scales = vec3(geometry[log_scale], geometry[log_scale + 1u], geometry[log_scale + 2u]);
    let row = at + mean;
    let means = Moments(row_of(row), row_of(row + 3u * n));
    let rotations = Moments(row_of(row + 6u * n), row_of(row + 9u * n));
    let s = frame_step(log_scales, q, d_mean, d_quat, means, rotations);
    for (var k = 0u; k < 3u; k++) { geometry[mean + k] -= s.moved[k]; }
    for (var k = 0u; k < 4u; k++) { geometry[quat + k] = s.quat[k]; }
    write_moments(row, s.means.first);
    write_moments(row + 3u * n, s.means.second);
    write_moments(row + 6u * n, s.rotations.first);
    write_moments(row + 9u * n, s.rotations.second);
}
