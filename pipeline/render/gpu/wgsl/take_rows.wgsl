// Copies of rows of words of any type.
#import common

struct Rows {
    count: u32,     // of rows of the result
    width: u32,     // words of a row of the result
    source_width: u32,
    source_at: u32, // first words of the section in `source`, `blank` and `result`
    blank_at: u32,
    at: u32,
    blanks: u32,    // 1: rows that are marked are copies of `blank`
}
const kBlank = 1u << 31u;  // marks rows in `rows`

@group(0) @binding(0) var<uniform> size: Rows;
@group(0) @binding(1) var<storage, read> rows: array<u32>;  // of `source`
@group(0) @binding(2) var<storage, read> source: array<u32>;
@group(0) @binding(3) var<storage, read> blank: array<u32>;  // one row
@group(0) @binding(4) var<storage, read_write> result: array<u32>;

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let i = number_of(thread);
    if (i >= size.count * size.width) { return; }
    let row = rows[i / size.width];
    let k = i % size.width;
    var word = 0u;
    if (size.blanks != 0u && (row & kBlank) != 0u) {
        word = blank[size.blank_at + k];
    } else if (k < size.source_width) {
        word = source[size.source_at + (row & ~kBlank) * size.source_width + k];
    }
    result[size.at + i] = word;
}
