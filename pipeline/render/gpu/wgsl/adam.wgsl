// Adam (Kingma & Ba 2015) over the elements of an array (`elements`), or over rows that share the
// second moment of their mean square (`rows`).
#import common
#import adam_rates

@group(0) @binding(0) var<uniform> adam: Adam;
@group(0) @binding(1) var<storage, read> rates: array<f32>;  // repeated, with the bias correction
@group(0) @binding(2) var<storage, read> gradient: array<f32>;
@group(0) @binding(3) var<storage, read_write> parameter: array<f32>;
@group(0) @binding(4) var<storage, read_write> moments: array<f32>;  // second after first
@group(0) @binding(5) var<uniform> stopped: u32;  // see admit.wgsl

@compute @workgroup_size(kThreads)
fn elements(thread: Thread) {
    let i = number_of(thread);
    if (i >= adam.count || stopped != 0u) { return; }
    let g = gradient[adam.gradient_at + i];
    let first = adam.moments_at + i;
    let second = first + adam.count;
    let m = moments[first] * adam.beta1 + g * adam.rest1;
    let v = moments[second] * adam.beta2 + g * g * adam.rest2;
    moments[first] = m;
    moments[second] = v;
    parameter[adam.at + i] -= rates[i % adam.num_rates] * m / (sqrt(v) * adam.to_root + adam.epsilon);
}

@compute @workgroup_size(kThreads)
fn rows(thread: Thread) {
    let row = number_of(thread);
    if (row >= adam.count || stopped != 0u) { return; }
    var squares = 0.0;
    for (var k = 0u; k < adam.width; k++) {
        let g = gradient[adam.gradient_at + row * adam.width + k];
        squares += g * g;
    }
    let second = adam.moments_at + adam.count * adam.width + row;
    let v = moments[second] * adam.beta2 + squares * adam.rest2 / f32(adam.width);
    moments[second] = v;
    let far = rates[0] / (sqrt(v) * adam.to_root + adam.epsilon);
    for (var k = 0u; k < adam.width; k++) {
        let at = row * adam.width + k;
        let first = adam.moments_at + at;
        let m = moments[first] * adam.beta1 + gradient[adam.gradient_at + at] * adam.rest1;
        moments[first] = m;
        parameter[adam.at + at] -= far * m;
    }
}
