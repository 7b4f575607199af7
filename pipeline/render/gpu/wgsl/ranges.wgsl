// The range of each tile among the pairs, which are sorted by tile.
#import common

struct Size {
    pairs: u32,
    tiles: u32,
}

@group(0) @binding(0) var<uniform> size: Size;
@group(0) @binding(1) var<storage, read> tile_of: array<u32>;
@group(0) @binding(2) var<storage, read_write> ranges: array<vec2<u32>>;

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let i = number_of(thread);
    if (i >= size.pairs) { return; }
    let tile = tile_of[i];
    if (tile >= size.tiles) { return; }
    if (i == 0u || tile_of[i - 1u] != tile) { ranges[tile].x = i; }
    if (i + 1u == size.pairs || tile_of[i + 1u] != tile) { ranges[tile].y = i + 1u; }
}
