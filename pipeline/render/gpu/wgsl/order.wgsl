// The number of tiles of each visible Gaussian, front to back; zeros after the last. Empties the
// ranges of the tiles for ranges.wgsl.
#import common

struct Size {
    count: u32,
    tiles: u32,
}

@group(0) @binding(0) var<uniform> size: Size;
@group(0) @binding(1) var<storage, read> length: u32;
@group(0) @binding(2) var<storage, read> gaussians: array<u32>;
@group(0) @binding(3) var<storage, read> tile_counts: array<u32>;
@group(0) @binding(4) var<storage, read_write> ordered: array<u32>;
@group(0) @binding(5) var<storage, read_write> ranges: array<vec2<u32>>;

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let rank = number_of(thread);
    if (rank < size.tiles) { ranges[rank] = vec2(0u); }
    if (rank >= size.count) { return; }
    var count = 0u;
    if (rank < length) { count = tile_counts[gaussians[rank]]; }
    ordered[rank] = count;
}
