// Prefix sums of the numbers of tiles of the visible Gaussians, front to back, in each block of
// Gaussians, and the sums of the blocks. Empties the ranges of the tiles for ranges.wgsl.
#import common

struct Size {
    tiles: u32,
}

@group(0) @binding(0) var<uniform> size: Size;
@group(0) @binding(1) var<storage, read> length: u32;
@group(0) @binding(2) var<storage, read> gaussians: array<u32>;
@group(0) @binding(3) var<storage, read> tile_counts: array<u32>;
@group(0) @binding(4) var<storage, read_write> first: array<u32>;
@group(0) @binding(5) var<storage, read_write> sums: array<u32>;
@group(0) @binding(6) var<storage, read_write> ranges: array<vec2<u32>>;
#import block
#import prefix

@compute @workgroup_size(kThreads)
fn main(thread: Thread, lane: Lane) {
    let start = group_of(thread) * kBlock;
    for (var tile = start + thread.local; tile < min(size.tiles, start + kBlock); tile += kThreads) {
        ranges[tile] = vec2(0u);
    }
    if (start >= length) { return; }
    let own = start + kEach * ordinal(lane);
    var before: array<u32, kEach>;
    var sum = 0u;
    for (var j = 0u; j < kEach; j++) {
        before[j] = sum;
        if (own + j < length) { sum += tile_counts[gaussians[own + j]]; }
    }
    let found = prefix(lane, vec2(sum, 0u));
    for (var j = 0u; j < kEach; j++) {
        if (own + j < length) { first[own + j] = found.before.x + before[j]; }
    }
    if (thread.local == 0u) { sums[group_of(thread)] = found.total.x; }
}
