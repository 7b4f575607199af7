// Lists the (Gaussian, tile) pairs of the visible Gaussians, front to back. The pairs of a Gaussian
// are contiguous, and start at its slot.
#import common
#import block
#import record
#import tile

struct Size {
    tiles_x: u32,
    capacity: u32,  // of the arrays of pairs
}

@group(0) @binding(0) var<uniform> size: Size;
@group(0) @binding(1) var<storage, read> length: u32;  // number of visible Gaussians
@group(0) @binding(2) var<storage, read> gaussians: array<u32>;
@group(0) @binding(3) var<storage, read> first: array<u32>;  // pair of each rank, in its block
@group(0) @binding(4) var<storage, read> before: array<u32>;  // pairs before each block of ranks
@group(0) @binding(5) var<storage, read_write> tile_counts: array<u32>;
@group(0) @binding(6) var<storage, read> records: array<Record>;
@group(0) @binding(7) var<storage, read_write> keys: array<u32>;  // 1 + tile
@group(0) @binding(8) var<storage, read_write> gaussian_of: array<u32>;
@group(0) @binding(9) var<storage, read_write> slots: array<u32>;

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let rank = number_of(thread);
    if (rank >= length) { return; }
    let i = gaussians[rank];
    let r = records[i];
    let box = box_of(r);
    let slot = before[rank / kBlock] + first[rank];
    let end = min(slot + tile_counts[i], size.capacity);
    var next = slot;
    slots[i] = slot;
    for (var y = box.top; y <= box.bottom; y++) {
        for (var x = box.left; x <= box.right; x++) {
            if (next < end && overlaps(r, vec2(x, y))) {
                keys[next] = 1u + y * size.tiles_x + x;
                gaussian_of[next] = i;
                next++;
            }
        }
    }
    // Compilers may round differently in the kernel that has counted: pairs of no tile, which
    // sorting leaves out, and whose slots nothing writes.
    if (next < end) { tile_counts[i] = next - slot; }
    for (; next < end; next++) {
        keys[next] = 0u;
        gaussian_of[next] = i;
    }
}
