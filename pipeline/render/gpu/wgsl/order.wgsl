// The number of tiles of each visible Gaussian, front to back; zeros after the last.
#import common

struct Size {
    count: u32,
}

@group(0) @binding(0) var<uniform> size: Size;
@group(0) @binding(1) var<storage, read> length: u32;
@group(0) @binding(2) var<storage, read> gaussians: array<u32>;
@group(0) @binding(3) var<storage, read> tile_counts: array<u32>;
@group(0) @binding(4) var<storage, read_write> ordered: array<u32>;

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let rank = number_of(thread);
    if (rank >= size.count) { return; }
    var count = 0u;
    if (rank < length) { count = tile_counts[gaussians[rank]]; }
    ordered[rank] = count;
}
