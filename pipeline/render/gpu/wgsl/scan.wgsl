// Exclusive prefix sums, 1024 numbers per workgroup (`blocks`), and the addition of the sums of the
// workgroups before (`add`). Longer arrays are scanned by levels (sort.py).
#import common

struct Size {
    count: u32,
}

@group(0) @binding(0) var<uniform> size: Size;
@group(0) @binding(1) var<storage, read_write> values: array<u32>;
@group(0) @binding(2) var<storage, read_write> sums: array<u32>;  // of each workgroup

const kEach = 4u;  // numbers per thread
var<workgroup> running: array<u32, kThreads>;

@compute @workgroup_size(kThreads)
fn blocks(thread: Thread) {
    let block = group_of(thread);
    let first = (block * kThreads + thread.local) * kEach;
    var before: array<u32, kEach>;
    var sum = 0u;
    for (var j = 0u; j < kEach; j++) {
        before[j] = sum;
        if (first + j < size.count) { sum += values[first + j]; }
    }
    running[thread.local] = sum;
    for (var step = 1u; step < kThreads; step *= 2u) {
        workgroupBarrier();
        var left = 0u;
        if (thread.local >= step) { left = running[thread.local - step]; }
        workgroupBarrier();
        running[thread.local] += left;
    }
    let base = running[thread.local] - sum;
    for (var j = 0u; j < kEach; j++) {
        if (first + j < size.count) { values[first + j] = base + before[j]; }
    }
    if (thread.local == kThreads - 1u && block * kThreads * kEach < size.count) {
        sums[block] = running[thread.local];
    }
}

@compute @workgroup_size(kThreads)
fn add(thread: Thread) {
    let block = group_of(thread);
    let first = (block * kThreads + thread.local) * kEach;
    for (var j = 0u; j < kEach; j++) {
        if (first + j < size.count) { values[first + j] += sums[block]; }
    }
}
