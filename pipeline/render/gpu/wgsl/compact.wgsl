// Lists the visible Gaussians, with their depths as keys, in the order of their indices.
#import common
#import record

struct Size {
    count: u32,
}

@group(0) @binding(0) var<uniform> size: Size;
@group(0) @binding(1) var<storage, read> records: array<Record>;
@group(0) @binding(2) var<storage, read> radii: array<f32>;
@group(0) @binding(3) var<storage, read> places: array<u32>;  // prefix sums of visible
@group(0) @binding(4) var<storage, read_write> depths: array<u32>;
@group(0) @binding(5) var<storage, read_write> gaussians: array<u32>;
@group(0) @binding(6) var<storage, read_write> length: u32;

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let i = number_of(thread);
    if (i >= size.count) { return; }
    let visible = radii[i] > 0.0;
    if (visible) {
        // Positive floats are ordered like their bit patterns.
        depths[places[i]] = bitcast<u32>(records[i].depth);
        gaussians[places[i]] = i;
    }
    if (i == size.count - 1u) { length = places[i] + u32(visible); }
}
