// Exclusive prefix sums of the rows of a table, a workgroup for each row. A row has an element for
// each block of elements of another array.
#import common

struct Size {
    stride: u32,  // between rows
}

@group(0) @binding(0) var<uniform> size: Size;
@group(0) @binding(1) var<storage, read> length: u32;  // of the other array
@group(0) @binding(2) var<storage, read_write> values: array<u32>;
@group(0) @binding(3) var<storage, read_write> totals: array<u32>;  // of the rows
#import scan_row

@compute @workgroup_size(kThreads)
fn main(thread: Thread, lane: Lane) {
    let row = group_of(thread);
    let total = scan_row(lane, row * size.stride, blocks_of(length));
    if (thread.local == 0u) { totals[row] = total; }
}
