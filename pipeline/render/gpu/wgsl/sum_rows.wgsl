// Sums of blocks of 1024 rows, in a fixed order; the caller adds the few sums of blocks.
#import common

struct Size {
    rows: u32,
    columns: u32,  // at most kThreads
    at: u32,       // first element of the sums
}

@group(0) @binding(0) var<uniform> size: Size;
@group(0) @binding(1) var<storage, read> values: array<f32>;
@group(0) @binding(2) var<storage, read_write> sums: array<f32>;

const kRows = 1024u;

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let block = group_of(thread);
    let begin = block * kRows;
    if (begin >= size.rows || thread.local >= size.columns) { return; }
    var sum = 0.0;
    for (var row = begin; row < min(begin + kRows, size.rows); row++) {
        sum += values[row * size.columns + thread.local];
    }
    sums[size.at + block * size.columns + thread.local] = sum;
}
