// The image of a scene of which one part is rendered, among its surroundings (Surroundings and
// Backend.compose in Python), and its backward.
#import common

struct Layers {
    pixels: u32,
    flags: u32,
    fade: f32,
    growth: f32,
    factor: f32,  // 2 weight / pixels of the loss on the change of alpha
    unused: f32,
    unused2: vec2<f32>,
}
const kFront = 1u;
const kCorrection = 2u;
const kUnit = 1.0 / 255.0;

// Images of bytes, four values to a word.
@group(0) @binding(0) var<uniform> layers: Layers;
@group(0) @binding(1) var<storage, read> behind: array<u32>;
@group(0) @binding(2) var<storage, read> alpha_before: array<u32>;
@group(0) @binding(3) var<storage, read> front: array<u32>;
@group(0) @binding(4) var<storage, read> transmittance: array<u32>;
@group(0) @binding(5) var<storage, read> correction: array<u32>;  // int8
@group(0) @binding(6) var<storage, read> alpha: array<f32>;
// The part's colour, or the gradient of the image.
@group(0) @binding(7) var<storage, read> values: array<f32>;
@group(0) @binding(8) var<storage, read_write> result: array<f32>;
@group(0) @binding(9) var<storage, read_write> d_alpha: array<f32>;

fn byte(word: u32, at: u32) -> f32 {
    return f32((word >> (8u * (at & 3u))) & 255u);
}
fn signed_byte(word: u32, at: u32) -> f32 {
    return f32(bitcast<i32>(word << (24u - 8u * (at & 3u))) >> 24u);
}
fn passing(i: u32) -> f32 {
    if ((layers.flags & kFront) == 0u) { return 1.0; }
    return byte(transmittance[i / 4u], i) * kUnit;
}

@compute @workgroup_size(kThreads)
fn compose(thread: Thread) {
    let i = number_of(thread);
    if (i >= layers.pixels) { return; }
    for (var k = 3u * i; k < 3u * i + 3u; k++) {
        var value = values[k] + (1.0 - alpha[i]) * kUnit * byte(behind[k / 4u], k);
        if ((layers.flags & kFront) != 0u) {
            value = value * passing(i) + byte(front[k / 4u], k) * kUnit;
        }
        if ((layers.flags & kCorrection) != 0u) {
            value += signed_byte(correction[k / 4u], k) * kUnit;
        }
        result[k] = value;
    }
}

@compute @workgroup_size(kThreads)
fn backward(thread: Thread) {
    let i = number_of(thread);
    if (i >= layers.pixels) { return; }
    var hidden = 0.0;
    for (var k = 3u * i; k < 3u * i + 3u; k++) {
        let d = values[k] * passing(i);
        result[k] = d;
        hidden += d * byte(behind[k / 4u], k);
    }
    let change = alpha[i] - byte(alpha_before[i / 4u], i) * kUnit;
    let beyond = change - clamp(change, -layers.fade, layers.growth);
    d_alpha[i] = layers.factor * beyond - hidden * kUnit;
}
