// Numbers the pairs, and decides whether a step is made: it is unless it has more pairs than their
// arrays hold, or a step before was not made. The kernels that change parameters, moments and
// statistics read `stopped`.
#import common

struct Size {
    capacity: u32,  // pairs of the arrays
    at: u32,        // first word of the step in `results`
}

@group(0) @binding(0) var<uniform> size: Size;
@group(0) @binding(1) var<storage, read> num_visible: u32;
// The pairs of each block of visible Gaussians, then the number of pairs before each block.
@group(0) @binding(2) var<storage, read_write> before: array<u32>;
@group(0) @binding(3) var<storage, read> dropped: u32;
@group(0) @binding(4) var<storage, read_write> stopped: u32;
@group(0) @binding(5) var<storage, read_write> length: u32;  // the number of pairs that are listed
@group(0) @binding(6) var<storage, read_write> results: array<u32>;
#import block
#import prefix

// Replaces the elements of `before` by their exclusive prefix sums; returns their sum.
fn scan(lane: Lane, count: u32) -> u32 {
    let own = kEach * ordinal(lane);
    var sum = 0u;
    for (var start = 0u; start < count; start += kBlock) {
        let first = start + own;
        var inside: array<u32, kEach>;
        var of_thread = 0u;
        for (var j = 0u; j < kEach; j++) {
            inside[j] = of_thread;
            if (first + j < count) { of_thread += before[first + j]; }
        }
        let found = prefix(lane, vec2(of_thread, 0u));
        for (var j = 0u; j < kEach; j++) {
            if (first + j < count) { before[first + j] = sum + found.before.x + inside[j]; }
        }
        sum += found.total.x;
    }
    return sum;
}

@compute @workgroup_size(kThreads)
fn main(thread: Thread, lane: Lane) {
    let pairs = scan(lane, blocks_of(num_visible));
    if (thread.local != 0u) { return; }
    if (pairs > size.capacity) { stopped = 1u; }
    length = select(pairs, 0u, stopped != 0u);
    results[size.at] = stopped;
    results[size.at + 1u] = pairs;
    results[size.at + 2u] = num_visible;
    results[size.at + 3u] = dropped;
}
