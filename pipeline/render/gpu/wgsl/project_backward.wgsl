// The gradients of the parameters, for operators. With kShAdam the SH coefficients are updated in
// place (ShAdam in types.py) while their gradients are in registers. Training steps run
// update_gaussians.wgsl.
#import gradient
#import sh_adam

const kShAdam = 1u;
const kCamera = 2u;

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> adam: Adam;
@group(0) @binding(2) var<storage, read> geometry: array<f32>;
@group(0) @binding(3) var<storage, read_write> sh: array<f32>;
@group(0) @binding(4) var<storage, read> tile_counts: array<u32>;
@group(0) @binding(5) var<storage, read> slot_of: array<u32>;  // the first of each Gaussian
@group(0) @binding(6) var<storage, read> slots: array<f32>;
// Sections of N rows: those of geometry, then 2D means and colours.
@group(0) @binding(7) var<storage, read_write> gradients: array<f32>;
@group(0) @binding(8) var<storage, read_write> d_sh: array<f32>;
@group(0) @binding(9) var<storage, read_write> exp_avg: array<u32>;  // of sh
@group(0) @binding(10) var<storage, read_write> exp_avg_sq: array<f32>;
@group(0) @binding(11) var<storage, read_write> last_step: array<i32>;
@group(0) @binding(12) var<storage, read_write> d_camera: array<f32>;  // (N, kCameraParameters)

const kGeometry = 11u;  // numbers of a Gaussian in geometry

fn write_row(at: u32, v: vec3<f32>) {
    gradients[at] = v.x;
    gradients[at + 1u] = v.y;
    gradients[at + 2u] = v.z;
}

fn write(i: u32, g: Gradient) {
    let n = view.gaussians;
    write_row(3u * i, g.mean);
    write_row(3u * (n + i), g.log_scale);
    let quat = 6u * n + 4u * i;
    gradients[quat] = g.quat.x;
    gradients[quat + 1u] = g.quat.y;
    gradients[quat + 2u] = g.quat.z;
    gradients[quat + 3u] = g.quat.w;
    gradients[10u * n + i] = g.opacity_logit;
    let means2d = kGeometry * n + 2u * i;
    gradients[means2d] = g.means2d.x;
    gradients[means2d + 1u] = g.means2d.y;
    write_row((kGeometry + 2u) * n + 3u * i, g.rgb);
}

fn write_sh(i: u32, g: Gradient) {
    let basis = sh_basis(g.direction);
    let row = 3u * view.sh_coefficients * i;
    let used = sh_count(view.sh_degree);
    for (var k = 0u; k < kBands; k++) {
        if (k >= view.sh_coefficients) { continue; }
        let value = select(vec3(0.0), basis[k] * g.rgb, k < used);
        d_sh[row + 3u * k] = value.x;
        d_sh[row + 3u * k + 1u] = value.y;
        d_sh[row + 3u * k + 2u] = value.z;
    }
}

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let i = number_of(thread);
    if (i >= view.gaussians) { return; }
    let with_camera = (adam.flags & kCamera) != 0u;
    let g = gradient_of(i, inputs_of(i, view.gaussians), with_camera);
    write(i, g);
    if (with_camera) {
        for (var k = 0u; k < kCameraParameters; k++) {
            d_camera[kCameraParameters * i + k] = g.camera[k];
        }
    }
    if ((adam.flags & kShAdam) == 0u) {
        write_sh(i, g);
    } else if (g.found) {
        update_sh(i, g, vec2(adam.rate0, adam.rate1));
    }
}
