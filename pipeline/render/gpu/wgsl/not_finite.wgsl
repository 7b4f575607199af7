// Marks rows with a value that is not finite.
#import common

struct Rows {
    count: u32,
    width: u32,  // values of a row
}

@group(0) @binding(0) var<uniform> size: Rows;
@group(0) @binding(1) var<storage, read> values: array<f32>;
@group(0) @binding(2) var<storage, read_write> found: array<u32>;

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let i = number_of(thread);
    if (i >= size.count) { return; }
    for (var k = 0u; k < size.width; k++) {
        if (!finite(values[i * size.width + k])) { found[i] = 1u; }
    }
}
