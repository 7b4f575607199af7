// The range of each tile among the pairs, which are sorted by tile.
#import common

struct Size {
    tiles: u32,
}

@group(0) @binding(0) var<uniform> size: Size;
@group(0) @binding(1) var<storage, read> length: u32;  // number of pairs
@group(0) @binding(2) var<storage, read> tile_of: array<u32>;
@group(0) @binding(3) var<storage, read_write> ranges: array<vec2<u32>>;

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let i = number_of(thread);
    if (i >= length) { return; }
    let tile = tile_of[i];
    if (tile >= size.tiles) { return; }
    if (i == 0u || tile_of[i - 1u] != tile) { ranges[tile].x = i; }
    if (i + 1u == length || tile_of[i + 1u] != tile) { ranges[tile].y = i + 1u; }
}
