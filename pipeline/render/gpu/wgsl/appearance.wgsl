// The colours of the Gaussians in a photograph with an appearance embedding w (K numbers): the
// constant SH coefficient is sh_0 + sum_k w_k a_k (training/appearance/embedding.py). `show` gives
// the Gaussians these colours, `hide` their own with what the optimiser has changed, and `gradient`
// differentiates.
#import common

struct Appearance {
    gaussians: u32,
    size: u32,             // K
    sh_coefficients: u32,  // of each Gaussian
    colors_at: u32,        // first element of the section of gradients of colours
}

@group(0) @binding(0) var<uniform> appearance: Appearance;
@group(0) @binding(1) var<storage, read> weights: array<f32>;  // w
@group(0) @binding(2) var<storage, read> values: array<f32>;   // a, (N, K, 3)
@group(0) @binding(3) var<storage, read_write> sh: array<f32>;
@group(0) @binding(4) var<storage, read_write> colours: array<f32>;  // (N, 6): own, shown
@group(0) @binding(5) var<storage, read> gradients: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_values: array<f32>;
@group(0) @binding(7) var<storage, read_write> d_weights: array<f32>;  // (N, K)

const kConstantBasis = 0.28209479177387814;

@compute @workgroup_size(kThreads)
fn show(thread: Thread) {
    let i = number_of(thread);
    if (i >= appearance.gaussians) { return; }
    for (var channel = 0u; channel < 3u; channel++) {
        var offset = 0.0;
        for (var k = 0u; k < appearance.size; k++) {
            offset += weights[k] * values[(i * appearance.size + k) * 3u + channel];
        }
        let at = 3u * appearance.sh_coefficients * i + channel;
        colours[6u * i + channel] = sh[at];
        sh[at] += offset;
        colours[6u * i + 3u + channel] = sh[at];
    }
}

@compute @workgroup_size(kThreads)
fn hide(thread: Thread) {
    let i = number_of(thread);
    if (i >= appearance.gaussians) { return; }
    for (var channel = 0u; channel < 3u; channel++) {
        let at = 3u * appearance.sh_coefficients * i + channel;
        sh[at] = colours[6u * i + channel] + (sh[at] - colours[6u * i + 3u + channel]);
    }
}

@compute @workgroup_size(kThreads)
fn gradient(thread: Thread) {
    let i = number_of(thread);
    if (i >= appearance.gaussians) { return; }
    let at = appearance.colors_at + 3u * i;
    let d = kConstantBasis * vec3(gradients[at], gradients[at + 1u], gradients[at + 2u]);
    for (var k = 0u; k < appearance.size; k++) {
        let row = (i * appearance.size + k) * 3u;
        d_weights[i * appearance.size + k] = dot(
            vec3(values[row], values[row + 1u], values[row + 2u]), d);
        for (var channel = 0u; channel < 3u; channel++) {
            d_values[row + channel] = weights[k] * d[channel];
        }
    }
}
