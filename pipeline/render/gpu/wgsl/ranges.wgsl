// The range of each tile among the pairs, which are sorted by tile.
#import common

@group(0) @binding(0) var<storage, read> length: u32;  // number of pairs
@group(0) @binding(1) var<storage, read> keys: array<u32>;  // 1 + tile
@group(0) @binding(2) var<storage, read_write> ranges: array<vec2<u32>>;

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let i = number_of(thread);
    if (i >= length) { return; }
    let key = keys[i];
    if (i == 0u || keys[i - 1u] != key) { ranges[key - 1u].x = i; }
    if (i + 1u == length || keys[i + 1u] != key) { ranges[key - 1u].y = i + 1u; }
}
